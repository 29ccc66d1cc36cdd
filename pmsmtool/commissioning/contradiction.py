# SPDX-License-Identifier: MIT
"""What a machine file states, what the drive holds and what was measured, side by side, before anything is written.

A measured value beyond the joint interval of measurement and data sheet contradicts the file. So does a value that was
not measured where the drive holds another one that somebody has set, unless what was measured shows that the set is
that of another motor. Whatever is left was not checked, and says so. Pure: numbers go in, rows come out.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from fractions import Fraction
from typing import Any, Literal

from pmsmtool.estimators.resistance import R_MEASURED
from pmsmtool.identification.completed_machine import UNKNOWN_TEMPERATURE_K
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.machine_keys import MEASURABLE
from pmsmtool.machine.temperature import UNKNOWN_T_RANGE_C
from pmsmtool.report.comparison import told

Verdict = Literal["agrees", "contradicts", "accepted", "NOT CHECKED", "measured", "held"]

TOLERANCE: Mapping[str, float] = {
    "R_s_ohm": 0.10, "L_d_h": 0.30, "L_q_h": 0.30, "L_q_app_h": 0.30, "psi_f_wb": 0.10, "J_kgm2": 0.20,
}  # fmt: skip
"""Relative tolerance of a data sheet that states no standard deviation (catalogues: R and Kt 10 %, L 30 %, J 20 %)."""
COVERAGE = 1.96
"""Standard deviations of ``[std]`` to a 95 % half width."""
DEVICE_SHARE = 0.3
"""Largest part of the measured loop that bridge, cable and shunts have; a data sheet's winding is without it."""
DEVICES_LEAST_OHM = 0.02
"""What they may have at least, however low the winding: a metre of 0.75 mm2 alone has 23 mohm (0.0175 ohm mm2/m). A
winding of 21 mohm behind switches of 17 mohm was named the motor of another data sheet."""
DEVICES_LEAST_V = 0.4
"""The same at the rated current (peak). Bridges are made for a voltage that is lost, not for a resistance: integrated
ones of 50 mohm a switch carry 8 A, of 200 mohm 2 A. 30 mohm beside a winding of 8 mohm for 2 A were named so, too."""
SALIENCY = 3.0
"""Largest L_q/L_d behind a data sheet that states one inductance for both axes."""
VENDOR_SHARE = 0.15
"""Relative interval of a value that the drive measured by itself: simulated simple methods were up to 14 % off."""
FACTORY_SHARE = 1e-6
"""Within this of the factory default (binary32), nobody has set a value."""
COARSE = 0.5
"""Relative interval of a measured value from which on it confirms nothing: half of it, or twice, would agree, too. R of
a motor for a tenth of its bridge's current, known to +-98 %, agreed with any data sheet, and the run ended PASS."""
RATIO_SHARE = 0.08
"""Within this of a known ratio, it is named as the likely cause."""

DATA_SHEET = "data sheet"
"""What a machine file that a person gave is called."""
EXACT = ("pole_pairs", "encoder_counts")
RATIO = "J_per_psi"
PHASE_INDUCTANCE = "L_phase_h"
"""One inductance that a drive measured for both axes."""
HELD = ("pole_pairs", "R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
"""Quantities a drive may hold, as ``motor.<key>`` of its map."""
ORDER = (
    "pole_pairs", "R_s_ohm", "L_d_h", "L_q_h", "L_q_app_h", PHASE_INDUCTANCE, "psi_f_wb", "J_kgm2", RATIO,
    "encoder_counts",
)  # fmt: skip
UNITS = {"encoder_counts": "1", RATIO: "kg m2/Wb", PHASE_INDUCTANCE: "H"}
OTHER_MOTOR = "the drive holds the set of another motor, by what was measured"
ACCEPTABLE = ("R_s_ohm", "L_q_h", "L_q_app_h", "J_kgm2", RATIO)
"""What a person may accept. Speed, torque and demagnetisation limits follow from psi, L_d, pole pairs and counts."""
_TOGETHER = ({"J_kgm2", RATIO}, {"L_q_h", "L_q_app_h"})
"""Names of one quantity: who accepts one of them accepts the other."""

_CAUSES: Mapping[str, tuple[tuple[float, str], ...]] = {
    "R_s_ohm": (
        (2.0, "line to line instead of phase"),
        (1.5, "delta read as star, or line to line of a delta winding"),
        (3.0, "phase of a delta winding instead of its star equivalent"),
    ),
    "L": ((2.0, "line to line instead of phase"), (1.5, "line to line of a delta winding"), (3.0, "delta phase")),
    "psi_f_wb": (
        (math.sqrt(3.0), "line to line instead of phase"),
        (math.sqrt(2.0), "rms instead of peak"),
        (math.sqrt(6.0), "line to line rms instead of phase peak"),
        (1.5, "Kt convention: Kt = 1.5 p psi for peak current"),
        (3.0 * math.sqrt(3.0) / math.pi, "Kt convention: Kt = 1.654 p psi for block commutation"),
        (1.5 * math.sqrt(2.0), "Kt convention: Kt = 2.121 p psi for rms current"),
        (2.0, "peak to peak, or poles instead of pole pairs"),
        (1e3, "a unit: mWb"),
    ),
    "J_kgm2": ((1e4, "a unit: kg cm2"), (1e3, "a unit: g m2"), (1e7, "a unit: g cm2")),
}  # fmt: skip
_SHAFT = "a load on the shaft (--shaft coupled), or the data sheet of another motor"
_BY_POLE_PAIRS = "the pole pairs, which it is computed with"
_RATIO = "J, psi or pole pairs of another motor, or a load on the shaft (--shaft coupled)"
_OTHER = "the data sheet of another motor"
_OTHER_SET_UP = "the drive is set up for another motor, or this is the data sheet of another one"


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity of the table *data sheet | drive | measured*."""

    name: str
    """Key of a machine file, or ``J_per_psi``, ``L_phase_h``, ``encoder_counts``."""
    unit: str
    """Of its values."""
    stated: float | None = None
    held: float | None = None
    measured: float | None = None
    """What MACHINE states, the drive holds, this run measured (SI); None: it does not."""
    interval: float = 0.0
    """95 % half width of the measured value."""
    low: float = math.nan
    high: float = math.nan
    """What the stated value allows; NaN without one."""
    tolerance: str = ""
    """By which tolerance it does."""
    factory: bool = False
    """Whether ``held`` is the drive's factory default."""
    source: str = DATA_SHEET
    """Where ``stated`` comes from."""
    verdict: Verdict = "held"
    """What that amounts to."""
    cause: str = ""
    """Likely cause of a contradiction."""

    def facts(self) -> dict[str, Any]:
        """Return the row as a stage records it; what is not finite as None."""
        facts = {
            key: None if value in (math.inf, -math.inf) or value != value else value
            for key, value in asdict(self).items()
        }
        return {**facts, "text": self.text}

    @property
    def text(self) -> str:
        """One sentence: both values, the limit, and for a contradiction its likely cause."""
        other, value = ("measured", self.measured) if self.measured is not None else ("the drive holds", self.held)
        shown = self.measured is not None and self.interval and self.name not in EXACT
        within = f" +-{told(self.interval, self.unit, 2)}" if shown else ""
        allowed = "exactly that" if self.name in EXACT else f"{told(self.low, self.unit)} to "
        allowed += "" if self.name in EXACT else f"{told(self.high, self.unit)} ({self.tolerance})"
        end = f"; likely {self.cause}" if self.cause else ""
        return (
            f"{self.name}: the {self.source.removeprefix('the ')} states {told(self.stated, self.unit)}, "
            f"{other} {told(value, self.unit)}{within}; allowed: {allowed}{end}"
        )


@dataclass(frozen=True, slots=True)
class _Measured:
    value: float
    half: float
    T_known: bool
    i_d_apk: float
    i_q_apk: float
    bend_per_a: float = 0.0

    @property
    def at_zero(self) -> float:
        """The value without its bias, by its slope there: a data sheet may mean either where a machine saturates."""
        return self.value * (1.0 - self.bend_per_a * self.i_d_apk) if self.bend_per_a else self.value


def compare(
    stated: MachineFile | None,
    held: Mapping[str, float],
    values: Sequence[Mapping[str, Any]],
    *,
    defaults: Mapping[str, float] | None = None,
    used: Collection[str] = (),
    loaded: bool = False,
    accept: Collection[str] = (),
    source: str = DATA_SHEET,
) -> tuple[Row, ...]:
    """Return the table of what is stated, held and measured.

    Parameters
    ----------
    stated : MachineFile or None
        The data sheet.
    held : mapping of str to float
        What the drive holds, by the names of :data:`HELD` and ``encoder_counts``; zero or less: not set.
    values : sequence of mapping
        The values of an identification stage: what has a ``std`` was measured, ``vendor`` by the drive itself.
    defaults : mapping of str to float, optional
        Factory defaults; what the drive holds besides was set by somebody.
    used : collection of str
        Held values that the measurement stands on: their being a default excuses nothing.
    loaded : bool
        A load is coupled: the inertia may be any amount above that of the rotor alone.
    accept : collection of str
        Contradictions a person accepts, out of :data:`ACCEPTABLE`.
    source : str
        What ``stated`` is called.
    """
    found = _measured(values)
    if PHASE_INDUCTANCE in found and stated is not None and stated.machine.L_d_h == stated.machine.L_q_h:
        found = dict.fromkeys(("L_d_h", "L_q_h"), found[PHASE_INDUCTANCE]) | found
    sheet = _stated(stated, found)
    accepted = {*accept, *(name for group in _TOGETHER if group & set(accept) for name in group)} & set(ACCEPTABLE)
    rows = []
    for name in ORDER:
        own = held.get(name, 0.0)
        measured = found.get(name)
        if name not in sheet and own <= 0.0 and measured is None:
            continue
        row = Row(
            name,
            UNITS.get(name) or MEASURABLE[name].unit,
            stated=sheet.get(name),
            held=own if own > 0.0 else None,
            measured=None if measured is None else measured.value,
            interval=0.0 if measured is None else measured.half,
            factory=defaults is not None and _same(own, defaults.get(name, math.nan)),
            source=source,
        )
        if stated is not None and name in sheet:
            row = _judged(row, stated, found, used=name in used, loaded=loaded)
            if row.verdict == "contradicts" and name in accepted:
                row = replace(row, verdict="accepted")
        elif measured is not None:
            row = replace(row, verdict="measured")
        if name in (RATIO, "L_q_app_h", PHASE_INDUCTANCE) and measured is None:
            continue  # stands for another row only where it was measured
        rows.append(row)
    if stated is not None and _of_another_motor(rows, stated, loaded=loaded):
        rows = [
            replace(row, verdict="NOT CHECKED", cause="", tolerance=f"{row.tolerance}; {OTHER_MOTOR}")
            if row.verdict == "contradicts" and row.measured is None and row.name in HELD and row.name not in used
            else row
            for row in rows
        ]
    if any(row.name == "pole_pairs" and row.verdict == "contradicts" for row in rows):
        follow = ("psi_f_wb", "J_kgm2", RATIO)
        rows = [replace(row, cause=_BY_POLE_PAIRS) if row.cause and row.name in follow else row for row in rows]
    return tuple(rows)


# ---- how a row is judged ----------------------------------------------------------------------------


def _measured(values: Sequence[Mapping[str, Any]]) -> dict[str, _Measured]:
    found = {}
    for value in values:
        vendor = value.get("source") == "vendor"
        if not ("std" in value or vendor) or value.get("check") or not value.get("accepted", True):
            continue
        number = float(value["value"])
        half = VENDOR_SHARE * abs(number) if vendor else float(value.get("total_95") or 0.0)
        bias = (math.nan if value.get(key) is None else float(value[key]) for key in ("i_d_apk", "i_q_apk"))
        at = _Measured(number, half, value.get("T_c") is not None, *bias)
        found[str(value["name"])] = replace(at, bend_per_a=float(value.get("bend_per_a") or 0.0))
    warm = found.get("R_s_ohm")
    if warm is not None and not warm.T_known and R_MEASURED in found:
        # what is allowed covers the temperatures already: they do not count twice
        found["R_s_ohm"] = replace(warm, half=found[R_MEASURED].half)
    if "J_kgm2" not in found and RATIO in found and "psi_f_wb" in found:
        ratio, psi = found[RATIO], found["psi_f_wb"]
        half = ratio.half * psi.value + psi.half * ratio.value
        found["J_kgm2"] = _Measured(ratio.value * psi.value, half, False, math.nan, math.nan)
    if "L_q_h" not in found and "L_q_app_h" in found:
        found["L_q_h"] = found["L_q_app_h"]
    return found


def _stated(file: MachineFile | None, found: Mapping[str, _Measured]) -> dict[str, float]:
    """Return what a file states; of a flux map at the bias of the measurement."""
    if file is None:
        return {}
    machine = file.machine
    values: dict[str, float | None] = {key: getattr(machine, key) for key in HELD}
    values["L_q_app_h"] = machine.L_q_decoupling_h
    if file.flux_map is not None:
        values["psi_f_wb"] = float(file.flux_map.flux(0.0, 0.0)[0])
        for axis, name in enumerate(("L_d_h", "L_q_h")):
            at = found.get(name)
            if at is not None and math.isfinite(at.i_d_apk) and math.isfinite(at.i_q_apk):
                values[name] = float(file.flux_map.incremental_inductance(at.i_d_apk, at.i_q_apk)[axis, axis])
        i_q = 0.5 * (machine.I_nom_apk or 0.0)
        values["L_q_app_h"] = float(file.flux_map.flux(0.0, i_q)[1]) / i_q if i_q else None
    if machine.J_kgm2 and values["psi_f_wb"]:
        values[RATIO] = machine.J_kgm2 / values["psi_f_wb"]
    if machine.L_d_h and machine.L_q_h:
        values[PHASE_INDUCTANCE] = math.sqrt(machine.L_d_h * machine.L_q_h)
    if file.encoder.bits:
        values["encoder_counts"] = float(2**file.encoder.bits)
    return {name: value for name, value in values.items() if value}


def _judged(row: Row, file: MachineFile, found: Mapping[str, _Measured], *, used: bool, loaded: bool) -> Row:
    """Return a row that has a stated value with what that allows, and its verdict."""
    assert row.stated is not None
    stated, measured = row.stated, found.get(row.name)
    if row.name in EXACT:
        return _exact(replace(row, low=row.stated, high=row.stated, tolerance="exact"), used=used)
    low, high, text = _allowed(row.name, stated, file, found, T_known=measured is not None and measured.T_known)
    if loaded and row.name in ("J_kgm2", RATIO):
        high, text = math.inf, f"{text}, any load above it"
    row = replace(row, low=low, high=high, tolerance=text)
    if measured is not None:
        least, most = min(measured.value, measured.at_zero), max(measured.value, measured.at_zero)
        least, most = least - measured.half, most + measured.half
        good = most >= low and least <= high
        if good and row.name == "R_s_ohm" and least * (1.0 - DEVICE_SHARE) > high - _devices_least_ohm(file):
            # another motor's sheet may look the same
            return replace(row, verdict="NOT CHECKED", tolerance=f"{text}; to check it, measure the winding alone")
        if good and measured.half > COARSE * measured.value:
            return replace(row, verdict="NOT CHECKED", tolerance=f"{text}; the measurement is too coarse to check it")
        return replace(row, verdict="agrees" if good else "contradicts", cause="" if good else _cause(row, measured))
    if row.held is None or (row.factory and not used):
        return replace(row, verdict="NOT CHECKED")
    # either value may be that of the winding alone, cold or warm
    spread = max(high / stated, stated / low)
    good = 1.0 / spread <= row.held / stated <= spread
    return replace(row, verdict="NOT CHECKED" if good else "contradicts", cause="" if good else _cause(row, None))


def _of_another_motor(rows: Sequence[Row], file: MachineFile, *, loaded: bool) -> bool:
    """Whether half of what the drive holds, or more, would contradict values of the file that the measurement confirms.

    Half: pole pairs of two motors are often alike.
    """
    confirmed = [row for row in rows if row.verdict == "agrees" and None not in (row.measured, row.held)]
    held = [replace(row, measured=None) for row in confirmed if row.name in HELD and not row.factory]
    other = [_judged(row, file, {}, used=True, loaded=loaded).verdict == "contradicts" for row in held]
    return bool(other) and sum(other) >= 0.5 * len(other)


def _exact(row: Row, *, used: bool) -> Row:
    assert row.stated is not None
    other = row.measured if row.measured is not None else row.held
    if other is None or (row.measured is None and row.factory and not used):
        return replace(row, verdict="NOT CHECKED")
    if row.name == "encoder_counts" and math.log2(other) % 1.0:
        good = abs(math.log2(other / row.stated)) < 1.0  # a file states whole bits only
    else:
        good = round(other) == round(row.stated)
    if good:
        told = row.measured is not None or row.name == "encoder_counts"
        return replace(row, verdict="agrees" if told else "NOT CHECKED")
    ratio = max(other / row.stated, row.stated / other)
    if row.name == "encoder_counts":
        cause = f"lines, edges or bits of the encoder (ratio {ratio:.4g})"
    elif row.measured is not None and ratio in (4.0, 8.0, 16.0):
        cause = f"integer ratio {ratio:g}: encoder counts per turn (lines instead of edges, wrong bits)"
    elif ratio == 2.0:
        cause = "ratio 2: poles instead of pole pairs, or encoder counts per turn"
    elif row.measured is None:
        cause = _OTHER_SET_UP
    else:  # 10000 counts of 2500 lines stated as 8000: 5 pole pairs of 4
        cause = f"{_OTHER}, or encoder counts per turn (ratio {Fraction(round(other), round(row.stated))})"
    return replace(row, verdict="contradicts", cause=cause)


def _allowed(
    name: str, value: float, file: MachineFile, found: Mapping[str, _Measured], *, T_known: bool
) -> tuple[float, float, str]:
    """Return the range a stated value allows, and how that is called."""
    share, text = stated_share(name, file)
    # a catalogue does not say whether its share is of what it states or of what is there
    low, high = 1.0 - share, 1.0 + share if name in file.std else 1.0 / (1.0 - share)
    machine = file.machine
    span = f"{UNKNOWN_T_RANGE_C[0]:g} to {UNKNOWN_T_RANGE_C[1]:g} degC"
    if name == RATIO:
        over, _ = stated_share("J_kgm2", file)
        under, _ = stated_share("psi_f_wb", file)
        low, high = (1.0 - over) / (1.0 + under), (1.0 + over) / (1.0 - under)
    if name == "R_s_ohm":
        devices = 0.0
        winding_alone = machine.R_winding_ohm == machine.R_s_ohm
        if winding_alone or (name not in file.std and machine.R_winding_ohm is None):
            devices, least = high * DEVICE_SHARE / (1.0 - DEVICE_SHARE), _devices_least_ohm(file) / value
            up_to = f"{100.0 * DEVICE_SHARE:g} % of the loop"
            if least > devices:
                devices, up_to = least, told(_devices_least_ohm(file), "ohm", 2)
            text = f"{text}, devices and cable up to {up_to}"
        if not T_known:
            cold, hot = (1.0 + machine.alpha_R_per_k * (T - machine.T_ref_c) for T in UNKNOWN_T_RANGE_C)
            low, high, text = low * min(1.0, cold), high * max(1.0, hot), f"{text}, {span}"
        high += devices
    if name in ("psi_f_wb", RATIO) and not (T_known and name == "psi_f_wb"):
        magnets = [1.0 + machine.alpha_psi_per_k * (T - machine.T_ref_c) for T in UNKNOWN_T_RANGE_C]
        if name == RATIO:
            magnets = [1.0 / factor for factor in magnets]
        low, high = low * min(1.0, *magnets), high * max(1.0, *magnets)
        text = f"{text}, magnets {span}"
    if name == PHASE_INDUCTANCE:
        axes = (machine.L_d_h, machine.L_q_h)
        return low * min(axes), high * max(axes), text
    one = machine.L_d_h == machine.L_q_h and file.flux_map is None and name not in file.std
    if one and name in ("L_d_h", "L_q_h", "L_q_app_h"):
        larger = name != _smaller_axis(found)
        low, high = (low, high * SALIENCY) if larger else (low / SALIENCY, high)
        text = f"{text}, one value for both axes"
    return low * value, high * value, text


def _devices_least_ohm(file: MachineFile) -> float:
    """Return the resistance that devices and cable may have at least behind this motor (ohm)."""
    I_nom = file.machine.I_nom_apk
    return max(DEVICES_LEAST_OHM, DEVICES_LEAST_V / I_nom if I_nom else 0.0)


def flux_doubt(file: MachineFile) -> float:
    """Return the share (95 %) by which the flux linkage as stated may be wrong, at a temperature that nothing tells."""
    return math.hypot(stated_share("psi_f_wb", file)[0], file.machine.alpha_psi_per_k * UNKNOWN_TEMPERATURE_K)


def stated_share(name: str, file: MachineFile) -> tuple[float, str]:
    """Return the relative tolerance of a stated value: of its deviations where the file has them."""
    if name == RATIO:
        text = " and ".join(stated_share(key, file)[1] for key in ("J_kgm2", "psi_f_wb"))
        return 0.0, text
    value = getattr(file.machine, name, None)
    if name in file.std and value:
        share = (COVERAGE * file.std[name] + file.systematic.get(name, 0.0)) / abs(value)
        return min(share, 0.99), f"{100.0 * share:.2g} % by its [std]"
    share = TOLERANCE.get(name, TOLERANCE["L_d_h"])
    return share, f"data sheet {100.0 * share:g} %"


def _smaller_axis(found: Mapping[str, _Measured]) -> str:
    """Return the axis of the smaller inductance as far as both are measured; d where not."""
    if "L_d_h" in found and "L_q_h" in found and found["L_q_h"].value < found["L_d_h"].value:
        return "L_q_h"
    return "L_d_h"


def _cause(row: Row, measured: _Measured | None) -> str:
    other = row.held if measured is None else measured.value
    assert other and row.stated
    ratio = other / row.stated
    name = "J_kgm2" if row.name == RATIO else "L" if row.name.startswith("L_") else row.name
    size = max(ratio, 1.0 / ratio)
    near = sorted((abs(math.log(size / factor)), factor, text) for factor, text in _CAUSES[name])
    if near[0][0] < RATIO_SHARE:
        return f"{near[0][2]} (x{size:.3g} is near {near[0][1]:.4g})"
    if row.name == RATIO:
        return f"{_RATIO} (x{ratio:.3g})"
    return f"{_SHAFT if name == 'J_kgm2' and ratio > 1.0 else _OTHER} (x{ratio:.3g})"


def _same(held: float, default: float) -> bool:
    return abs(held - default) <= FACTORY_SHARE * abs(default)
