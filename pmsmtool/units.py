# SPDX-License-Identifier: MIT
"""The closed catalogue of units, and quantities as people write them.

Inside, every number is SI without a prefix (rpm, degC and ns are kept where a file or an object says so). At the
edges a value carries its unit: ``800Hz``, ``1.2mH``, ``47.9V``, ``1200rpm``, and a current also its kind:
``12Apk`` or ``8.5Arms``. A bare number where a unit is due is an error that teaches the spelling.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from difflib import get_close_matches
from typing import TYPE_CHECKING, TypeVar

from pmsmtool.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Unit:
    """One allowed unit."""

    symbol: str
    """The spelling used in files, catalogues and JSON."""
    dimension: str
    """What it measures; units of one dimension convert into each other."""
    spellings: tuple[str, ...] = ()
    """What else a person may write."""
    prefixable: bool = False
    """Whether a prefix from p to G may stand before it."""
    exponent: int = 0
    """Power of ten between the unit and SI, kept apart so that 1.2mH is exactly 0.0012."""
    factor: float = 1.0
    """The rest of its SI value (2 pi/60 for rpm)."""


RAD_S_PER_RPM = math.pi / 30.0
"""One turn per minute (rad/s)."""
RPM_PER_RAD_S = 30.0 / math.pi
"""One radian per second (rpm)."""
RAD_S_PER_MRPM = math.pi / 30_000.0
"""A thousandth of a turn per minute (rad/s)."""

Speed = TypeVar("Speed", float, "NDArray[np.float64]")


def rad_s_from_rpm(speed_rpm: Speed) -> Speed:
    """Return a speed in rad/s of one in rpm; any shape."""
    return speed_rpm * math.pi / 30.0


def rpm_from_rad_s(speed_rad_s: Speed) -> Speed:
    """Return a speed in rpm of one in rad/s; any shape."""
    return speed_rad_s * 30.0 / math.pi


_UNITS: tuple[Unit, ...] = (
    Unit("1", "ratio"),
    Unit("%", "ratio", ("percent",), exponent=-2),
    Unit("dB", "level"),
    Unit("ohm", "resistance", ("Ohm", "ohms", "Ohms", "\u03a9", "\u2126"), True),  # Greek omega, ohm sign
    Unit("H", "inductance", (), True),
    Unit("Wb", "flux linkage", ("V s",), True),
    Unit("V", "voltage", (), True),
    Unit("A", "current", (), True),
    Unit("Hz", "frequency", (), True),
    Unit("s", "time", (), True),
    Unit("min", "time", factor=60.0),
    Unit("ns", "time", exponent=-9),
    Unit("rad", "angle", (), True),
    Unit("deg", "angle", ("°",), factor=math.pi / 180.0),
    Unit("rad/s", "angular speed"),
    Unit("1/s", "angular speed"),
    Unit("rpm", "angular speed", ("r/min", "1/min", "min-1"), True, factor=RAD_S_PER_RPM),
    Unit("rad/s2", "angular acceleration", ()),
    Unit("rpm/s", "angular acceleration", factor=RAD_S_PER_RPM),
    Unit("rad/s3", "angular jerk"),
    Unit("rpm/s2", "angular jerk", factor=RAD_S_PER_RPM),
    Unit("N m", "torque", (), True),
    Unit("N m/s", "torque slope"),
    Unit("kg m2", "inertia", ()),
    Unit("kg cm2", "inertia", exponent=-4),
    Unit("g cm2", "inertia", exponent=-7),
    Unit("kg m2/Wb", "inertia over flux linkage"),
    Unit("kg m2 A/(N m)", "inertia over torque constant"),
    Unit("N m/Wb", "torque over flux linkage"),
    Unit("N m s", "viscous friction", ("N m s/rad",), True),
    Unit("N m s2", "drag over speed squared", (), True),
    Unit("degC", "temperature", ("°C",)),
    Unit("K", "temperature difference"),
    Unit("1/K", "temperature coefficient", ("/K",)),
    Unit("%/K", "temperature coefficient", exponent=-2),
    Unit("W", "power", (), True),
    Unit("J", "energy", (), True),
    Unit("F", "capacitance", (), True),
    Unit("J/K", "heat capacity", (), True),
    Unit("K/W", "thermal resistance"),
    Unit("A s", "charge", (), True),
    Unit("A/s", "current slope"),
    Unit("V/A", "gain V/A"),
    Unit("V/(A s)", "gain V/(A s)"),
    Unit("N m s/rad", "gain N m s/rad"),
    Unit("N m/rad", "gain N m/rad"),
    Unit("N m/(rad s)", "gain N m/(rad s)"),
    Unit("N m/A", "torque constant", (), True),
    Unit("1/(N m)2", "weight 1/(N m)2"),
    Unit("1/A2", "weight 1/A2"),
)

UNITS: dict[str, Unit] = {unit.symbol: unit for unit in _UNITS}
"""All allowed units by symbol; a unit that is not here does not exist for pmsmtool."""

DIMENSIONS: dict[str, str] = {
    unit.dimension: unit.symbol for unit in reversed(_UNITS) if unit.exponent == 0 and unit.factor == 1.0
}
"""SI unit of each dimension."""

PREFIXES: dict[str, int] = {"p": -12, "n": -9, "u": -6, "\u00b5": -6, "\u03bc": -6, "m": -3, "k": 3, "M": 6, "G": 9}
"""Powers of ten; micro is u, the micro sign or the Greek letter."""

_NUMBER = re.compile(r"\s*([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*", re.DOTALL)
_EXAMPLES = {
    "Hz": "800Hz or 0.8kHz",
    "H": "1.2mH",
    "V": "47.9V",
    "ohm": "137mohm",
    "s": "250us",
    "rad/s": "1200rpm or 125rad/s",
    "rad": "2.5deg or 0.0436rad",
    "N m": "4.5Nm",
    "kg m2": "0.0021kgm2 or 21kgcm2",
    "Wb": "0.41Wb or 410mVs",
    "degC": "25degC",
    "A": "12Apk or 8.5Arms",
    "1": "0.02 or 2%",
}


def check_unit(symbol: str) -> Unit:
    """Return the catalogue row of a unit, or raise ``ConfigError`` with the nearest one."""
    if symbol in UNITS:
        return UNITS[symbol]
    near = get_close_matches(symbol, UNITS, n=1)
    raise ConfigError(
        f"unknown unit {symbol!r}", hint=f"did you mean {near[0]!r}?" if near else "see `pmsmtool help units`"
    )


_JOINED = str.maketrans({" ": "", "*": "", "^": "", "\u00b7": "", "\u22c5": "", "\u00b2": "2", "\u00b3": "3"})
"""How a person writes products and powers: none of it is told apart (``g cm2``, ``gcm^2``, ``g·cm²``)."""


def _near_unit(spelled: str, dimension: str) -> str:
    """Return which unit of the dimension may be meant, as a question; empty when none is near."""
    names = [
        prefix + unit.symbol.translate(_JOINED)
        for unit in _UNITS
        if unit.dimension == dimension
        for prefix in (("", "m", "u", "k") if unit.prefixable else ("",))
    ]
    same = [name for name in names if name.casefold() == spelled.translate(_JOINED).casefold()]
    near = same or get_close_matches(spelled, names, n=1, cutoff=0.7)
    return f"did you mean {near[0]}?" if near else ""


def _split(text: str, example: str) -> tuple[Decimal, str]:
    match = _NUMBER.fullmatch(text)
    if match is None or match[2].startswith(","):
        likely = "a decimal comma: write a point" if "," in text else ""
        raise ConfigError(f"{text!r} is not a number with a unit", likely=likely, hint=f"write it like {example}")
    return Decimal(match[1]), match[2]


def _spelled_unit(spelled: str, dimension: str) -> tuple[Unit, int] | None:
    """The unit a person wrote and the power of ten of its prefix; None when it is not of the dimension."""
    joined = spelled.translate(_JOINED)
    for unit in _UNITS:
        if unit.dimension != dimension:
            continue
        for name in (unit.symbol.translate(_JOINED), *(spelling.translate(_JOINED) for spelling in unit.spellings)):
            if joined == name:
                return unit, 0
            if unit.prefixable and joined[:1] in PREFIXES and joined[1:] == name:
                return unit, PREFIXES[joined[0]]
    return None


_SUFFIXES = {
    "per_rpm_per_s": "1/(rpm/s)", "rpm_per_s": "rpm/s", "nm_per_s": "N m/s", "nms_per_rad": "N m s/rad",
    "nm_per_rads": "N m/(rad s)", "nm_per_rad": "N m/rad", "rad_s": "rad/s", "rad_s2": "rad/s2", "rad_s3": "rad/s3",
    "v_per_as": "V/(A s)", "v_per_a": "V/A", "per_s": "1/s", "rpm": "rpm", "rad": "rad", "deg": "deg", "hz": "Hz",
    "db": "dB", "percent": "%", "nm": "N m",
    "apk": "A peak", "a": "A", "v": "V", "s": "s", "wb": "Wb", "h": "H", "ohm": "ohm", "periods": "control periods",
}  # fmt: skip


def unit_of_key(key: str) -> str:
    """Return the unit that a key ends in (``generation_rpm``), the longest there is; ``1`` where it ends in none."""
    parts = key.split("_")
    endings = ("_".join(parts[start:]) for start in range(1, len(parts)))
    return next((_SUFFIXES[ending] for ending in endings if ending in _SUFFIXES), "1")


def parse_quantity(text: str, dimension: str) -> float:
    """Return the SI value of a quantity written with its unit.

    Raises ConfigError: no number, no unit where one is due, a unit of another dimension, or a current that does not say
    whether it is peak or rms.

    Parameters
    ----------
    text : str
        Such as ``800Hz``, ``1.2 mH``, ``1200rpm``, ``95%``; a prefix from p to G where the unit takes one.
    dimension : str
        Name of a dimension (``"frequency"``; the result is in its SI unit) or a unit of the catalogue
        (``"rpm"``; the result is in that unit).
    """
    wanted = check_unit(DIMENSIONS.get(dimension, dimension))
    if wanted.dimension == "current":
        return parse_current(text)
    example = _EXAMPLES.get(DIMENSIONS.get(wanted.dimension, ""), f"1{wanted.symbol}")
    value, spelled = _split(text, example)
    if not spelled and wanted.dimension != "ratio":
        raise ConfigError(f"{text!r} has no unit, and {wanted.dimension} needs one", hint=f"write it like {example}")
    found = _spelled_unit(spelled or "1", wanted.dimension)
    if found is None:
        other = next((d for d in DIMENSIONS if _spelled_unit(spelled, d) is not None), None)
        reason = f"is a unit of {other}, not of {wanted.dimension}" if other else f"is no unit of {wanted.dimension}"
        near = "" if other else _near_unit(spelled, wanted.dimension)
        raise ConfigError(f"{spelled!r} in {text!r} {reason}", likely=near, hint=f"write it like {example}")
    unit, prefix = found
    exact = float(value.scaleb(prefix + unit.exponent - wanted.exponent))
    return _finite(exact if unit.factor == wanted.factor else exact * (unit.factor / wanted.factor), text)


def _finite(value: float, text: str) -> float:
    if not math.isfinite(value):
        raise ConfigError(f"{text!r} is too large to be a quantity", hint="write a smaller number, or a larger unit")
    return value


_CURRENT = re.compile(r"([munpkMG\u00b5\u03bc]?) ?A ?(pk|peak|rms|eff)?")


def parse_current(text: str) -> float:
    """Return a current as its amplitude (A peak); the text must say ``Apk`` or ``Arms``.

    Raises ConfigError: the kind is missing: peak and rms differ by 41 %, so it is never guessed.
    """
    value, spelled = _split(text, _EXAMPLES["A"])
    match = _CURRENT.fullmatch(spelled)
    if match is None:
        problem = f"{spelled!r} in {text!r} is no unit of current" if spelled else f"{text!r} has no unit"
        raise ConfigError(problem, hint=f"write it like {_EXAMPLES['A']}")
    if match[2] is None:
        raise ConfigError(
            f"{text!r} does not say whether it is a peak or an rms value",
            likely="the two differ by a factor of 1.414",
            hint=f"write {value}{match[1]}Apk or {value}{match[1]}Arms",
        )
    amplitude = float(value.scaleb(PREFIXES.get(match[1], 0)))
    return _finite(amplitude * math.sqrt(2.0) if match[2] in ("rms", "eff") else amplitude, text)


def format_current(i_apk: float) -> str:
    """Return a current in both kinds, ``12 Apk (8.485 Arms)``."""
    return f"{i_apk:.4g} Apk ({i_apk / math.sqrt(2.0):.4g} Arms)"


def _scaled(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit text that bring a magnitude to 0.1..100 where the unit takes prefixes."""
    row = check_unit(unit)
    size = abs(value)
    if not row.prefixable or unit == "rpm" or not math.isfinite(size) or size == 0.0 or 0.1 <= size < 1e4:
        return 1.0, "" if unit == "1" else unit
    for prefix, factor in (("M", 1e6), ("k", 1e3), ("m", 1e-3), ("u", 1e-6), ("n", 1e-9), ("p", 1e-12)):
        if size >= 0.1 * factor:
            return factor, prefix + unit
    return 1.0, unit


def format_quantity(value: float, unit: str, digits: int = 4) -> str:
    """Return a value with ``digits`` significant digits, a prefix where one is customary, and its unit."""
    factor, text = _scaled(value, unit)
    return f"{value / factor:.{digits}g} {text}".rstrip()


def _decimals(std: float) -> int:
    """Decimals that a standard deviation justifies.

    Two significant digits when the leading three are below 355, else one (950 and more round up to the
    next power of ten), so that rounding changes the deviation by at most about 15 %.

    References
    ----------
    Particle Data Group, Review of Particle Physics, Introduction, section 5.3 ("Rounding").
    """
    exponent = math.floor(math.log10(std))
    leading = round(std / 10.0 ** (exponent - 2))  # three digits, 100..1000
    return 1 - exponent if leading < 355 else -exponent


def format_estimate(value: float, std: float, unit: str) -> str:
    """Return ``0.1043 +- 0.0008 ohm``: no more digits than the standard deviation justifies.

    A deviation of zero is written ``(exact)``, one that is not finite ``(deviation unknown)``.
    """
    known = math.isfinite(value) and math.isfinite(std)
    factor, text = _scaled(max(abs(value), std) if known else value, unit)  # 0 +- 4 us
    tail = f" {text}" if text else ""
    if not known or std < 0.0:
        return f"{value / factor:.4g}{tail} (deviation unknown)"
    if std == 0.0:
        return f"{value / factor:.6g}{tail} (exact)"
    decimals = _decimals(std / factor)
    if decimals < 0:  # tens or more: round both to that place
        place = 10.0**-decimals
        return f"{round(value / factor / place) * place:.0f} +- {round(std / factor / place) * place:.0f}{tail}"
    return f"{value / factor:.{decimals}f} +- {std / factor:.{decimals}f}{tail}"
