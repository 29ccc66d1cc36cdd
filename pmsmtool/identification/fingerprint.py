# SPDX-License-Identifier: MIT
"""Whether the machine is the one of an earlier run: its values, measured again, compared with those recorded then."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pmsmtool.errors import ConfigError
from pmsmtool.estimators.estimate import COVERAGE_FACTOR
from pmsmtool.files import read_text
from pmsmtool.identification.by_pulses import read_facts
from pmsmtool.identification.by_vendor import ANSWERS
from pmsmtool.identification.compared_runs import Difference, differences, same_drive, told
from pmsmtool.identification.request import MACHINE, REQUEST, IdentifyRequest, Method, parse_request
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import Estimate, MachineParameters
from pmsmtool.run_directory import Acceptance, RunDirectory, RunRecord, Stage

STAGE = "fingerprint"
COMPARED: Mapping[str, tuple[str, ...]] = {
    "R": ("R_s_ohm",), "L": ("L_d_h", "L_q_h", "L_q_app_h"), "psi": ("psi_f_wb",),
    "encoder": ("direction", "offset_rad"), "poles": ("pole_pairs",), "mechanics": ("J_kgm2", "J_per_psi"),
}  # fmt: skip
"""Values of a quantity that are compared, by the keys of the machine file; a run has those of its level."""
QUANTITIES = ("R", "L", "psi", "encoder", "poles")
"""What is compared unless something is asked for."""
ACCURACY = 0.02
"""What is collected is enough for this (``identify --accuracy``): the least there is, which left at most 0.45 % of 12
random drives (``benchmarks/machine_time.py``)."""
OTHER_BIAS = 0.05
"""Relative difference of the bias currents from which on inductances are not compared: the machine may saturate."""
TURNS_SHARE = 0.25
"""L goes with the square of psi over the number of turns; within this of it, the winding has another number."""
THIRD_TURN_RAD = math.radians(10.0)
"""Within this of a third of an electrical turn, the leads are shifted."""
_NO_VALUES = "give a run that identified them, or name others"


@dataclass(frozen=True, slots=True)
class Earlier:
    """What a run recorded."""

    run: str
    """Name of its directory."""
    level: Method
    """How it measured, as ``identify --method`` names it."""
    drive: Mapping[str, Any]
    """Identity of its drive."""
    request: IdentifyRequest
    """What it was asked."""
    estimates: Mapping[str, Estimate]
    """Accepted values by their keys."""
    machine: MachineParameters | None
    """What it knew of winding and magnets."""

    def measurable(self, quantities: Iterable[str]) -> tuple[str, ...]:
        """Return the quantities of which the run has a value.

        Raises ConfigError: one that is no single value is asked for, or the run has none of them.
        """
        asked = tuple(quantities)
        strange = [name for name in asked if name not in COMPARED]
        if strange:
            raise ConfigError(
                f"--fingerprint compares single values, not {', '.join(strange)}", hint=f"name {', '.join(COMPARED)}"
            )
        found = tuple(name for name in asked if set(COMPARED[name]) & set(self.estimates))
        if not found:
            raise ConfigError(f"the run has no value of {', '.join(asked)}", where=self.run, hint=_NO_VALUES)
        return found


def read_earlier(run: RunDirectory) -> Earlier:
    """Return what a run recorded.

    Raises ConfigError: it identified nothing that has an interval, or one of its files is gone or damaged.
    """
    record = run.read()
    if record.stage("identify") is None:
        raise ConfigError("nothing was identified in this run", where=str(run.path), hint=_NO_VALUES)
    if (run.path / ANSWERS).is_file():
        raise ConfigError(
            "the drive measured by itself in this run: its values have no interval", where=str(run.path),
            hint="give a run with another --method",
        )  # fmt: skip
    facts = read_facts(run)
    level = facts.kind if facts else Method.INJECT
    text = read_text(run.path / REQUEST, hint="the run is not complete: give another one")
    request = parse_request(text, where=str(run.path / REQUEST))
    file = _machine_file(run)
    estimates = recorded(record, file)
    return Earlier(run.path.name, level, record.drive, request, estimates, None if file is None else file.machine)


def _machine_file(run: RunDirectory) -> MachineFile | None:
    return load_machine_file(run.path / MACHINE) if (run.path / MACHINE).is_file() else None


def recorded(record: RunRecord, file: MachineFile | None) -> dict[str, Estimate]:
    """Return the accepted values with an interval that the last identification of a run recorded."""
    stage = record.stage("identify")
    found = {}
    for value in () if stage is None else stage.values:
        numbers = [value.get(key, math.nan) for key in ("value", "std", "systematic")]
        if not value.get("accepted", True) or "check" in value or not all(map(math.isfinite, numbers)):
            continue
        std = numbers[1] * value.get("coverage_factor", COVERAGE_FACTOR) / COVERAGE_FACTOR
        T_c, i_d = (math.nan if value.get(key) is None else float(value[key]) for key in ("T_c", "i_d_apk"))
        found[str(value["name"])] = Estimate(
            numbers[0], std, numbers[2], str(value["unit"]), T_c=T_c, i_d_apk=i_d
        )  # fmt: skip
    if file is not None and "offset_rad" in found:
        found["direction"] = Estimate(float(file.encoder.direction), 0.0, 0.0, "1")
    return found


def fingerprint_stage(
    earlier: Earlier, run: RunDirectory, asked: Sequence[str]
) -> tuple[Stage, list[Difference], dict[str, str]]:
    """Compare a run with an earlier one; return the stage as it is recorded, the rows, and what was not compared.

    The limits hold for all values together: 95 % of equal machines agree in every one.
    """
    record = run.read()
    file = _machine_file(run)
    now = recorded(record, file)
    known = earlier.machine or (None if file is None else file.machine)
    wanted = {key for quantity in asked for key in COMPARED[quantity]}
    left = _not_compared(earlier.estimates, now, asked, record.stage("identify"))
    both = {key for key in wanted if key in earlier.estimates and key in now and key not in left}
    rows = differences(
        {key: earlier.estimates[key] for key in both}, {key: now[key] for key in both},
        same_sensors=same_drive(earlier.drive, record.drive), machine=known, together=True,
    )  # fmt: skip
    changed = [row.name for row in rows if row.verdict == "differs"]
    same = [row.name for row in rows if row.verdict == "agrees"]
    lines = [f"{name} not compared: {why}" for name, why in left.items()]
    parts = (("SAME", same), ("DIFFERENT", changed), ("not compared", list(left)))
    stage = Stage(
        STAGE,
        "fail" if changed else "partial" if left else "pass",
        0.0,
        values=[{**asdict(row), "verdict": verdict_of(row)} for row in rows],
        acceptance=[_acceptance(row, earlier.run) for row in rows],
        note="; ".join([*likely_causes(rows), *([] if changed else lines)]),
        summary="; ".join(f"{word}: {', '.join(names)}" for word, names in parts if names),
    )
    return stage, rows, left


def verdict_of(row: Difference) -> str:
    """``SAME`` or ``DIFFERENT``."""
    return "SAME" if row.verdict == "agrees" else "DIFFERENT"


def _not_compared(
    then: Mapping[str, Estimate], now: Mapping[str, Estimate], asked: Collection[str], stage: Stage | None
) -> dict[str, str]:
    """Return which values of what was asked are in one run only, or not comparable, with the reason."""
    refused = {} if stage is None else stage.refused
    left = {}
    for quantity in asked:
        keys = [key for key in COMPARED[quantity] if key in then or key in now]
        if not keys:
            left[quantity] = "the earlier run has no accepted value"
        for key in keys:
            if key not in then:
                left[key] = "the earlier run has no accepted value"
            elif key not in now:
                left[key] = refused.get(quantity, "no value was accepted in this run")
            elif quantity == "L" and _apart(then[key].i_d_apk, now[key].i_d_apk):
                left[key] = f"measured at {then[key].i_d_apk:.3g} A then and {now[key].i_d_apk:.3g} A now (--i-max)"
    return left


def _apart(one: float, other: float) -> bool:
    return abs(one - other) > OTHER_BIAS * max(abs(one), abs(other))


def _acceptance(row: Difference, run: str) -> Acceptance:
    _, _, _, difference, interval = told(row)
    return Acceptance(f"{row.name}: as in {run}", f"difference {difference}", interval, row.verdict == "agrees")


def likely_causes(rows: Iterable[Difference]) -> list[str]:
    """Return what probably makes the rows differ that do; the same machine gives none."""
    found = {row.name: row for row in rows}
    changed = {row.name for row in found.values() if row.verdict == "differs"}
    winding = changed & {"R_s_ohm", "L_d_h", "L_q_h", "L_q_app_h", "psi_f_wb"}
    causes = []
    if "pole_pairs" in changed:
        return ["another motor: other pole pairs"]
    if "direction" in changed:
        causes.append("two motor leads are swapped, or the encoder counts the other way")
    elif "offset_rad" in changed:
        shifted = abs(abs(found["offset_rad"].difference) - 2.0 * math.pi / 3.0) < THIRD_TURN_RAD
        causes.append("the motor leads are shifted by one" if shifted else "the encoder was moved on its shaft")
    if _other_turns(found, winding):
        causes.append("rewound with another number of turns, or another motor of the series")
    elif winding == {"psi_f_wb"}:
        weaker = found["psi_f_wb"].difference < 0.0
        causes.append("magnets weakened (demagnetised), or hotter than the sensor shows" if weaker else
                      "another rotor, or magnets colder than the sensor shows")  # fmt: skip
    elif winding == {"R_s_ohm"}:
        causes.append("another cable or joint, or a winding of another temperature than the sensor shows")
    elif winding and not winding & {"R_s_ohm", "psi_f_wb"}:
        causes.append("another rotor or air gap, or iron that saturates at another current")
    elif winding:
        causes = ["another motor"]  # its encoder sits otherwise, too
    if not causes and changed & {"J_kgm2", "J_per_psi"}:
        causes.append("another load or coupling on the shaft")
    return causes


def _other_turns(found: Mapping[str, Difference], winding: Collection[str]) -> bool:
    """Whether L and psi changed as another number of turns makes them: psi with it, L with its square."""
    inductances = [name for name in ("L_d_h", "L_q_h") if name in found]
    if "psi_f_wb" not in winding or not inductances:
        return False

    def growth(name: str) -> float:
        row = found[name]
        assert row.first is not None and row.second is not None
        return math.log(row.second / row.first) if row.second / row.first > 0.0 else math.inf

    turns = growth("psi_f_wb")
    return all(abs(growth(name) - 2.0 * turns) < TURNS_SHARE * abs(2.0 * turns) for name in inductances)
