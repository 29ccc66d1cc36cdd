# SPDX-License-Identifier: MIT
"""From a run directory to its report: the files of the run are read, figures drawn from them, the page rendered.

Nothing is measured, and no number is made that the run does not hold.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.axis.move import compared_moves, move_result, same_move, shown
from pmsmtool.commissioning.recomputed_page import loop_margins, recomputed
from pmsmtool.design.design_file import Design, load_design
from pmsmtool.design.loops.current_loop import HOLD_PERIODS
from pmsmtool.design.loops.designed_loops import open_loops
from pmsmtool.design.loops.margins import margin_problem
from pmsmtool.design.minimum_time import TransferProblem, minimum_time
from pmsmtool.design.prediction import Prediction
from pmsmtool.errors import DesignInfeasible, IdentificationError
from pmsmtool.files import read_text
from pmsmtool.identification.by_injection import evaluation_of
from pmsmtool.identification.compared_runs import same_drive
from pmsmtool.identification.evaluate import Evaluation, evaluate, shots_of
from pmsmtool.identification.fingerprint import STAGE as FINGERPRINT
from pmsmtool.identification.flux_map import MAP_FILE
from pmsmtool.identification.iron_loss import IRON_LOSS
from pmsmtool.identification.request import NAMEPLATE, REQUEST, parse_request, stored_traces
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.measurement.run_account import account_lines
from pmsmtool.npz_file import read_npz
from pmsmtool.proof.judgement import judge, with_ripple
from pmsmtool.proof.stage import FOLDER, PREDICTION, read_proof, responses
from pmsmtool.report import figures
from pmsmtool.report.report import Change, Figure, Table, render
from pmsmtool.report.verdict import COMPLETE, Verdict, is_simulated, verdict_of
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage
from pmsmtool.trace import Trace, read_trace

NOT_CHECKED = (
    "Behaviour: the drive's bytes were compared, its step responses were not.",
    "Scale of the sensors: current and voltage gains are taken from the declared tolerances, nothing in the drive can "
    "measure them.",
    "The hardware stop (safe torque off, mains, emergency stop): the stops of this run went over the bus.",
    "Continuous torque and temperatures under load.",
)
"""What a reader of a green report must not assume, besides what was not measured of the machine."""
EFFECTS = {"cogging_nm": "cogging", "psi_5_wb": "harmonics of the back-EMF", IRON_LOSS: "iron losses"}
"""Values that show an effect, and what it is called."""
SERVED = ("socketcand", "virtual", "udp_multicast")
"""Interfaces of python-can behind which another program may stand instead of a drive."""
ANY_DRIVE = (
    "Whether a real drive answered: the bus is {}, and only a simulated drive of this program names itself (0x1008)."
)
MOVE, TRACE_OF_MOVE = "move", "traces/move.npz"
ONE_STAGE = ("identify", "track", "prove", MOVE)
"""Commands whose run is one stage of the same name."""
CHAINS = ("commission", "fleet")
"""Commands whose run is a full commissioning."""
NO_DATA_SHEET = "Data sheet: no machine file was given, so the measured values were compared with none."
NOTHING_COMPARED = "What the drive holds and how it behaves: neither was compared with the design."


def report_page(path: str | Path) -> str:
    """Return the report of a run as one self-contained HTML page.

    Raises
    ------
    ConfigError
        There is no run in the folder, or one of its files is damaged.
    """
    run = RunDirectory(Path(path))
    record = run.read()
    design = load_design(run.path / "design.toml") if (run.path / "design.toml").is_file() else None
    moves = _moves(run, record)
    drawn = [
        *_of_stage("identify", 1.0, _identification_figures(run, record)),
        *_of_stage("tune", 2.0, _design_figures(design)),
        *_of_stage("margins", 2.5, _margin_figures(record, design)),
        *_of_stage("lut", 3.0, _table_figures(run.path / "lut.npz")),
        *_proof_figures(run, record, design),
        *_of_stage(MOVE, 4.0, _move_figures(moves)),
    ]
    not_checked = NOT_CHECKED[1:] if record.passed("prove") else NOT_CHECKED
    if not any(record.passed(stage) for stage in ("flash", "verify", "prove")):
        not_checked = (NOTHING_COMPARED, *NOT_CHECKED[1:])
    identified = record.stage("identify")
    not_checked = (*not_checked, _unmeasured(identified))
    if identified is not None and identified.comparison and not any(row.get("stated") for row in identified.comparison):
        not_checked = (*not_checked, NO_DATA_SHEET)
    if not is_simulated(asdict(record)) and record.bus.get("interface") in SERVED:
        not_checked = (ANY_DRIVE.format(record.bus["interface"]), *not_checked)
    again = recomputed(design) if design is not None and "current_q" in design.loops else None
    return render(asdict(record), figures=drawn, changes=_changes(record), not_checked=not_checked,
                  complete=_complete(record), ended=account_lines(record.account), recomputed=again,
                  moves=_move_table(moves))  # fmt: skip


def _unmeasured(identified: Stage | None) -> str:
    """Return which effects of a machine nothing of the run has measured."""
    values, files = ([], {}) if identified is None else (identified.values, identified.files)
    known = {value["name"] for value in values if value.get("accepted", True)}
    mapped = any(Path(name).name == MAP_FILE for name in files)
    saturation = "currents of the flux map" if mapped else "bias points that are named"
    lacking = [effect for name, effect in EFFECTS.items() if name not in known]
    return ", ".join([f"Saturation beyond the {saturation}", *lacking, "slot harmonics of L."])


def verdict(path: Path) -> Verdict:
    """Return the verdict of a run; raises ``ConfigError`` when there is none in the folder."""
    record = RunDirectory(path).read()
    return verdict_of(asdict(record), _complete(record))


def _complete(record: RunRecord) -> Sequence[str]:
    """Return the stages that a run must have: of a command of one stage that one, else those of a commissioning."""
    command = next((word for word in record.command if word in (*ONE_STAGE, *CHAINS)), "")
    others = {stage.name for stage in record.stages} - {command, FINGERPRINT}
    return (command,) if command in ONE_STAGE and not others else COMPLETE


def how_it_ended(path: Path) -> list[str]:
    """Return how a run ended that did not come to its end; raises ``ConfigError`` when there is none in the folder."""
    return account_lines(RunDirectory(path).read().account)


def _of_stage(stage: str, weight: float, drawn: Iterator[Figure]) -> list[Figure]:
    """Return the figures of a stage; its first one weighs most."""
    return [replace(figure, stage=stage, weight=weight if k == 0 else 0.0) for k, figure in enumerate(drawn)]


def _identification_figures(run: RunDirectory, record: RunRecord) -> Iterator[Figure]:
    """Draw what the traces of the run say, evaluated again; of a run that was refused, what can be evaluated."""
    traces = stored_traces(run)
    if "zero_current" not in traces:
        return
    period_s = traces["zero_current"].period_s
    identified = record.stage("identify")
    complete = identified is not None and identified.status in ("pass", "partial")
    found = _as_judged(run) if complete else None
    if found is None:
        found = _evaluated(traces, period_s, complete=complete)
    if found is None:
        return
    resistance, inductance, flux = found.resistance, found.inductance, found.flux
    if resistance is not None:
        yield figures.resistance_figure(traces["levels"], resistance.R_measured.value, resistance.curve)
    if inductance is not None and found.encoder is not None:
        shots = {axis: shots_of(traces, axis, round(found.encoder.pole_pairs.value))[0] for axis in "dq"}
        yield figures.inductance_figure(shots, inductance.axes, found.noise.sigma_a)
    if flux is not None:
        yield figures.flux_figure(flux)


def _as_judged(run: RunDirectory) -> Evaluation | None:
    """Return the evaluation that the run's values come from; None where it has none."""
    if not all((run.path / name).is_file() for name in (NAMEPLATE, REQUEST)):
        return None
    request = parse_request(read_text(run.path / REQUEST), where=str(run.path / REQUEST))
    with contextlib.suppress(IdentificationError):
        return evaluation_of(run, load_machine_file(run.path / NAMEPLATE), request)
    return None


_EXPERIMENTS = (("phase_vectors",), ("levels",), ("rotation", "phase_pairs"), ("square",), ("push",), ("speeds",))
"""How the names of their traces begin, in the order the experiments are made."""


def _evaluated(traces: Mapping[str, Trace], period_s: float, *, complete: bool) -> Evaluation | None:
    """Evaluate the traces, leaving out the last experiments until nothing is refused; None when all is.

    ``complete`` says that the run was not ended in the middle of its last experiment.
    """
    if "rotation_forward" in traces:  # the pairs stand for the slow turn where there was none
        traces = {name: trace for name, trace in traces.items() if name != "phase_pairs"}
    begun = [k for k, names in enumerate(_EXPERIMENTS) if any(trace.startswith(names) for trace in traces)]
    count = max(begun, default=0) + (1 if complete else 0)
    for last in range(count, -1, -1):
        kept = ("zero_current", *(name for names in _EXPERIMENTS[:last] for name in names))
        with contextlib.suppress(IdentificationError):
            return evaluate({name: trace for name, trace in traces.items() if name.startswith(kept)}, period_s)
    return None


def _design_figures(design: Design | None) -> Iterator[Figure]:
    loops = {} if design is None else open_loops(design)
    if design is not None and loops:
        found = {name: design.loops[name] for name in loops}
        yield figures.bode_figure(loops, found)
        yield figures.nyquist_figure(loops, found)


MAP_INDUCTANCE, MAP_PERIODS, MAP_POINTS = (0.4, 1.8), (-0.9, 1.5), 15
"""Drawn part of the margin map: inductance over that of the design, delay beside it (control periods), points each."""


def _margin_map(design: Design) -> Iterator[Figure]:
    """Draw the phase margin of the q current loop where inductance and delay are not those of the design."""
    if "current_q" not in design.loops:
        return
    problem = margin_problem(design)
    plant = problem.plants["q"]
    factor = np.linspace(*MAP_INDUCTANCE, MAP_POINTS)
    least = max(HOLD_PERIODS, plant.delay_periods + MAP_PERIODS[0])
    delay = np.linspace(least, plant.delay_periods + MAP_PERIODS[1], MAP_POINTS)
    rows = [loop_margins(problem, "q", factor, float(at - plant.delay_periods)).phase_deg for at in delay]
    yield figures.margin_map_figure(
        factor, delay, np.array(rows), (1.0, plant.delay_periods),
        "Phase margin of the q current loop where the inductance or the delay is not that of the design; below 0 deg "
        "it is unstable.",
    )  # fmt: skip


def _margin_figures(record: RunRecord, design: Design | None) -> Iterator[Figure]:
    stage = record.stage("margins")
    if stage is not None and design is not None:
        yield from _margin_map(design)
    for ending, title in (("phase", "Phase margin"), ("gain", "Gain margin")):
        rows = {}
        unit = ""
        for value in stage.values if stage else ():
            if str(value["name"]).endswith(ending) and "p5" in value:
                least = math.nan if value["least"] is None else float(value["least"])
                rows[str(value["name"])] = (float(value["p5"]), float(value["p50"]), float(value["p95"]), least)
                unit = str(value["unit"])
        if rows:
            caption = (
                f"{title} over the tolerance box of the machine: 5 % to 95 % of the random machines, their median, and "
                "the least value asked for."
            )
            yield figures.band_figure(rows, unit, caption)


def _table_figures(path: Path) -> Iterator[Figure]:
    if not path.is_file():
        return
    arrays = read_npz(path)
    if "largest_speed_rpm" not in arrays:
        return
    lines = {
        name: (arrays[f"{name}_i_d_a"], arrays[f"{name}_i_q_a"])
        for name in ("mtpa", "largest", "mtpv")
        if f"{name}_i_d_a" in arrays and np.isfinite(arrays[f"{name}_i_d_a"]).any()
    }
    binding = [str(name) for name in np.unique(arrays["binding"])]
    I_max = float(json.loads(str(arrays["meta"]))["I_max_apk"])
    yield figures.envelope_figure(arrays["largest_speed_rpm"], arrays["largest_torque_nm"], lines, I_max, binding)


def _proof_figures(run: RunDirectory, record: RunRecord, design: Design | None) -> Iterator[Figure]:
    """Draw the latest proof: what was committed before the first step, and what was measured, verdict first."""
    stage = record.stage("prove")
    named = [run.path / name for name in (stage.files if stage else {}) if name.endswith(f"/{PREDICTION}")]
    begun = sorted(run.path.glob(f"{FOLDER}/*/{PREDICTION}"), key=lambda path: path.stat().st_mtime_ns, reverse=True)
    committed = next((path for path in named or begun if path.is_file()), None)
    if committed is None:
        return
    prediction, traces = read_proof(committed.parent)
    found = responses(traces, prediction)
    prediction = with_ripple(prediction, traces)
    judgement = judge(prediction, found)
    for number, (experiment, text) in enumerate(zip(prediction.t_s, prediction.facts["experiments"], strict=True), 1):
        measured = {signal: values for (name, signal), values in found.items() if name == experiment}
        shares = [line.share for line in judgement.seen if line.what.startswith(f"{experiment}: ")]
        verdict = "not run" if not shares else "inside its band" if max(shares) <= 1.0 else "OUTSIDE its band"
        caption = (
            f"Proof {number}, {verdict}: {text}. Grey: the band predicted and committed before the first step, wider "
            "by the ripple of the record itself."
        )
        fastest = None
        if design is not None and measured and is_current_step(traces[experiment]):
            fastest = _least_times(prediction, traces[experiment], measured, design)
            caption += " Dashed: the same currents after the least time that the voltage allows, without the delay."
        drawn = figures.proof_figure(prediction, experiment, measured, caption, fastest)
        yield replace(drawn, stage="prove", weight=4.0 + max(shares, default=0.0))


STEP_POINTS, STEP_START = 16, 0.05
"""Points of the line of least times, and from which share of the step on: noise is not followed."""


def is_current_step(trace: Trace) -> bool:
    """Return whether a proof's experiment was one step of the q current."""
    asked = trace.meta.get("excitation", {})
    return (asked.get("shape"), asked.get("point")) == ("step", "i_q")


def _least_times(
    prediction: Prediction, trace: Trace, measured: Mapping[str, NDArray[np.float64]], design: Design
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]] | None:
    """Return the least times to currents along a measured step, and these currents."""
    i_d, i_q = measured["i_d_a"], measured["i_q_a"]
    machine = design.machine.machine
    omega = float(np.median(trace["omega_e_rad_s"]))
    U_dc = float(prediction.facts["conditions"]["U_dc_v"])
    problem = TransferProblem(
        machine.R_s_ohm, machine.L_d_h, machine.L_q_h, machine.psi_f_wb, omega,
        U_dc * design["inverter.voltage_utilisation"],
    )  # fmt: skip
    way = np.hypot(i_d - i_d[0], i_q - i_q[0])
    rows = np.unique(np.linspace(0, len(way) - 1, STEP_POINTS).astype(int))
    rows = rows[way[rows] > STEP_START * way.max()]
    try:
        times = [minimum_time(problem, (0.0, 0.0), (float(i_d[k]), float(i_q[k]))) for k in rows]
    except DesignInfeasible:
        return None
    return np.array([0.0, *times]), {"i_d_a": np.array([0.0, *i_d[rows]]), "i_q_a": np.array([0.0, *i_q[rows]])}


def _moves(run: RunDirectory, record: RunRecord) -> dict[str, tuple[Trace, Stage]]:
    """Return the run's move, after the same move of the same drive in the latest run before it, where there is one."""
    stage = record.stage(MOVE)
    if stage is None:
        return {}
    last = read_trace(run.path / TRACE_OF_MOVE)
    runs = (path for path in sorted(run.path.parent.iterdir(), reverse=True) if path.name < run.path.name)
    for path in runs:
        kept = RunDirectory(path).read() if (path / TRACE_OF_MOVE).is_file() else None
        if kept is None or not same_drive(kept.drive, record.drive) or (earlier := kept.stage(MOVE)) is None:
            continue
        before = read_trace(path / TRACE_OF_MOVE)
        if same_move(before, last):
            return {f"before: {path.name}": (before, earlier), f"this run: {run.path.name}": (last, stage)}
    return {f"this run: {run.path.name}": (last, stage)}


def _move_table(moves: Mapping[str, tuple[Trace, Stage]]) -> Table | None:
    """Return the numbers of the moves, and the gains that the drive held, as the report shows them."""
    found = [(move_result(trace), stage.values) for trace, stage in moves.values()]
    if not found:
        return None
    rows = compared_moves(found[0][0], found[-1][0], (found[0][1], found[-1][1]))
    both = len(found) > 1
    cells = [
        (
            row.name, *((shown(row.first, row.unit),) if both else ()), shown(row.second, row.unit),
            *((row.shown_ratio,) if both else ()),
        )
        for row in rows
    ]  # fmt: skip
    heads = ("move", *moves, "now / before") if both else ("move", *moves)
    return heads, [[(text, "") for text in row] for row in cells]


def _move_figures(moves: Mapping[str, tuple[Trace, Stage]]) -> Iterator[Figure]:
    if moves:
        again = "of the same move before and in this run" if len(moves) > 1 else "of the move"
        traces = {name: trace for name, (trace, _) in moves.items()}
        yield figures.move_figure(traces, f"Following error {again}.")


def _changes(record: RunRecord) -> Sequence[Change]:
    stage = record.stage("flash")
    return [] if stage is None else [_change(row) for row in stage.values if "held" in row]


def _change(row: Mapping[str, Any]) -> Change:
    old, asked, held = (f"{float(row[key]):.7g}" for key in ("old", "asked", "held"))
    return Change(str(row["name"]), old, asked, held, str(row["unit"]))
