# SPDX-License-Identifier: MIT
"""Identify machines that have one effect of real machines each, from none to the top of its range.

    python -m benchmarks.real_effects --results effects.jsonl --keep runs

The whole of `identify --yes` runs in the process, over frames, with its default options, on shipped profiles and on
drives of ``random_drives.py``. A row holds the exit code, what was refused, and of every value its error over
the simulated truth and its total 95 % half width (%), of the values that were accepted. With ``--keep`` the runs stay:
``--replay`` makes the table anew from their traces, without the machine. ``--table`` only prints the results.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.commissioning import commanded, prepared
from benchmarks.random_drives import draw_drive
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.files import data_folder
from pmsmtool.identification.replay import replay
from pmsmtool.identification.request import MACHINE
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.machine.torque import iron_drag
from pmsmtool.run_directory import RunDirectory

BASES = ("interior-2k2", "fast-ipm", "random-7", "random-12")
QUANTITIES = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2", "B_nms", "tau_c_nm")
Changes = dict[str, Value]


def truth_of(drive: MachineFile, name: str) -> float:
    return float(drive.simulation_settings()[name])  # type: ignore[arg-type]


def _rated(drive: MachineFile) -> tuple[float, float]:
    """Rated torque (N m) and electrical speed (rad/s)."""
    p = truth_of(drive, "pole_pairs")
    torque = 1.5 * p * truth_of(drive, "psi_f_wb") * float(drive.machine.I_nom_apk or 1.0)
    return torque, p * float(drive.machine.n_nom_rpm or 1.0) * math.pi / 30.0


def _cogging(drive: MachineFile, percent: float) -> Changes:
    slots = 6 * (2 if truth_of(drive, "pole_pairs") < 5 else 3)
    periods = math.lcm(slots, 2 * round(truth_of(drive, "pole_pairs")))
    return {"cogging_nm": 0.01 * percent * _rated(drive)[0], "cogging_periods": periods}


def _emf(drive: MachineFile, percent: float) -> Changes:
    """5th of the back-emf, and 0.6 of it as the 7th."""
    psi = truth_of(drive, "psi_f_wb")
    return {"psi_6_wb": 0.01 * percent * psi / 5.0, "psi_7_wb": 0.006 * percent * psi / 7.0}


def _iron(drive: MachineFile, percent: float) -> Changes:
    """Share of the rated power at rated speed without current."""
    emf = _rated(drive)[1] * truth_of(drive, "psi_f_wb")
    return {"iron_loss_ohm": emf / (0.01 * percent * float(drive.machine.I_nom_apk or 1.0)) if percent else 0.0}


def _eddy(drive: MachineFile, percent: float, time_us: float = 100.0) -> Changes:
    return {"eddy_share": 0.01 * percent, "eddy_time_s": 1e-6 * time_us}


def _inertia(drive: MachineFile, factor: float) -> Changes:
    return {"J_kgm2": factor * truth_of(drive, "J_kgm2")}


def _ripple(drive: MachineFile, percent: float, hz: float = 300.0) -> Changes:
    return {"U_dc_ripple_v": 0.01 * percent * drive.inverter.U_dc_v, "U_dc_ripple_hz": hz}


def _sag(drive: MachineFile, percent: float) -> Changes:
    """Fall of the link at rated power, through a supply whose resistance the link's capacitor sees after 1 ms."""
    torque, speed = _rated(drive)
    power = torque * speed / truth_of(drive, "pole_pairs")
    return {"U_dc_source_ohm": 0.01 * percent * drive.inverter.U_dc_v**2 / power}


def _mismatch(drive: MachineFile, percent: float) -> Changes:
    """Sensors of a and b apart by so much; their mean gain is that of c."""
    return {"sensor_gain_a": 1.0 + 0.005 * percent, "sensor_gain_b": 1.0 - 0.005 * percent}


def _cubic(drive: MachineFile, percent: float) -> Changes:
    return {"sensor_cubic": 0.01 * percent}


def _drift(drive: MachineFile, percent: float) -> Changes:
    """Of the full scale in a minute."""
    return {"sensor_drift_apk_per_s": 0.01 * percent * truth_of(drive, "adc_full_scale_apk") / 60.0}


def _elastic(drive: MachineFile, ratio: float, hz: float = 150.0, damping_percent: float = 2.0) -> Changes:
    """As many times the rotor's inertia behind a shaft, with its resonance and damping."""
    J, w = truth_of(drive, "J_kgm2"), 2.0 * math.pi * hz
    if not ratio:
        return {}
    common = J * ratio / (1.0 + ratio)
    return {
        "J_load_kgm2": ratio * J,
        "coupling_stiffness_nm_per_rad": common * w * w,
        "coupling_damping_nms_per_rad": 0.02 * damping_percent * common * w,
    }


def _backlash(drive: MachineFile, degrees: float) -> Changes:
    """Play of the elastic shaft; of one with the rotor's inertia behind it where there is none yet."""
    shaft = {} if "J_load_kgm2" in drive.simulation else _elastic(drive, 1.0)
    return {**shaft, "backlash_rad": math.radians(degrees)} if degrees else {}


def _stribeck(drive: MachineFile, percent: float) -> Changes:
    """Friction at rest above the Coulomb torque; 1/e of it is left at half a percent of the rated speed."""
    return {"stribeck_share": 0.01 * percent, "stribeck_rpm": 0.005 * float(drive.machine.n_nom_rpm or 1.0)}


def _uneven_friction(drive: MachineFile, percent: float) -> Changes:
    return {"friction_once": 0.01 * percent}


def _tolerances(drive: MachineFile, percent: float) -> Changes:
    """Cogging of the rated torque once per slot and per pole, which only tolerances make."""
    torque, pairs = _rated(drive)[0], round(truth_of(drive, "pole_pairs"))
    return {
        "cogging_slot_nm": 0.01 * percent * torque,
        "cogging_slot_periods": 6 * (2 if pairs < 5 else 3),
        "cogging_pole_nm": 0.01 * percent * torque,
        "cogging_pole_periods": 2 * pairs,
    }


def _uneven_R(drive: MachineFile, percent: float) -> Changes:
    return {"resistance_imbalance": 0.01 * percent}


def _uneven_L(drive: MachineFile, percent: float) -> Changes:
    return {"inductance_imbalance": 0.01 * percent}


def _sixth_L(drive: MachineFile, percent: float) -> Changes:
    return {"inductance_6": 0.01 * percent}


def _drag(drive: MachineFile, share: float) -> Changes:
    """Drag of the air at rated speed, of the Coulomb torque."""
    speed = _rated(drive)[1] / truth_of(drive, "pole_pairs")
    return {"drag_nms2": share * truth_of(drive, "tau_c_nm") / speed**2}


def _magnet(drive: MachineFile, alpha_percent: float) -> Changes:
    """Magnets with another coefficient than the file's, at 60 degC."""
    warm = dict.fromkeys(("T_winding_c", "T_magnet_c", "T_ambient_c"), 60.0)
    return {"alpha_psi_per_k": -0.01 * alpha_percent, **warm} if alpha_percent else {}


def _heating(drive: MachineFile, seconds: float) -> Changes:
    """A winding with so short a time constant that rated current makes 40 K warmer."""
    loss = 1.5 * truth_of(drive, "R_s_ohm") * float(drive.machine.I_nom_apk or 1.0) ** 2
    if not seconds:
        return {}
    warm = {"thermal_resistance_k_per_w": 40.0 / loss, "thermal_capacity_j_per_k": seconds * loss / 40.0}
    return {"thermal_on": True, **warm}


def _encoder(drive: MachineFile, degrees: float) -> Changes:
    return {"encoder_once_rad": math.radians(degrees), "encoder_twice_rad": 0.5 * math.radians(degrees)}


def _scatter(drive: MachineFile, steps: float) -> Changes:
    return {"encoder_noise_rad": steps * 2.0 * math.pi / 2 ** truth_of(drive, "encoder_bits")}


def _lag(drive: MachineFile, microseconds: float) -> Changes:
    return {"sensor_lag_s": 1e-6 * microseconds}


def _latency(drive: MachineFile, microseconds: float) -> Changes:
    return {"encoder_latency_s": 1e-6 * microseconds}


def _load(drive: MachineFile, percent: float) -> Changes:
    """Coulomb friction of a load, of the rated torque."""
    return {"tau_c_nm": truth_of(drive, "tau_c_nm") + 0.01 * percent * _rated(drive)[0]}


EFFECTS: Mapping[str, tuple[Callable[..., Changes], tuple[float, ...]]] = {
    "none": (lambda drive, level: {}, (0.0,)),
    "cogging %": (_cogging, (1.0, 3.0, 5.0, 10.0)),
    "emf 5th 7th %": (_emf, (1.0, 2.0, 5.0, 10.0)),
    "iron loss %": (_iron, (2.0, 5.0, 8.0, 16.0)),
    "eddy branch %": (_eddy, (2.0, 5.0, 10.0, 20.0)),
    "inertia x": (_inertia, (0.02, 0.1, 10.0, 50.0)),
    "DC link ripple %": (_ripple, (1.0, 3.0, 5.0, 10.0)),
    "sensor mismatch %": (_mismatch, (0.5, 1.0, 2.0, 4.0)),
    "elastic J ratio": (_elastic, (0.5, 2.0, 10.0, 20.0)),
    "drag of tau_c": (_drag, (0.5, 2.0, 5.0)),
    "magnet %/K": (_magnet, (0.03, 0.11, 0.2)),
    "heating s": (_heating, (60.0, 10.0, 2.0)),
    "encoder once deg": (_encoder, (0.05, 0.2, 0.5, 1.0)),
    "encoder noise steps": (_scatter, (0.3, 1.0, 3.0, 6.0)),
    "sensor lag us": (_lag, (1.0, 3.0, 10.0)),
    "encoder age us": (_latency, (2.0, 10.0, 50.0)),
    "friction %": (_load, (5.0, 15.0, 30.0)),
    "R imbalance %": (_uneven_R, (1.0, 3.0, 6.0)),
    "L imbalance %": (_uneven_L, (1.0, 3.0, 6.0)),
    "L 6th %": (_sixth_L, (1.0, 5.0, 10.0)),
    "cogging tolerances %": (_tolerances, (0.2, 1.0, 2.0)),
    "Stribeck %": (_stribeck, (20.0, 60.0, 120.0)),
    "friction once %": (_uneven_friction, (5.0, 20.0, 40.0)),
    "backlash deg": (_backlash, (0.05, 0.3, 1.0, 2.0)),
    "sensor cubic %": (_cubic, (0.1, 0.5, 1.0)),
    "sensor drift %/min": (_drift, (0.1, 0.5, 1.0)),
    "DC link sag %": (_sag, (2.0, 10.0, 20.0)),
}
"""Effect -> what it changes in ``[simulation]`` at a level, and the levels; the last one is about twice its range."""


def drive_of(name: str, effect: str, level: float) -> MachineFile:
    """Return a base with an effect."""
    if name.startswith("random-"):
        drive = draw_drive(int(name[7:]))
    else:
        drive = load_machine_file(data_folder("profiles") / f"{name}.toml")
    return replace(drive, simulation={**drive.simulation, **EFFECTS[effect][0](drive, level)})


def values_of(drive: MachineFile, folder: Path) -> dict[str, tuple[float, float]]:
    """Return error and total half width (%) of every accepted value."""
    if not (folder / MACHINE).is_file():
        return {}
    found = load_machine_file(folder / MACHINE).estimates
    truth = {name: truth_of(drive, name) for name in QUANTITIES}
    if "J_load_kgm2" in drive.simulation:
        truth["J_kgm2"] += truth_of(drive, "J_load_kgm2")
    if truth_of(drive, "iron_loss_ohm"):
        magnet = replace(drive.machine, psi_f_wb=truth["psi_f_wb"])
        psi = magnet_flux_at(magnet, truth_of(drive, "T_magnet_c"))  # coasting is braked by the magnet as warm as it is
        truth["B_nms"] += iron_drag(magnet.pole_pairs, psi, truth_of(drive, "iron_loss_ohm"))
    return {
        name: (
            100.0 * (found[name].value / truth[name] - 1.0),
            100.0 * total_half_width(found[name]) / abs(found[name].value),
        )
        for name in QUANTITIES
        if name in found and found[name].value
    }


def identify_one(job: tuple[str, str, float, str, bool]) -> dict[str, Any]:
    """Identify one machine, or replay its run, and return what is judged."""
    name, effect, level, keep, again = job
    drive = drive_of(name, effect, level)
    label = f"{name}_{effect}_{level:g}".replace(" ", "_").replace("%", "pc").replace("/", "_")
    kept = Path(keep).resolve() / label if keep else None
    start, code, told = time.process_time(), 0, ""
    result: dict[str, Any] = {"base": name, "effect": effect, "level": level, "refused": {}, "values": {}}
    with prepared():
        if again:
            if kept is None or not kept.is_dir():
                return {**result, "code": -1, "told": "no run", "seconds": 0.0}
            shutil.copytree(kept, "run")
            folder = Path("run")
            Path("run", MACHINE).unlink(missing_ok=True)
            try:
                stage = replay(RunDirectory(folder))
                result["refused"] = dict(stage.refused)
                code = {"pass": 0, "partial": 10}.get(stage.status, 6)
            except PmsmtoolError as error:
                code, told = 6, str(error)
        else:
            Path("drive.toml").write_text(dump_machine_file(drive, embed_flux_map=True), encoding="utf-8")
            code, told = commanded("identify", "-i", "pmsmsim", "-c", "drive.toml", "--yes")
            folders = list(Path("runs").glob("*/"))
            if not folders:
                return {**result, "code": code, "told": told.splitlines()[-6:], "seconds": time.process_time() - start}
            (folder,) = folders
            stages = [stage for stage in RunDirectory(folder).read().stages if stage.name == "identify"]
            result["refused"] = dict(stages[-1].refused) if stages else {}
            if kept is not None:
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(folder, kept)
        result["values"] = values_of(drive, folder)
    more = {"code": code, "told": [] if code == 0 else str(told).strip().splitlines()[-8:]}
    return {**result, **more, "seconds": time.process_time() - start}


def row_of(result: Mapping[str, Any]) -> str:
    """Return one line: error over half width of every value, outside marked, and what was refused."""
    cells = []
    for name in QUANTITIES:
        if name in result["values"]:
            error, half = result["values"][name]
            ratio = abs(error) / half if half else math.inf
            mark = "!!" if ratio > 2.0 else "! " if ratio > 1.0 else "  "
            cells.append(f"{error:+7.2f}/{half:5.2f}{mark}")
        else:
            cells.append(f"{'-':^15}")
    short = {k: v.split(":")[0] if v.startswith("E_") else v[:60] for k, v in result["refused"].items()}
    refused = ", ".join(f"{k}: {v}" for k, v in short.items())
    if not result["values"] and not refused:
        refused = " ".join(map(str, result["told"]))[:160]
    head = f"{result['effect']:18} {result['level']:6g} {result['base']:13} {result['code']:3d}"
    return f"{head} {' '.join(cells)} {refused}"


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bases", nargs="+", default=list(BASES), help="profiles, or random-<seed>")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS))
    parser.add_argument("--levels", nargs="+", type=float, help="default: all of an effect")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--results", type=Path, default=Path("real_effects.jsonl"))
    parser.add_argument("--keep", default="", help="folder that keeps the runs")
    parser.add_argument("--replay", action="store_true")
    asked = parser.parse_args()
    jobs = [
        (base, effect, level, asked.keep, asked.replay)
        for effect in asked.effects
        for level in asked.levels or EFFECTS[effect][1]
        for base in asked.bases
    ]
    done = set()
    if not asked.replay and asked.results.is_file():
        lines = [json.loads(line) for line in asked.results.read_text(encoding="utf-8").splitlines()]
        done = {(line["base"], line["effect"], line["level"]) for line in lines}
    jobs = [job for job in jobs if job[:3] not in done]
    print(f"{'effect':18} {'level':>6} {'base':13} {'end':3} " + " ".join(f"{name:15}" for name in QUANTITIES))
    with multiprocessing.Pool(asked.processes, maxtasksperchild=1) as pool, asked.results.open("a") as file:
        for result in pool.imap(identify_one, jobs, chunksize=1):
            file.write(json.dumps(result) + "\n")
            file.flush()
            print(row_of(result), flush=True)


if __name__ == "__main__":
    main()
