# SPDX-License-Identifier: MIT
"""What an identification is asked: quantities, the experiments behind them, and the request as a run keeps it.

Whether the accuracy that was asked for is reached: statistical and misfit part of R, L and psi, relative, 95 %. With it
the files of an identification in its run: traces, machine file, and the records of what went on meanwhile.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError, IdentificationError, NotAvailable
from pmsmtool.estimators.estimate import SensorTolerance, statistical_half_width
from pmsmtool.files import make_folder
from pmsmtool.identification.prediction import NAMES
from pmsmtool.machine.machine_file import MachineFile, load_machine_file
from pmsmtool.machine.parameters import Brake, Estimate, Load, Shaft
from pmsmtool.run_directory import RunDirectory, RunRecord
from pmsmtool.trace import Trace, read_trace

MACHINE = "machine.toml"
NAMEPLATE = "nameplate.toml"
REPLAYED = "replayed"
"""Folder of a run for what a replay makes of it once a design stands on its machine file."""
_MADE_FROM_MACHINE = ("design.toml", "params.toml")
PREDICTED = "predicted.json"
"""What was said before the machine moved."""
SCHEMA = "pmsmtool.predicted/1"


def read_run(path: Path) -> tuple[RunRecord, MachineFile]:
    """Return the record of a run and the machine it identified; raises ``ConfigError`` where it identified none."""
    record = RunDirectory(path).read()
    if not (path / MACHINE).is_file():
        raise ConfigError(
            f"the run has no {MACHINE}: nothing was identified",
            where=str(path),
            hint="`pmsmtool report RUN` says how it ended",
        )
    return record, load_machine_file(path / MACHINE)


def entry(before: str, relative_std: Mapping[str, float], **more: object) -> dict[str, Any]:
    """Return one prediction: before which experiment it was said, and relative standard deviations by key."""
    return {"before": before, "relative_std": dict(relative_std), **more}


LEFT_OUT = "left_out"
"""Field of an entry: what is not collected for an accuracy, by quantity; the last one counts."""


def left_out_of(run: RunDirectory) -> dict[str, str]:
    """Return what a run did not collect because an accuracy was asked for, by quantity."""
    path = run.path / PREDICTED
    entries = json.loads(path.read_text(encoding="utf-8"))["predictions"] if path.is_file() else []
    return next((entry[LEFT_OUT] for entry in reversed(entries) if LEFT_OUT in entry), {})


def dump_predicted(entries: list[dict[str, Any]]) -> str:
    """Return the file's text."""
    return json.dumps({"schema": SCHEMA, "predictions": entries}, indent=1) + "\n"


REFUSED = "refused.json"
"""Experiments that ended before their traces were whole, by the keys of ``evaluate.Evaluation.refused``."""


def dump_refused(refused: Mapping[str, IdentificationError]) -> str:
    """Return refusals as JSON."""
    facts = {
        name: {"reason": e.reason, "what": e.what.partition(": ")[2], "where": e.where, "likely": e.likely,
               "hint": e.hint}
        for name, e in refused.items()
    }  # fmt: skip
    return json.dumps(facts, indent=1) + "\n"


def refused_in(run: RunDirectory) -> dict[str, IdentificationError]:
    """Return the refusals of a run; raises ``ConfigError`` where their record is damaged."""
    path = run.path / REFUSED
    if not path.is_file():
        return {}
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        return {name: IdentificationError(**error) for name, error in facts.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"the record of what was refused is damaged: {error}", where=str(path), hint="identify again"
        ) from error


def place_of(run: RunDirectory, text: str) -> tuple[RunDirectory, str]:
    """Return where a machine file goes, and the beginning of its name in the run: beside one a design was made from."""
    return (run, "") if _may_write(run, text) else (_beside(run), f"{REPLAYED}/")


def _may_write(run: RunDirectory, text: str) -> bool:
    """Whether a machine file may stand in the run: nothing was made from it yet, or it is the one that was used."""
    if not any((run.path / name).is_file() for name in _MADE_FROM_MACHINE):
        return True
    recorded = run.read().stage("identify")
    used = run.sha256(MACHINE) if (run.path / MACHINE).is_file() else recorded and recorded.files.get(MACHINE)
    return hashlib.sha256(text.encode()).hexdigest() == used


def _beside(run: RunDirectory) -> RunDirectory:
    folder = run.path / REPLAYED
    make_folder(folder, hint="check your rights there and the space on the disk")
    return RunDirectory(folder)


def stored_traces(run: RunDirectory) -> dict[str, Trace]:
    """Return the traces of a run by name."""
    return {path.stem: read_trace(path) for path in trace_files(run)}


def trace_files(run: RunDirectory) -> list[Path]:
    """Return the files of the traces of a run, by name."""
    return sorted((run.path / "traces").glob("*.npz"))


KEYS: Mapping[str, tuple[str, ...]] = {"R": ("R_s_ohm",), "L": ("L_d_h", "L_q_h"), "psi": ("psi_f_wb",)}
"""Machine-file keys of the quantities that an accuracy can be asked of."""


def accuracy_facts(
    asked: float | None, quantities: Iterable[str], found: Mapping[str, Estimate], left_out: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """Return for every value that was asked for its half width (None: no value) and whether it is small enough.

    And what was left out for that, where anything was.

    Parameters
    ----------
    asked : float or None
        Relative half width (1); None: nothing is returned.
    quantities : iterable of str
        What was asked for, ``R L psi ...``.
    found : mapping of str to Estimate
        By machine-file key.
    left_out : mapping of str to str
        As :func:`left_out_of`.
    """
    if asked is None:
        return {}
    facts: dict[str, dict[str, Any]] = {}
    for key, quantity in ((key, name) for name in quantities for key in KEYS.get(name, ())):
        estimate = found.get(key)
        half = None
        if estimate is not None and estimate.value:
            half = statistical_half_width(estimate) / abs(estimate.value)
        facts[key] = {"asked": asked, "statistical_95": half, "reached": half is not None and half <= asked}
        facts[key] |= {LEFT_OUT: left_out[quantity]} if quantity in left_out else {}
    return facts


def accuracy_told(values: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the facts that the values of a stage keep as ``accuracy``; empty where none was asked for."""
    return {value["name"]: value["accuracy"] for value in values if "accuracy" in value}


def accuracy_line(facts: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the facts as a person reads them; empty without any."""
    if not facts:
        return ""
    parts, missed = [], []
    for key, fact in facts.items():
        half = fact["statistical_95"]
        parts.append(f"{NAMES[key]} {'no value' if half is None else f'{100.0 * half:.2g} %'}")
        if not fact["reached"]:
            missed.append(NAMES[key])
    asked = next(iter(facts.values()))["asked"]
    verdict = f"not reached: {', '.join(missed)}" if missed else "reached"
    return f"accuracy {100.0 * asked:.3g} % (95 %, without the sensors' part): {', '.join(parts)}; {verdict}"


COUNTS = "counts_per_turn"
"""Key of the zero-current trace's ``meta``: the encoder's counts per turn, as the drive states them."""


class Method(StrEnum):
    """Ways to a quantity, as ``identify --method`` names them."""

    INJECT = "inject"
    RECORDER = "recorder"
    STANDARD = "standard"
    VENDOR = "vendor"
    MANUAL = "manual"


QUANTITIES = ("R", "L", "psi", "encoder", "poles", "inverter", "mechanics")
"""What is measured unless something is asked for: all that current and speed control need."""
NEEDS: Mapping[str, tuple[str, ...]] = {
    "R": ("levels",),
    "inverter": ("levels",),
    "poles": ("rotation",),
    "encoder": ("levels", "rotation", "square", "speeds"),
    "L": ("levels", "rotation", "square"),
    "psi": ("levels", "rotation", "square", "speeds"),
    "mechanics": ("levels", "rotation", "square", "speeds", "coasting"),
    "map": ("levels", "rotation", "square", "speeds", "map"),
    "frf": ("levels", "rotation", "square", "speeds", "response"),
    "cogging": ("levels", "rotation", "square", "speeds", "coasting", "slow"),
    "harmonics": ("levels", "rotation", "square", "speeds", "turns"),
}
"""Experiments behind each quantity."""
HELD = ("levels", "map")
"""Experiments that a held rotor allows."""


def steps_of(quantities: Iterable[str], held: bool = False) -> set[str]:
    """Return the experiments behind quantities; of a held rotor only those that it allows."""
    steps = {step for quantity in quantities for step in NEEDS[quantity]}
    return steps & set(HELD) if held else steps


REQUEST = "request.json"
"""What was asked, as far as the estimates depend on it: a replay is to give the same bytes."""


@dataclass(frozen=True, slots=True)
class IdentifyRequest:
    """What is asked, and what the machine may do meanwhile; None leaves the choice to the drive's own ratings."""

    quantities: tuple[str, ...] = QUANTITIES
    """Out of ``R L psi encoder poles inverter mechanics map frf cogging harmonics``."""
    i_max_apk: float | None = None
    speed_max_rad_s: float | None = None
    """Envelope (A peak, rad/s mechanical)."""
    shaft: Shaft = "free"
    load: Load = "none"
    brake: Brake = "none"
    """What hangs on the shaft and may happen to it."""
    accuracy: float | None = None
    """Statistical 95 % half width, relative, of R, L and psi at which the run stops collecting; None: all of it."""
    map_if_saturated: bool = False
    """Whether a machine that the run over speeds shows to saturate is mapped, too."""
    resonance: bool = False
    """Whether the shaft's frequency response is measured without being judged: an elastic shaft decides the speed
    loop, and nothing else shows it."""
    tolerance: SensorTolerance = field(default_factory=SensorTolerance)
    """Declared sensor tolerances."""
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Quantities that a person named beside these, and why this drive does not give them: refused by that reason."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Quantities whose experiments are run."""
        return (*self.quantities, "frf") if self.resonance and self.shaft != "locked" else self.quantities

    def check(self) -> None:
        """Refuse what cannot be asked.

        Raises ConfigError: an unknown quantity; NotAvailable: a quantity that needs a turning shaft, on a shaft that
        must not turn.
        """
        unknown = [name for name in self.quantities if name not in NEEDS]
        if unknown or not self.quantities:
            files = any(name.endswith(".toml") for name in unknown)
            raise ConfigError(
                f"cannot identify {', '.join(unknown) or 'nothing'}",
                likely="identify reads no motor file, it asks the drive; `commission FILE` compares" if files else "",
                hint=f"choose from {', '.join(NEEDS)}, hall alone, or all",
            )
        if self.accuracy is not None and not set(self.quantities) & set(KEYS):
            raise ConfigError(
                f"--accuracy is that of {', '.join(KEYS)}, and none of them is asked for",
                hint="leave --accuracy out, or identify one of them, too",
            )
        turning = [name for name in self.quantities if name != "map" and set(NEEDS[name]) & {"rotation", "speeds"}]
        if turning and self.shaft == "locked":
            raise NotAvailable(
                f"{', '.join(turning)} cannot be identified on a locked shaft: the rotor must turn",
                hint="free the shaft, or identify R, inverter and map only",
            )


def dump_request(request: IdentifyRequest) -> str:
    """Return a request as JSON: what an estimate depends on besides traces and nameplate."""
    facts = asdict(request)
    if request.accuracy is None:
        del facts["accuracy"]  # a run without one keeps its bytes
    if not request.left_out:
        del facts["left_out"]  # likewise
    if math.isinf(request.tolerance.U_dc_v):
        del facts["tolerance"]["U_dc_v"]  # comes from the nameplate, and JSON has no infinity
    return json.dumps(facts, indent=1) + "\n"


def parse_request(text: str, *, where: str) -> IdentifyRequest:
    """Return the request of a run. Raises ConfigError: it is not what :func:`dump_request` writes."""
    try:
        facts = json.loads(text)
        facts.pop("half_frequency", None)  # of runs before it was taken out
        tolerance = SensorTolerance(**facts.pop("tolerance"))
        request = IdentifyRequest(tolerance=tolerance, **{**facts, "quantities": tuple(facts["quantities"])})
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(
            f"the recorded request is damaged: {error}",
            where=where,
            hint="identify again; or take the file from a copy of the run",
        ) from error
    request.check()
    return request
