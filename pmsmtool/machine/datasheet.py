# SPDX-License-Identifier: MIT
"""A machine file from a datasheet or meter readings: every conversion is shown, contradictions are flagged.

Datasheets mix line-line and phase, star and delta, rms and peak, mechanical and electrical. Whatever is given
becomes the per-phase star equivalent in peak values at 20 degC, one named step at a time.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Literal

from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import EncoderParameters, Estimate, InverterParameters, MachineParameters, implausible
from pmsmtool.machine.simulation_keys import simulation_of
from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.units import RAD_S_PER_RPM, RPM_PER_RAD_S, format_quantity, parse_current

Between = Literal["line-line", "phase"]
Connection = Literal["star", "delta"]
CommutatedKind = Literal["rms", "peak", "block"]
"""``block``: of block commutation, a direct current through two terminals, a direct voltage between them."""
Source = Literal["datasheet", "meter", "guess"]


T_REF_C = 20.0

TOLERANCE: Mapping[Source, Mapping[str, float]] = {
    "datasheet": {"R": 0.10, "L": 0.20, "psi": 0.10, "J": 0.10},
    "meter": {"R": 0.01, "L": 0.05, "psi": 0.02, "J": 0.05},
    "guess": {"R": 0.30, "L": 0.50, "psi": 0.30, "J": 0.50},
}
"""Half widths (relative) by source, taken as uniform: the standard deviation is the half width over sqrt 3. Datasheet:
usual production tolerances of catalogue motors; meter: four-wire resistance, LCR bridge with the rotor held,
back-EMF on an oscilloscope."""

DISAGREEMENT_LIMIT = 0.05
"""Relative difference of the flux from K_e and the flux from K_t that is flagged."""

PEAK_PER_AMPERE: Mapping[CommutatedKind, float] = {
    "peak": 1.0,
    "rms": math.sqrt(2.0),
    "block": 2.0 * math.sqrt(3.0) / math.pi,
}
"""Torque per ampere of a kind over torque per ampere peak, 1.5 p psi: rms 2.121 p psi; block commutation 3 sqrt3 / pi
p psi = 1.654 p psi, the mean over 60 degrees between two terminals."""
_SAME_KIND = 0.02
"""K_t and K_e of one datasheet agree to their digits; two kinds are 10 % apart at the least."""

_CONFUSIONS: tuple[tuple[float, str], ...] = (
    (math.sqrt(2.0), "one of the two is rms where peak was said, or the reverse"),
    (PEAK_PER_AMPERE["block"], "the A of K_t is that of block commutation where peak was said, or the reverse"),
    (
        PEAK_PER_AMPERE["rms"] / PEAK_PER_AMPERE["block"],
        "the A of K_t is that of block commutation where rms was said, or the reverse",
    ),
    (math.sqrt(3.0), "one of the two is line-line where phase was said, or the reverse"),
    (math.sqrt(1.5), "line-line rms and phase peak are mixed"),
    (math.sqrt(6.0), "line-line peak and phase rms are mixed"),
    (2.0, "a line-line amplitude and a peak-to-peak value are mixed"),
    (RPM_PER_RAD_S, "rpm and rad/s are mixed"),
    (3.0 / 2.0, "a power-invariant constant: 3/2 is counted once or twice"),
)
_CONFUSION_WIDTH = 0.02
"""Relative distance to a known factor at which it is named."""


@dataclass(frozen=True, slots=True)
class EmfConstant:
    """Back-EMF constant as printed."""

    value: float
    """V s per mechanical rad, or Wb (V s per electrical rad) if ``is_flux``."""
    kind: CommutatedKind
    """What the voltage is; a flux linkage is peak. One of "rms", "peak", "block"."""
    between: Between
    """Where it is measured; "phase" of a delta is its winding. One of "line-line", "phase"."""
    is_flux: bool
    """Already a flux linkage of the star phase."""
    text: str
    """As printed."""


@dataclass(frozen=True, slots=True)
class TorqueConstant:
    """Torque constant: N m per ampere of line current, ``kind`` of that ampere, as printed."""

    value: float
    kind: CommutatedKind
    text: str


@dataclass(frozen=True, slots=True)
class Datasheet:
    """What a datasheet or a meter says; SI, currents of the line in A peak.

    ``R_ohm`` and ``L_*_h`` are as printed, between the terminals or of one winding; ``T_c`` is the temperature of the
    resistance.
    """

    name: str
    pole_pairs: int
    U_dc_v: float
    f_s_hz: float
    R_ohm: float
    L_d_h: float
    L_q_h: float
    K_e: EmfConstant | None = None
    K_t: TorqueConstant | None = None
    R_between: Between = "line-line"
    L_between: Between = "line-line"
    connection: Connection = "star"
    T_c: float = 25.0
    dead_time_s: float = 0.0
    I_nom_apk: float | None = None
    I_max_apk: float | None = None
    n_nom_rpm: float | None = None
    n_max_rpm: float | None = None
    J_kgm2: float | None = None
    encoder_bits: int | None = None
    sources: Mapping[str, Source] = field(default_factory=dict)

    def source(self, quantity: str) -> Source:
        """Where a quantity (``R``, ``L``, ``psi``, ``J``) comes from."""
        return self.sources.get(quantity, "datasheet")


_ABOVE_ZERO = (
    "R_ohm", "L_d_h", "L_q_h", "U_dc_v", "f_s_hz", "I_nom_apk", "I_max_apk", "n_nom_rpm", "n_max_rpm", "J_kgm2",
)  # fmt: skip
T_LEAST_C, T_MOST_C = -60.0, 250.0
"""Winding temperatures (degC) at which a resistance is stated or measured."""


@dataclass(frozen=True, slots=True)
class Conversion:
    """One step: what was given, by which rule, and what came out."""

    key: str
    given: str
    rule: str
    result: str


@dataclass(frozen=True, slots=True)
class DatasheetResult:
    """A machine file with every conversion and everything that should be looked at."""

    machine_file: MachineFile
    conversions: tuple[Conversion, ...]
    warnings: tuple[str, ...]


_NUMBER = r"\s*([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*"
_PER_SPEED: dict[str, float] = {
    "krpm": 1.0 / (1000.0 * RAD_S_PER_RPM),
    "1000rpm": 1.0 / (1000.0 * RAD_S_PER_RPM),
    "1000min-1": 1.0 / (1000.0 * RAD_S_PER_RPM),
    "rpm": 1.0 / RAD_S_PER_RPM,
    "min-1": 1.0 / RAD_S_PER_RPM,
    "(rad/s)": 1.0,
    "rad/s": 1.0,
}
_EMF = re.compile(_NUMBER + r"(m?)V(rms|eff|pk|peak)?/(.+)")
_EMF_SECONDS = re.compile(_NUMBER + r"(m?)V(rms|eff|pk|peak)?s/rad")
_FLUX = re.compile(_NUMBER + r"(m?)(Wb|Vs)")
_SPEED_CONSTANT = re.compile(_NUMBER + r"(?:rpm|min-1)/V(?:\(?(rms|eff|pk|peak|block|dc)\)?)?")
_BLOCK_CURRENT = re.compile(_NUMBER + r"(m?)A\s*\(?(?:block|dc)\)?")
_OR_BLOCK = "; or write 'rpm/V block', where a datasheet of block commutation says no more than rpm/V"
_TORQUE = re.compile(_NUMBER + r"(m?Nm|oz-?in|lb-?in)/A(?:\(?(rms|eff|pk|peak|block|dc)\)?)?")
_TORQUE_UNIT = {"Nm": 1.0, "mNm": 1e-3, "ozin": 0.0070615518, "lbin": 0.1129848290}
"""N m; ounce- and pound-force inch by 0.45359237 kg * 9.80665 m/s2 * 0.0254 m (exact definitions)."""


def _kind(written: str | None, text: str) -> CommutatedKind:
    """Rms or peak, as the unit says."""
    if written is None:
        raise ConfigError(
            f"{text!r} does not say whether it is rms or peak",
            likely="the two differ by a factor of 1.414",
            hint=f"write Vrms or Vpk (Arms or Apk for a torque constant) in the unit{_OR_BLOCK}",
        )
    return "rms" if written in ("rms", "eff") else "peak"


def parse_emf_constant(text: str, between: Between | None) -> EmfConstant:
    """Read a back-EMF constant. Raises ConfigError: not readable, or it is not said what the voltage is.

    Parameters
    ----------
    text : str
        ``58Vrms/krpm``, ``0.39Vpks/rad``, ``42mV/rpm``, ``190rpm/V`` (a speed constant), ``190rpm/V block``, or a flux
        linkage ``0.41Wb``.
    between : {"line-line", "phase"} or None
        Where the voltage is measured; needed for all but a flux linkage and block commutation (the terminals).
    """
    plain = re.sub(r"(?<=[A-Za-z0-9/)])\s+(?=[A-Za-z0-9/(])", "", text).replace("*", "").replace("²", "2")
    if flux := _FLUX.fullmatch(plain):
        return EmfConstant(_scaled(flux[1], flux[2]), "peak", "phase", True, text)
    value, written = math.nan, None
    if emf := _EMF_SECONDS.fullmatch(plain):
        value, written = _scaled(emf[1], emf[2]), emf[3]
    elif (emf := _EMF.fullmatch(plain)) and emf[4] in _PER_SPEED:
        value, written = _scaled(emf[1], emf[2]) * _PER_SPEED[emf[4]], emf[3]
    elif (speed := _SPEED_CONSTANT.fullmatch(plain)) and float(speed[1]) > 0.0:
        value, written = 1.0 / (float(speed[1]) * RAD_S_PER_RPM), speed[2]
    if not value > 0.0:
        like = "write it like 58Vrms/krpm, 0.39Vpks/rad or 0.41Wb"
        raise ConfigError(f"{text!r} is no back-EMF constant", likely=_comma(text), hint=like)
    if written in ("block", "dc"):
        if between == "phase":
            raise ConfigError(f"{text!r} is a direct voltage between two terminals", hint="leave the other word out")
        return EmfConstant(value, "block", "line-line", False, text)
    if between is None:
        where_said = f"add line-line or phase (--ke-between){_OR_BLOCK}"
        raise ConfigError(f"{text!r} does not say where the voltage is measured", hint=where_said)
    return EmfConstant(value, _kind(written, text), between, False, text)


def line_current(text: str) -> float:
    """Return a line current (A peak): as ``units.parse_current`` reads it, or ``9A block``, by the torque it makes.

    Raises ConfigError: not readable, or it is not said what the ampere is.
    """
    block = _BLOCK_CURRENT.fullmatch(text)
    return parse_current(text) if block is None else PEAK_PER_AMPERE["block"] * _scaled(block[1], block[2])


def parse_torque_constant(text: str) -> TorqueConstant:
    """Read a torque constant: ``1.74Nm/Arms``, ``85mNm/Apk``, ``12 oz-in/Arms``, ``38.5mNm/A block``.

    Raises ConfigError: not readable, or the unit does not say what the ampere is.
    """
    value, written = _torque_number(text)
    if written in ("block", "dc"):
        return TorqueConstant(value, "block", text)
    if written is None:
        raise ConfigError(
            f"{text!r} does not say whether the ampere is peak, rms or of block commutation",
            likely="1 Apk makes 1.5 p psi, 1 A block 1.654 p psi, 1 Arms 2.121 p psi",
            hint="write Apk, Arms or 'A block'; with --ke beside it the kind is recognised where the two fit",
        )
    return TorqueConstant(value, _kind(written, text), text)


def torque_constant_by_emf(
    text: str, K_e: EmfConstant, pole_pairs: int, connection: Connection
) -> tuple[TorqueConstant, str]:
    """Read a torque constant whose ampere is not said, as the kind that the back-EMF constant makes it.

    Raises ConfigError: no kind fits.

    Returns
    -------
    TorqueConstant
    str
        What was recognised; empty where the text itself says the kind.
    """
    value, written = _torque_number(text)
    if written is not None:
        return parse_torque_constant(text), ""
    psi, _ = flux_from_emf(K_e, pole_pairs, connection)
    ratio = value / torque_per_ampere(pole_pairs, psi)
    for kind, factor in PEAK_PER_AMPERE.items():
        if abs(ratio / factor - 1.0) <= _SAME_KIND:
            off = 100.0 * (ratio / factor - 1.0)
            return TorqueConstant(value, kind, text), (
                f"the A of {text} is {kind}: K_t = {1.5 * factor:.4g} p psi fits K_e to {off:+.2g} %"
            )
    raise ConfigError(
        f"{text!r} does not say what its ampere is, and K_t = {1.5 * ratio:.4g} p psi by K_e is none of "
        "1.5 (peak), 1.654 (block), 2.121 (rms)",
        likely="K_e is stated otherwise than given (line-line or phase, rms or peak)",
        hint="write Apk, Arms or 'A block', and compare --ke with the datasheet",
    )


def _torque_number(text: str) -> tuple[float, str | None]:
    """Return the value (N m/A) and what is written behind the A."""
    match = _TORQUE.fullmatch(re.sub("N[*.\u00b7]m", "Nm", text.replace(" ", "")))
    if match is None or not float(match[1]) > 0.0:
        raise ConfigError(
            f"{text!r} is no torque constant", likely=_comma(text),
            hint="write it like 1.74Nm/Arms, 85mNm/Apk or 85mNm/A block",
        )  # fmt: skip
    return float(match[1]) * _TORQUE_UNIT[match[2].replace("-", "")], match[3]


def _comma(text: str) -> str:
    return "a decimal comma: write a point" if "," in text else ""


def _scaled(number: str, milli: str) -> float:
    return float(Decimal(number).scaleb(-3 if milli else 0))


def star_phase(value: float, between: Between, connection: Connection) -> tuple[float, str]:
    """Return an impedance (ohm or H) as the star phase's, and the rule.

    Between two terminals lie two star phases in series; a delta winding equals three times its star phase.
    """
    if between == "line-line":
        return value / 2.0, "line-line / 2 (star or delta)"
    if connection == "delta":
        return value / 3.0, "delta winding / 3"
    return value, "star phase as given"


def flux_from_emf(K_e: EmfConstant, pole_pairs: int, connection: Connection) -> tuple[float, str]:
    """Return the flux linkage (Wb peak) and the rule: psi = K_e,phase,peak / p."""
    if K_e.is_flux:
        return K_e.value, "flux linkage as given"
    value, steps = K_e.value, [f"{K_e.value:.6g} V s/rad ({K_e.between}, {K_e.kind})"]
    if K_e.kind == "rms":
        value *= math.sqrt(2.0)
        steps.append("* sqrt 2")
    if K_e.kind == "block":
        value *= math.sqrt(3.0) / PEAK_PER_AMPERE["block"] / 1.5
        steps.append("* pi / 3")
    if K_e.between == "line-line" or connection == "delta":
        value /= math.sqrt(3.0)
        steps.append("/ sqrt 3" if K_e.between == "line-line" else "/ sqrt 3 (delta winding)")
    return value / pole_pairs, " ".join([*steps, f"/ {pole_pairs} pole pairs"])


def flux_from_torque(K_t: TorqueConstant, pole_pairs: int) -> tuple[float, str]:
    """Return the flux linkage (Wb peak) and the rule: T = 1.5 p psi I_peak, I of the line."""
    factor = PEAK_PER_AMPERE[K_t.kind]
    step = {"peak": "", "rms": " / sqrt 2", "block": f" / {factor:.5g}"}[K_t.kind]
    psi = K_t.value / factor / torque_per_ampere(pole_pairs, 1.0)
    return psi, f"{K_t.value:.6g} N m/A {K_t.kind}{step} / (1.5 * {pole_pairs} pole pairs)"


def disagreement(psi_e: float, psi_t: float, pole_pairs: int) -> str:
    """Return what is wrong when the fluxes of K_e and K_t differ too much, naming a known mix-up; else empty."""
    ratio = psi_t / psi_e
    if abs(ratio - 1.0) <= DISAGREEMENT_LIMIT:
        return ""
    text = f"K_t gives {psi_t:.5g} Wb, K_e gives {psi_e:.5g} Wb: they differ by {100 * (ratio - 1):+.1f} %"
    factors = [*_CONFUSIONS, (float(pole_pairs), "electrical and mechanical speed are mixed (pole pairs)")]
    size = max(ratio, 1.0 / ratio)
    near = [reason for factor, reason in factors if abs(size / factor - 1.0) <= _CONFUSION_WIDTH]
    unknown = "one of them is not in the kind (rms, peak, block) or not between the points that are stated"
    likely = f"a factor of {size:.4g}: {' or '.join(near)}" if near else unknown
    return f"{text}; {likely}; K_e was taken: to take K_t, leave out --ke"


def machine_from_datasheet(sheet: Datasheet) -> DatasheetResult:
    """Convert a datasheet to a machine file.

    The flux comes from K_e where there is one (no-load, no saturation), else from K_t; K_t then is the check.

    Raises ConfigError: neither K_e nor K_t is given, or a number that no machine has.
    """
    given = ((name, getattr(sheet, name)) for name in _ABOVE_ZERO)
    wrong = [f"{name} = {value:g} is not above zero" for name, value in given if value is not None and not value > 0.0]
    if not T_LEAST_C <= sheet.T_c <= T_MOST_C:
        wrong.append(f"T_c = {sheet.T_c:g} is not between {T_LEAST_C:g} and {T_MOST_C:g} degC")
    if wrong:
        raise ConfigError("the data sheet cannot be used", hint="correct what is listed", violations=wrong)
    steps: list[Conversion] = []
    warnings: list[str] = []
    R_s = _resistance(sheet, steps)
    L_d, L_q = (_inductance(sheet, axis, steps) for axis in ("d", "q"))
    psi_f = _flux(sheet, steps, warnings)
    if sheet.I_nom_apk is not None:
        torque = torque_per_ampere(sheet.pole_pairs, psi_f) * sheet.I_nom_apk
        steps.append(
            Conversion("(torque)", f"{sheet.I_nom_apk:.5g} Apk", "1.5 p psi I", f"{torque:.4g} N m at i_d = 0")
        )
    values = {"R_s_ohm": R_s, "L_d_h": L_d, "L_q_h": L_q, "psi_f_wb": psi_f}
    if sheet.J_kgm2 is not None:
        values["J_kgm2"] = sheet.J_kgm2
    estimates = {key: _estimate(sheet, key, value) for key, value in values.items()}
    machine = MachineParameters(
        pole_pairs=sheet.pole_pairs,
        R_s_ohm=R_s,
        R_winding_ohm=R_s,
        L_d_h=L_d,
        L_q_h=L_q,
        psi_f_wb=psi_f,
        T_ref_c=T_REF_C,
        alpha_R_per_k=COPPER_ALPHA_PER_K,
        I_nom_apk=sheet.I_nom_apk,
        I_max_apk=sheet.I_max_apk,
        n_nom_rpm=sheet.n_nom_rpm,
        n_max_rpm=sheet.n_max_rpm,
        J_kgm2=sheet.J_kgm2,
    )
    inverter = InverterParameters(U_dc_v=sheet.U_dc_v, f_s_hz=sheet.f_s_hz, dead_time_s=sheet.dead_time_s)
    warnings.extend(implausible(machine, inverter))
    std = {key: estimate.std for key, estimate in estimates.items()}
    std["R_winding_ohm"] = std["R_s_ohm"]  # what is measured at the motor's terminals is copper: no bridge, no cable
    simulation, assumed = simulation_of(machine, sheet.encoder_bits)
    steps += [Conversion("[simulation]", "assumed", line, "for a rehearsal alone") for line in assumed]
    encoder = EncoderParameters(bits=sheet.encoder_bits)
    machine_file = MachineFile(
        sheet.name, machine, inverter, encoder=encoder, std=std, estimates=estimates, simulation=simulation
    )  # fmt: skip
    return DatasheetResult(machine_file, tuple(steps), tuple(warnings))


CONVERSION = "conversion"
"""Method of an estimate that nothing measured here."""
_QUANTITY = {"R_s_ohm": "R", "L_d_h": "L", "L_q_h": "L", "psi_f_wb": "psi", "J_kgm2": "J"}
_UNIT = {"R_s_ohm": "ohm", "L_d_h": "H", "L_q_h": "H", "psi_f_wb": "Wb", "J_kgm2": "kg m2"}


def _estimate(sheet: Datasheet, key: str, value: float) -> Estimate:
    source = sheet.source(_QUANTITY[key])
    std = value * TOLERANCE[source][_QUANTITY[key]] / math.sqrt(3.0)
    T_c = T_REF_C if key in ("R_s_ohm", "psi_f_wb") else math.nan
    return Estimate(value, std, 0.0, _UNIT[key], T_c=T_c, method=CONVERSION, source=source)


def _resistance(sheet: Datasheet, steps: list[Conversion]) -> float:
    phase, rule = star_phase(sheet.R_ohm, sheet.R_between, sheet.connection)
    at_ref = phase / (1.0 + COPPER_ALPHA_PER_K * (sheet.T_c - T_REF_C))
    given = f"{format_quantity(sheet.R_ohm, 'ohm', 6)} {sheet.R_between} at {sheet.T_c:g} degC"
    rule = f"{rule}, / (1 + {COPPER_ALPHA_PER_K} * {sheet.T_c - T_REF_C:g} K)"
    steps.append(Conversion("R_s_ohm", given, rule, f"{format_quantity(at_ref, 'ohm', 6)} at {T_REF_C:g} degC"))
    return at_ref


def _inductance(sheet: Datasheet, axis: str, steps: list[Conversion]) -> float:
    given = sheet.L_d_h if axis == "d" else sheet.L_q_h
    phase, rule = star_phase(given, sheet.L_between, sheet.connection)
    text = f"{format_quantity(given, 'H', 6)} {sheet.L_between}"
    steps.append(Conversion(f"L_{axis}_h", text, rule, format_quantity(phase, "H", 6)))
    return phase


OF_BLOCK = (
    "K_t in N m/A and K_e in V s/rad are the same number: "
    "both are those of block commutation, 'A block' and 'rpm/V block'"
)
"""What a pair of constants is that differs by no factor: with peak or rms amperes it would."""


def _flux(sheet: Datasheet, steps: list[Conversion], warnings: list[str]) -> float:
    found: list[float] = []
    if sheet.K_e is not None:
        psi, rule = flux_from_emf(sheet.K_e, sheet.pole_pairs, sheet.connection)
        steps.append(Conversion("psi_f_wb", f"K_e = {sheet.K_e.text}", rule, format_quantity(psi, "Wb", 6)))
        found.append(psi)
    if sheet.K_t is not None:
        psi, rule = flux_from_torque(sheet.K_t, sheet.pole_pairs)
        key = "(check)" if found else "psi_f_wb"
        steps.append(Conversion(key, f"K_t = {sheet.K_t.text}", rule, format_quantity(psi, "Wb", 6)))
        found.append(psi)
    if not found:
        raise ConfigError("neither a back-EMF constant nor a torque constant is given", hint="give --ke or --kt")
    if len(found) == 2 and (text := disagreement(found[0], found[1], sheet.pole_pairs)):
        assert sheet.K_e is not None and sheet.K_t is not None
        same = abs(sheet.K_t.value / sheet.K_e.value - 1.0) <= _SAME_KIND and not sheet.K_e.is_flux
        warnings.append(f"{text}; {OF_BLOCK}" if same else text)
    return found[0]
