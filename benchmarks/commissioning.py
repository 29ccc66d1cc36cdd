# SPDX-License-Identifier: MIT
"""Commission simulated drives from factory memory: four machines, averaged and switched inverter.

    python -m benchmarks.commissioning

Prints the verdict of each chain and how far the identified values lie from the simulated truth (of a saturated machine:
the incremental inductances at the printed bias). The measured map is read from ../shared/maps where it exists.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import can

from benchmarks.random_drives import true_loop_resistance
from pmsmtool.cli.main import run
from pmsmtool.files import data_folder
from pmsmtool.machine.flux_map_import import load_flux_map
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file, load_machine_file
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.bus import PmsmSimBus

ROOT = Path(__file__).resolve().parent.parent
MEASURED_MAP = ROOT.parent / "shared" / "maps" / "baldor_400rpm_map.npz"
MEASURED = "measured-map"
PROFILES = ("jercic-2017", "interior-2k2", "saturated-pmsyrm", MEASURED)
MODELS = ("averaged", "switched")
QUANTITIES = ("R_s_ohm", "L_d_h", "L_q_h", "psi_f_wb", "J_kgm2")
LIMIT_OBJECTS = ((0x6073, 0), (0x6080, 0), (0x1016, 1), (0x6007, 0), (0x1020, 1))


def drive_of(name: str, model: str) -> MachineFile:
    """Return a profile, or the measured map on the saturated profile's drive, with one of the inverter models."""
    base = load_machine_file(data_folder("profiles") / f"{'saturated-pmsyrm' if name == MEASURED else name}.toml")
    drive = replace(base, simulation={**base.simulation, "inverter_model": model})
    if name != MEASURED:
        return drive
    measured = load_flux_map(MEASURED_MAP)
    machine = replace(base.machine, flux_map=None, psi_f_wb=float(measured.flux(0.0, 0.0)[0]), I_max_apk=18.0)
    return replace(drive, name=MEASURED, machine=machine, flux_map=measured)


def errors_of(drive: MachineFile, folder: Path) -> dict[str, float]:
    """Return the relative error of every identified value."""
    if not (folder / "machine.toml").exists():
        return {}
    found = load_machine_file(folder / "machine.toml").estimates
    truth = {name: float(getattr(drive.machine, name)) for name in QUANTITIES}
    truth["R_s_ohm"] = true_loop_resistance(drive)
    if drive.flux_map is not None and "L_d_h" in found:
        at = found["L_d_h"]
        incremental = drive.flux_map.incremental_inductance(at.i_d_apk, at.i_q_apk)
        truth |= {"L_d_h": float(incremental[0, 0]), "L_q_h": float(incremental[1, 1])}
        truth["psi_f_wb"] = float(drive.flux_map.flux(0.0, 0.0)[0])
    return {name: found[name].value / truth[name] - 1.0 for name in QUANTITIES if name in found}


@contextlib.contextmanager
def prepared() -> Iterator[None]:
    """An empty folder as working and user folder; the simulated bus known to python-can without an installation."""
    backends = {"pmsmsim": ("pmsmtool.sim.bus", "PmsmSimBus")}
    can.interfaces.BACKENDS.update(backends)
    setattr(can.util, "VALID_INTERFACES", frozenset({*can.VALID_INTERFACES, *backends}))  # noqa: B010 - not exported
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        os.environ["PMSMTOOL_HOME"] = folder
        try:
            yield
        finally:
            os.chdir(before)


def commanded(*arguments: str) -> tuple[int, str]:
    """Run a command line and return its exit code and what it told."""
    told = io.StringIO()
    with contextlib.redirect_stderr(told), contextlib.redirect_stdout(io.StringIO()):
        code = run(arguments)
    return code, told.getvalue()


@contextlib.contextmanager
def powered(channel: str) -> Iterator[PmsmSimBus]:
    """Stay on the line, so that the drive keeps its power when the tool leaves."""
    bus = PmsmSimBus(channel)
    try:
        yield bus
    finally:
        bus.shutdown()


def commission_one(job: tuple[str, str]) -> str:
    """Commission one machine and return its row."""
    name, model = job
    with prepared():
        drive = drive_of(name, model)
        Path("drive.toml").write_text(dump_machine_file(drive, embed_flux_map=True))
        start = time.perf_counter()
        options = () if drive.flux_map is None else ("--flux-map",)
        code, told = commanded("commission", "-i", "pmsmsim", "-c", "drive.toml", "--yes", *options)
        seconds = time.perf_counter() - start
        (folder,) = Path("runs").iterdir()
        record = RunDirectory(folder).read()
        errors = errors_of(drive, folder)
    columns = [f"{100.0 * errors[name]:+8.3f}" if name in errors else f"{'-':>8}" for name in QUANTITIES]
    bus = sum(stage.seconds for stage in record.stages)
    row = f"{name:17} {model:9} {code:4d}  {' '.join(columns)} {bus:7.1f} {seconds:7.1f}"
    ended = [line for line in told.splitlines() if line.startswith("[") and " PASS " not in line]
    return "\n".join([row, *(f"    {line}" for line in ended)])


def machines(processes: int) -> None:
    """Print one row per machine and inverter model."""
    names = [name for name in PROFILES if name != MEASURED or MEASURED_MAP.exists()]
    heads = " ".join(f"{name.split('_')[0] + '_' + name.split('_')[1] + ' %':>8}" for name in QUANTITIES)
    print(f"{'machine':17} {'inverter':9} {'exit':4}  {heads} {'bus s':>7} {'wall s':>7}")
    with multiprocessing.Pool(processes, maxtasksperchild=1) as pool:
        for row in pool.imap(commission_one, [(name, model) for name in names for model in MODELS], chunksize=1):
            print(row, flush=True)


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--processes", type=int, default=2)
    machines(parser.parse_args().processes)


if __name__ == "__main__":
    main()
