# SPDX-License-Identifier: MIT
"""Random CAN frames and damaged files, at the tool and at the drive: no crash, no hang, no error that is not ours.

Run from the repository: ``python -m benchmarks.fuzz [N] [NAME...]`` (default 100 000 of each). Seeds are fixed, so
that a failure comes again. Files are damaged in their text, or, where they are binary, in their bytes. Each input may
take ``LONGEST_S`` and ``LARGEST_BYTES`` of memory.
"""

from __future__ import annotations

import argparse
import io
import json
import random
import resource
import signal
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.commissioning.report_page import report_page
from pmsmtool.design.design_file import design_text, parse_design
from pmsmtool.design.lookup.file import SCHEMA as LOOK_UP_SCHEMA
from pmsmtool.design.lookup.file import table_parameters
from pmsmtool.design.tune import tune
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.dcf import update_dcf, values_of
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.map_tables import look_up_words
from pmsmtool.errors import PmsmtoolError
from pmsmtool.files import data_folder
from pmsmtool.firmware.image import crc32
from pmsmtool.flash.journal import Entry, Snapshot, check_sum, parse_snapshot
from pmsmtool.flash.restore import check_snapshot, restore_plan
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_check import check_flux_map
from pmsmtool.machine.flux_map_import import flux_map_csv, flux_map_npz, load_flux_map
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, parse_machine
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.params.catalogue import layout_signature
from pmsmtool.params.parameter_set import default_set, parse_parameter_set
from pmsmtool.run_directory import Acceptance, Stage, new_record
from pmsmtool.sim.faults import EXAMPLE, parse_faults
from pmsmtool.sim.scenarios import load_scenario
from pmsmtool.trace import Trace, read_trace, trace_npz
from tests.bus.frame_fuzz import transfers
from tests.flash.rig import with_tables
from tests.node.test_random_requests import FRAMES, test_after_any_requests_a_power_cycle_brings_a_healthy_node

BATCH = 1000
LONGEST_S = 20
"""An input that takes longer hangs: SIGALRM ends the program."""
LARGEST_BYTES = 1 << 30
"""Address space beyond that of the program as it is loaded: more is a ``MemoryError``, and not handled."""
SCENARIO = """\
schema = "pmsmtool.scenario/1"
name = "reversal"
duration_s = 0.4
mode = "speed"
start_rpm = 10.0
[schedule]
speed_rpm = [[0.0, 0.0], [0.1, 400.0], [0.3, -400.0]]
load_nm = 1.5
[simulation]
sensor_noise_apk = 0.01
"""
SNAPSHOT = Snapshot(
    "journal",
    "open",
    Identity(1, 2, 3, 4, 5, "drive"),
    7,
    "sha256:00",
    (Entry("motor.R_s_ohm", 0x2010, 2, b"abcd", b"efgh"),),
)


def _use_set(text: str) -> None:
    """Read a set and do with it what a download does before its first write."""
    found = parse_parameter_set(text.replace("content = ", "# "))
    if not found.violations():
        reference_map().encode(found)


def _use_snapshot(text: str) -> None:
    """Read a snapshot, also one whose check sum was made right again: damage must not hide behind it."""
    try:
        body = json.loads(text)
    except ValueError:
        body = None
    if isinstance(body, dict):
        body.pop("check", None)
        parse_snapshot(json.dumps({**body, "check": check_sum(body)}), "fuzz")
    parse_snapshot(text, "fuzz")


def _use_backup(text: str) -> None:
    """Read a backup and compare it with the drive it is of, as ``verify`` does."""
    try:
        body = json.loads(text)
    except ValueError:
        body = None
    if not isinstance(body, dict):
        return
    body.pop("check", None)
    found = parse_snapshot(json.dumps({**body, "check": check_sum(body)}), "fuzz")
    check_snapshot(reference_map(), found, SNAPSHOT.identity, other_drive=True)
    restore_plan(reference_map(), found, {entry.name: entry.old for entry in _BACKUP.entries}).lines()


def _use_run(text: str) -> None:
    path = _SCRATCH / "run" / "run.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8", errors="replace")
    report_page(path.parent)


def _use_look_up(data: bytes) -> None:
    path = _SCRATCH / "lut.npz"
    path.write_bytes(data)
    table_parameters(read_npz(path), "fuzz")


def _use_trace_npz(data: bytes) -> None:
    path = _SCRATCH / "trace.npz"
    path.write_bytes(data)
    read_trace(path)


def _use_dcf(text: str) -> None:
    sheet = parse_eds(text.encode("utf-8", "replace"), "fuzz", node_id=1)
    values = values_of(sheet)
    update_dcf(text.encode("utf-8", "replace"), dict(list(values.items())[:3]), "fuzz")


def _use_scenario(text: str) -> None:
    path = _SCRATCH / "scenario.toml"
    path.write_text(text, encoding="utf-8", errors="replace")
    load_scenario(path)


def _use_map_csv(text: str) -> None:
    path = _SCRATCH / "map.csv"
    path.write_text(text, encoding="utf-8", errors="replace")
    check_flux_map(load_flux_map(path))


def _use_map_bytes(suffix: str) -> Callable[[bytes], None]:
    def use(data: bytes) -> None:
        path = _SCRATCH / f"map{suffix}"
        path.write_bytes(data)
        check_flux_map(load_flux_map(path))

    return use


def _use_trace_csv(text: str) -> None:
    path = _SCRATCH / "trace.csv"
    path.write_text(text, encoding="utf-8", errors="replace")
    read_trace(path)


def _small_map() -> FluxMap:
    i_d, i_q = np.linspace(-8.0, 4.0, 5), np.linspace(-6.0, 6.0, 5)
    psi_d = 0.1 + 4e-3 * i_d[:, None] - 1e-5 * i_q[None, :] ** 2
    psi_q = 9e-3 * i_q[None, :] - 2e-5 * i_d[:, None] * i_q[None, :]
    return FluxMap(i_d, i_q, psi_d, psi_q)


def _look_up() -> dict[str, NDArray[Any]]:
    wanted = with_tables(3)
    tables = {name: np.array(table) for name, table in wanted.tables.items()}
    facts = {"schema": LOOK_UP_SCHEMA, "axis_kind": "speed", "stored": "float32", "U_dc_v": 300.0,
             "words_crc32": crc32(look_up_words(reference_map().encode(wanted)))}  # fmt: skip
    return {"meta": np.array(json.dumps(facts)),
            "torque_nm": tables["lut.axis_x"], "speed_rpm": tables["lut.axis_y"], "i_d_a": tables["lut.i_d_a"],
            "i_q_a": tables["lut.i_q_a"]}  # fmt: skip


def _mat() -> bytes:
    from scipy.io import savemat

    small = _small_map()
    buffer = io.BytesIO()
    savemat(buffer, {"i_d": small.i_d_a, "i_q": small.i_q_a, "psi_d": small.psi_d_wb, "psi_q": small.psi_q_wb})
    return buffer.getvalue()


def _record() -> str:
    record = new_record(("identify",), drive={"serial": 1}, bus={}, versions={}, operator="x")
    passed = Acceptance("std", "0.1", "0.2", True)
    values = [{"name": "R_s_ohm", "value": 0.1, "std": 0.01, "systematic": 0.0, "unit": "ohm"}]
    stages = tuple(Stage(name, "pass", 1.0, values, [passed], ["none"]) for name in ("identify", "tune"))
    return json.dumps(asdict(replace(record, stages=stages)), indent=1)


def _backup() -> Snapshot:
    """Every parameter of the reference drive at its default."""
    encoded = reference_map().encode(default_set())
    entries = tuple(Entry(name, *reference_map().address(name), data) for name, data in encoded.items())
    identity = replace(SNAPSHOT.identity, vendor=reference_map().vendor, product=reference_map().product)
    return Snapshot("backup", "done", identity, layout_signature(), "", entries)


def _trace() -> Trace:
    t_s = np.linspace(0.0, 19e-4, 20)
    return Trace(t_s, {"i_d_a": np.linspace(0.0, 1.9, 20)}, {"i_d_a": "A"}, {"f_s_hz": 1e4})


_BACKUP = _backup()
SNAPSHOT = replace(SNAPSHOT, identity=_BACKUP.identity)
_FOLDER = tempfile.TemporaryDirectory(prefix="fuzz-")  # goes with the program
_SCRATCH = Path(_FOLDER.name)
_MACHINE = load_machine_file(data_folder("profiles") / "interior-2k2.toml")
_EDS = (data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds").read_bytes()
_SHORT_EDS = _EDS[_EDS.index(b"[FileInfo") : 4000].decode() + "\n" + _EDS[_EDS.index(b"[2010]") :][:4000].decode()
"""Enough of it for every kind of line; the whole takes ten times as long."""
TEXTS: dict[str, tuple[str, Callable[[str], object]]] = {
    "parameter-sets": (default_set().merged(with_tables(3)).to_toml(), _use_set),
    "drive-maps": (dump_drive_map(reference_map()), parse_drive_map),
    "snapshots": (SNAPSHOT.dumps(), _use_snapshot),
    "backups": (_BACKUP.dumps(), _use_backup),
    "run-records": (_record(), _use_run),
    "eds": (_SHORT_EDS, lambda text: parse_eds(text.encode("utf-8", "replace"), "fuzz", node_id=1)),
    "dcf": (_SHORT_EDS, _use_dcf),
    "machine-files": (dump_machine_file(_MACHINE), parse_machine),
    "design-files": (design_text(tune(_MACHINE)), parse_design),
    "fault-files": (EXAMPLE, parse_faults),
    "scenarios": (SCENARIO, _use_scenario),
    "flux-maps-csv": (flux_map_csv(_small_map()), _use_map_csv),
    "traces-csv": ("t_s,i_d_a\ns,A\n" + "".join(f"{k * 1e-4!r},{k * 0.1!r}\n" for k in range(20)), _use_trace_csv),
}
BINARIES: dict[str, tuple[Callable[[], bytes], Callable[[bytes], object]]] = {
    "flux-maps-npz": (lambda: flux_map_npz(_small_map()), _use_map_bytes(".npz")),
    "flux-maps-mat": (_mat, _use_map_bytes(".mat")),
    "traces-npz": (lambda: trace_npz(_trace()), _use_trace_npz),
    "look-up-tables": (lambda: npz_bytes(_look_up()), _use_look_up),
}


VALUES = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e400",
    "[]",
    "{}",
    '""',
    "true",
    "9" * 400,
    "-1e-300",
    "[1, [2]]",
    "1979-05-27",
    "'x'",
)


def with_other_values(text: str, rng: random.Random) -> str:
    """Return a text with one or two values after ``=`` replaced by others: still TOML, or INI, or nearly."""
    lines = text.split("\n")
    places = [k for k, line in enumerate(lines) if "=" in line]
    for _ in range(rng.randint(1, 2)):
        k = rng.choice(places)
        lines[k] = f"{lines[k].split('=')[0]}= {rng.choice(VALUES)}"
    return "\n".join(lines)


def damaged(text: str, rng: random.Random) -> str:
    """Return a text with a few characters, lines or numbers changed."""
    if "=" in text and rng.random() < 0.5:
        return with_other_values(text, rng)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(text) or 1)
        kind = rng.random()
        if kind < 0.3:
            text = text[:at] + chr(rng.randrange(1, 0x250)) + text[at + 1 :]
        elif kind < 0.5:
            text = text[:at] + text[at + rng.randrange(20) :]
        elif kind < 0.8:
            text = (
                text[:at]
                + rng.choice(("nan", "inf", "-1", "1e400", "[]", "{}", '""', "0x1_0", "true", "9" * 400))
                + text[at:]
            )
        else:
            lines = text.split("\n")
            lines.insert(rng.randrange(len(lines)), rng.choice(lines))
            text = "\n".join(lines)
    return text


def damaged_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return bytes with a few of them changed, removed or repeated."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(changed) or 1)
        kind = rng.random()
        if kind < 0.6:
            changed[at : at + 1] = rng.randbytes(1)
        elif kind < 0.8:
            del changed[at : at + rng.randrange(1, 40)]
        elif kind < 0.9:
            changed[at:at] = changed[at : at + rng.randrange(1, 40)]
        else:
            del changed[at:]
    return bytes(changed)


def run(name: str, count: int, attempt: Callable[[random.Random], None]) -> None:
    """Try ``count`` inputs of one kind and print how they ended."""
    rng, started = random.Random(name), time.perf_counter()
    refused = 0
    for number in range(count):
        signal.alarm(LONGEST_S)
        try:
            attempt(rng)
        except PmsmtoolError:
            refused += 1
        except BaseException:
            print(f"{name}: input {number} of seed {name!r} was not handled", flush=True)
            raise
        finally:
            signal.alarm(0)
    seconds = time.perf_counter() - started
    print(f"{count} damaged {name}: {refused} refused, {count - refused} usable, {seconds:.0f} s", flush=True)


def _at_the_tool(count: int) -> None:
    ended: Counter[str] = Counter()
    started = time.perf_counter()
    for seed in range(-(-count // BATCH)):
        ended.update(transfers(1000 + seed, BATCH))
    seconds = time.perf_counter() - started
    print(f"{sum(ended.values())} transfers of random frames: {dict(ended)}, {seconds:.0f} s", flush=True)


def _at_the_drive(count: int) -> None:
    started = time.perf_counter()
    seeds = -(-count // FRAMES)
    for seed in range(seeds):
        test_after_any_requests_a_power_cycle_brings_a_healthy_node(10_000 + seed)
    seconds = time.perf_counter() - started
    print(f"{seeds * FRAMES} random frames at the drive, healthy after each {FRAMES}: {seconds:.0f} s", flush=True)


def limit_memory() -> None:
    """Make an allocation beyond ``LARGEST_BYTES`` fail, where the system can."""
    loaded = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (loaded + LARGEST_BYTES, resource.RLIM_INFINITY))


def main() -> None:
    """Print how the inputs ended."""
    known = ["frames-at-the-tool", "frames-at-the-drive", *TEXTS, *BINARIES]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", nargs="?", type=int, default=100_000)
    parser.add_argument("name", nargs="*", help=f"which; default all of {', '.join(known)}")
    asked = parser.parse_args()
    count = asked.count
    if unknown := sorted({*asked.name} - {*known}):
        parser.error(f"no such input: {', '.join(unknown)}")
    for name in asked.name or known:
        if name == "frames-at-the-tool":
            _at_the_tool(count)
        elif name == "frames-at-the-drive":
            _at_the_drive(count)
        elif name in TEXTS:
            text, read = TEXTS[name]
            run(name, count, lambda rng, text=text, read=read: read(damaged(text, rng)))  # type: ignore[misc]
        else:
            make, use = BINARIES[name]
            data = make()
            run(name, count, lambda rng, data=data, use=use: use(damaged_bytes(data, rng)))  # type: ignore[misc]


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    limit_memory()
    main()
