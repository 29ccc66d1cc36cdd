# SPDX-License-Identifier: MIT
"""The gate between identification and everything that stands on it: MACHINE, the drive and the measurement agree."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

from pmsmtool.commissioning.contradiction import ACCEPTABLE, DATA_SHEET, EXACT, HELD, ORDER, RATIO, compare
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.motion_objects import encoder_counts
from pmsmtool.drive.standard_drive import RecorderDrive
from pmsmtool.errors import ConfigError, Contradiction, SafetyRefusal, SdoAbort
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.identification.request import Method
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.parameters import Estimate
from pmsmtool.measurement.capabilities import Capabilities
from pmsmtool.params.parameter_set import default_set
from pmsmtool.plain_text import by_reason
from pmsmtool.report.comparison import contradictions
from pmsmtool.run_directory import RunDirectory, Stage

CONTRADICTS = "machine file, drive and measurement contradict each other; nothing was written"
UNMOVED = "machine file and drive contradict each other; nothing was moved, nothing was written"
LEAST_COUNTS = 64
"""Fewer increments per turn are a drive's unset 0x608F (1 : 1), not an encoder's."""
_KEYS = {"encoder_counts": "[encoder] bits", "J_per_psi": "J_kgm2 or psi_f_wb", "L_phase_h": "L_d_h and L_q_h"}
"""Keys of a machine file to correct, where a row is not called by one."""


def check_accepted(names: Collection[str]) -> None:
    """Refuse contradictions that nobody may accept.

    Raises ConfigError: a name of no quantity; SafetyRefusal: a quantity that limits are computed from, or that decides
    how the machine commutates.
    """
    unknown = [name for name in names if name not in ORDER and name not in _NEVER]
    if unknown:
        raise ConfigError(
            f"--accept-contradiction {', '.join(unknown)}: no such quantity",
            hint=f"choose from {', '.join(ACCEPTABLE)}",
        )
    refused = [name for name in names if name not in ACCEPTABLE]
    if refused:
        raise SafetyRefusal(
            f"a contradiction of {', '.join(refused)} cannot be accepted: commutation or a limit follows from it",
            likely="the machine file is that of another motor, or a value in it has another meaning",
            hint=f"correct the machine file; accepted can be {', '.join(ACCEPTABLE)}",
        )


_NEVER = (
    "offset_rad", "direction", "bits", "I_nom_apk", "I_max_apk", "n_nom_rpm", "n_max_rpm", "i_d_min_apk", "i_trip_apk",
    "I_cont_apk", "U_dc_v",
)  # fmt: skip
"""Keys of a machine file that are not compared, and that must not be waved through all the same."""


def held_values(drive: CanopenDrive) -> dict[str, float]:
    """Return what a drive holds of the machine, by key; what it does not show is left out."""
    held: dict[str, float] = {}
    for key in HELD:
        value = drive.parameters.held_value(f"motor.{key}")
        held |= {} if value is None else {key: value}
    with contextlib.suppress(SdoAbort):
        counts = encoder_counts(drive.node)
        if counts is not None and counts >= LEAST_COUNTS:
            held["encoder_counts"] = counts
    return held


def compared(
    stage: Stage,
    drive: CanopenDrive,
    known: tuple[MachineFile, str] | None,
    *,
    loaded: bool = False,
    accept: Collection[str] = (),
) -> Stage:
    """Return the identification stage with its comparison; it fails where a value contradicts.

    Parameters
    ----------
    stage : Stage
        As identification ended it.
    drive : CanopenDrive
        The drive; what it holds is read.
    known : MachineFile and what it is called, optional
        What the design takes where nothing was measured.
    loaded, accept
        As in ``contradiction.compare``.
    """
    defaults = None
    if drive.node.map.staging:
        factory = default_set().values
        defaults = {key: factory[f"motor.{key}"] for key in HELD}
    rows = compare(
        None if known is None else known[0],
        held_values(drive),
        [value for value in stage.values if value.get("accepted", True)],
        defaults=defaults,
        used=("pole_pairs",) if isinstance(drive, RecorderDrive) else (),
        loaded=loaded,
        accept=accept,
        source="" if known is None else known[1],
    )
    stage = replace(stage, comparison=[row.facts() for row in rows])
    wrong = contradictions(stage.comparison)
    if not wrong:
        return stage
    lines = [str(row["text"]) for row in wrong]
    return replace(stage, status="fail", note="\n".join([*lines, *([stage.note] if stage.note else [])]))


def contradicted_unmoved(drive: CanopenDrive, known: MachineFile | None, found: Capabilities) -> Stage | None:
    """Return the identification stage failed before anything moves; None where nothing is known to contradict.

    That is what no measurement of this drive could tell, and the drive commutates by: its encoder counts, and its pole
    pairs where no method of it gives them.
    """
    if known is None:
        return None
    poles = any(row.available for row in found.rows() if row.quantity == "poles" and row.method != Method.MANUAL)
    held = {key: n for key, n in held_values(drive).items() if key in EXACT and not (poles and key == "pole_pairs")}
    rows = [row.facts() for row in compare(known, held, [])]
    wrong = [str(row["text"]) for row in contradictions(rows)]
    return Stage("identify", "fail", 0.0, note="\n".join(wrong), comparison=rows) if wrong else None


def refuse_inertia(known: MachineFile, ratio: Estimate, run: RunDirectory) -> None:
    """Refuse J over psi of moves that is less than MACHINE allows; a load may add any amount.

    Raises Contradiction: the drive counts its current in another unit, or the machine file is that of another motor.
    """
    value = {"name": RATIO, "value": ratio.value, "std": ratio.std, "total_95": total_half_width(ratio)}
    (row,) = (row for row in compare(known, {}, [value], loaded=True) if row.name == RATIO)
    if row.verdict == "contradicts":
        raise Contradiction(
            f"the moves show J/psi of {row.measured:.4g} +-{row.interval:.2g} kg m2/Wb, and the rotor of MACHINE alone "
            f"has {row.stated:.4g} (at least {row.low:.4g}); nothing was written",
            where=str(run.path),
            likely="the drive counts its current in another unit than its map states, or this is another motor",
            hint="correct the unit of the current in the map, or J_kgm2 and psi_f_wb in the machine file",
        )


def refusal(stage: Stage, run: RunDirectory) -> Contradiction | None:
    """Return the error of a stage whose comparison has contradictions; None without any."""
    wrong = contradictions(stage.comparison)
    if not wrong:
        return None
    names = [str(row["name"]) for row in wrong]
    set_up = "" if stage.values else ", or set the drive up for this motor,"
    keys = ", ".join(_KEYS.get(name, name) for name in names)
    hint = f"correct {keys} in the machine file{set_up} and begin a new run"
    if any(row["source"] != DATA_SHEET for row in wrong):
        hint = "give a machine file of this motor (`pmsmtool machine new` writes one) and begin a new run"
    elif all(name in ACCEPTABLE for name in names):
        hint += f"; or, knowing why, add {' '.join(f'--accept-contradiction {name}' for name in names)}"
    return Contradiction(
        "\n  - ".join([CONTRADICTS if stage.values else UNMOVED, *map(_without_cause, wrong)]),
        where=str(run.path),
        likely="; ".join(by_reason(map(_with_ratio, (row for row in wrong if row["cause"])))),
        hint=hint,
    )


def _without_cause(row: Mapping[str, Any]) -> str:
    return str(row["text"]).removesuffix(f"; likely {row['cause']}")


def _with_ratio(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return a value with the ratio by which it is wrong, and the cause alone: several values may share one."""
    cause, _, ratio = str(row["cause"]).partition(" (x")
    return f"{row['name']}{f' x{ratio[:-1]}' if ratio else ''}", cause
