# SPDX-License-Identifier: MIT
"""Units in which drives count: what one count of an object is worth, as a person reads it in a data sheet.

``uV/A``, ``10 mohm line-line``, ``mA rms``, ``0.1 V``, ``rev/s``: an optional number, a unit, and its kind:
``peak`` or ``rms`` (sinusoidal current or voltage: rms times sqrt 2 is the peak; torque over such a current: divided
by it) or ``line-line`` (winding data between two terminals: half of it per phase). A current must say its kind: an
object in rms taken as peak would get a limit 41 % too high. Relative CiA 402 values are ``permille of 0x6075`` and
``permille of 0x6076``.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from pmsmtool.units import PREFIXES, UNITS


@dataclass(frozen=True, slots=True)
class WireUnit:
    """What one count is worth."""

    dimension: str
    """What is counted, as in ``units.UNITS``."""
    scale: float
    """SI value (base unit of the dimension) of one count."""
    relative_to: int = 0
    """Index of the object that holds the base of a permille value, 0 for absolute units."""


_COMPOSITE: dict[str, tuple[str, float]] = {
    "mV/A": ("gain V/A", 1e-3),
    "uV/A": ("gain V/A", 1e-6),
    "mV/(A s)": ("gain V/(A s)", 1e-3),
    "V/(A ms)": ("gain V/(A s)", 1e3),
    "mV/(A ms)": ("gain V/(A s)", 1.0),
    "uV/(A ms)": ("gain V/(A s)", 1e-3),
    "N m/(rev/s)": ("gain N m s/rad", 0.5 / math.pi),
    "N m/(rev/s2)": ("inertia", 0.5 / math.pi),
    "mN m s/rad": ("gain N m s/rad", 1e-3),
    "uN m s/rad": ("gain N m s/rad", 1e-6),
    "A s/rad": ("gain A s/rad", 1.0),
    "mA s/rad": ("gain A s/rad", 1e-3),
    "uA s/rad": ("gain A s/rad", 1e-6),
    "mA/(rev/s)": ("gain A s/rad", 0.5e-3 / math.pi),
    "A/rad": ("gain A/rad", 1.0),
    "mA/rad": ("gain A/rad", 1e-3),
    "uA/rad": ("gain A/rad", 1e-6),
    "A/(rad s)": ("gain A/(rad s)", 1.0),
    "mA/(rad s)": ("gain A/(rad s)", 1e-3),
    "uA/(rad s)": ("gain A/(rad s)", 1e-6),
    "A s2/rad": ("gain A s2/rad", 1.0),
    "uA s2/rad": ("gain A s2/rad", 1e-6),
    "N m/A": ("torque constant", 1.0),
    "mN m/A": ("torque constant", 1e-3),
    "uN m/A": ("torque constant", 1e-6),
    "N mm/A": ("torque constant", 1e-3),
    "rev": ("angle", 2.0 * math.pi),
    "rev/s": ("angular speed", 2.0 * math.pi),
    "rev/s2": ("angular acceleration", 2.0 * math.pi),
    "1/s": ("frequency", 1.0),
    "permille": ("ratio", 1e-3),
    "permille/s": ("frequency", 1e-3),
    "us": ("time", 1e-6),
    "ms": ("time", 1e-3),
}
"""Units that are more than a prefix before one of ``units.UNITS``."""

CURRENT = "current"
_PATTERN = re.compile(r"(?:(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?) +)?(\S.*?)(?: +(peak|rms|line-line))?\Z")
_RELATIVE = {"permille of 0x6075": (CURRENT, 0x6075), "permille of 0x6076": ("torque", 0x6076)}
_OF_RMS = {CURRENT: math.sqrt(2.0), "voltage": math.sqrt(2.0), "torque constant": math.sqrt(0.5)}
_PER_PHASE = frozenset({"resistance", "inductance"})


def wire_unit(text: str) -> WireUnit:
    """Return what a unit says.

    Raises ValueError: it is none, or a current that says neither ``peak`` nor ``rms``; the message says why.
    """
    if text in _RELATIVE:
        dimension, base = _RELATIVE[text]
        return WireUnit(dimension, 1e-3, base)
    match = _PATTERN.match(text)
    if match is None:
        raise ValueError("empty")
    number, symbol, kind = match.groups()
    dimension, scale = _symbol(symbol)
    scale *= float(number or 1.0)
    if dimension == CURRENT and kind is None:
        raise ValueError(f"peak or rms? They differ by 41 %: write {f'{text} peak'!r} or {f'{text} rms'!r}")
    if kind in ("peak", "rms"):
        if dimension not in _OF_RMS:
            raise ValueError(f"{dimension} has no {kind} value")
        scale *= _OF_RMS[dimension] if kind == "rms" else 1.0
    elif kind == "line-line":
        if dimension not in _PER_PHASE:
            raise ValueError(f"{dimension} is not halved between lines")
        scale *= 0.5
    return WireUnit(dimension, scale)


def _symbol(symbol: str) -> tuple[str, float]:
    if symbol in _COMPOSITE:
        return _COMPOSITE[symbol]
    if symbol in UNITS:
        unit = UNITS[symbol]
        return unit.dimension, unit.factor * 10.0**unit.exponent
    base = UNITS.get(symbol[1:])
    if base is not None and base.prefixable and symbol[0] in PREFIXES:
        return base.dimension, base.factor * 10.0 ** (base.exponent + PREFIXES[symbol[0]])
    raise ValueError(f"unknown unit {symbol!r}")


def as_peak(symbol: str) -> str:
    """Return how a map spells a unit of ``units.UNITS`` in which amplitudes are given: ``A peak`` for ``A``."""
    return f"{symbol} peak" if _symbol(symbol)[0] == CURRENT else symbol


def counted_in(text: str, symbol: str) -> float:
    """Return one count of unit ``text`` in the unit ``symbol``: of ``units.UNITS``, or composed (``N m/A``).

    Raises ValueError: not a unit, a relative one, or of another dimension.
    """
    given = wire_unit(text)
    dimension, scale = _symbol(symbol)
    if given.relative_to:
        raise ValueError(f"a parameter cannot be relative to 0x{given.relative_to:04X}")
    if given.dimension != dimension:
        raise ValueError(f"{given.dimension}, expected {dimension} (such as {symbol!r})")
    return given.scale / scale
