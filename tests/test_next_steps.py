# SPDX-License-Identifier: MIT
"""No reader of a file refuses one without a next step: damaged files of every format, each error with its hint.

Two ways: every reader is given files damaged at random, and every function of a reader's module that makes an error
without a hint must stand behind a reader that adds one.
"""

from __future__ import annotations

import ast
import json
import random
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from pmsmtool import errors
from pmsmtool.commissioning.parameter_source import load_parameters
from pmsmtool.design.design_file import design_text, load_machine_or_design, parse_design
from pmsmtool.design.lookup.file import table_parameters
from pmsmtool.design.tune import tune
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.dcf import update_dcf, values_of
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.errors import ConfigError, PmsmtoolError, next_step
from pmsmtool.files import data_folder
from pmsmtool.flash.journal import Entry, Snapshot, parse_snapshot, read_snapshot
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_import import flux_map_csv, flux_map_npz, load_flux_map
from pmsmtool.machine.iron_loss_map import load_iron_loss_map
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, parse_machine
from pmsmtool.npz_file import read_npz
from pmsmtool.params.parameter_set import default_set, parse_parameter_set, read_parameter_set
from pmsmtool.proof.judgement import from_arrays
from pmsmtool.run_directory import RunDirectory, new_record
from pmsmtool.sim.channel import parse_channel
from pmsmtool.sim.faults import EXAMPLE, load_faults, parse_faults
from pmsmtool.sim.scenarios import FILE_EXAMPLE, load_scenario
from pmsmtool.toml_file import parse_toml
from pmsmtool.trace import Trace, read_trace, trace_csv, trace_npz
from tests.test_layers import parsed

ROOT = Path(__file__).resolve().parents[1]
ATTEMPTS = 60
"""Damaged files of a format; 60 of each take 6 s in all, and meet the errors that a user meets."""
JUNK = ("", "nan", "-1", "1e999", "x", '"text"', "[]", "true", "0x", "99999999999999999999")


def damaged(text: str, rng: random.Random) -> str:
    """Cut, double, swap or drop lines, or put something else in the place of a value."""
    lines = text.splitlines()
    for _ in range(rng.randint(1, 3)):
        k = rng.randrange(len(lines))
        kind = rng.randrange(6)
        if kind == 0 and len(lines) > 1:
            del lines[k]
        elif kind == 1:
            lines.insert(k, lines[k])
        elif kind == 2:
            lines = lines[: max(1, k)]
        elif kind == 3:
            lines[k] = lines[k][: len(lines[k]) // 2]
        elif kind == 4:
            mark = "=" if "=" in lines[k] else ","
            head, _, _ = lines[k].rpartition(mark)
            lines[k] = f"{head}{mark} {rng.choice(JUNK)}"
        else:
            lines[k] = lines[k].replace("a", "ä").replace("1", "")
    return "\n".join(lines)


def damaged_bytes(data: bytes, rng: random.Random) -> bytes:
    """Cut the data, or turn bytes of it over."""
    if rng.random() < 0.5:
        return data[: rng.randrange(len(data))]
    content = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    return bytes(content)


def machine_text() -> str:
    return dump_machine_file(load_machine_file(data_folder("profiles") / "interior-2k2.toml"))


def small_map() -> FluxMap:
    i_d, i_q = np.linspace(-4.0, 4.0, 5), np.linspace(-4.0, 4.0, 5)
    psi_d, psi_q = np.meshgrid(0.1 + 0.01 * i_d, 0.02 * i_q, indexing="ij")
    return FluxMap(i_d, i_q, psi_d, psi_q)


def a_trace() -> Trace:
    t = np.arange(8.0) * 1e-3
    return Trace(t, {"i_d_a": np.sin(t)}, {"i_d_a": "A"})


def a_snapshot() -> str:
    entries = (Entry("motor.R_s_ohm", 0x2010, 2, b"\0\0\0\0", b"\1\0\0\0"),)
    return Snapshot("backup", "done", Identity(1, 2, 3, 4, 5), 0, "", entries).dumps()


def a_run() -> str:
    record = new_record(("commission",), drive={}, bus={}, versions={})
    return json.dumps(asdict(record), indent=1)


def of_text(read: Callable[[str], object]) -> Callable[[Path], object]:
    return lambda path: read(path.read_bytes().decode("utf-8", "replace"))


def of_bytes(read: Callable[[bytes], object]) -> Callable[[Path], object]:
    return lambda path: read(path.read_bytes())


def a_dcf() -> str:
    return (
        "[FileInfo]\nFileName=a.eds\n[DeviceInfo]\nVendorName=x\n[MandatoryObjects]\nSupportedObjects=1\n1=0x1000\n"
        "[1000]\nParameterName=Device type\nObjectType=0x7\nDataType=0x0007\nAccessType=ro\nDefaultValue=1\n"
        "ParameterValue=0x12\n"
    )


TEXTS: dict[str, tuple[Callable[[], str], str, Callable[[Path], object]]] = {
    "machine file": (machine_text, "m.toml", load_machine_file),
    "machine text": (machine_text, "m.toml", of_text(parse_machine)),
    "design": (lambda: design_text(tune(parse_machine(machine_text()))), "d.toml", of_text(parse_design)),
    "machine or design": (machine_text, "m.toml", load_machine_or_design),
    "parameter set": (lambda: default_set().to_toml(), "p.toml", read_parameter_set),
    "parameter text": (lambda: default_set().to_toml(), "p.toml", of_text(parse_parameter_set)),
    "parameters of any file": (lambda: default_set().to_toml(), "p.toml", load_parameters),
    "drive map": (lambda: dump_drive_map(reference_map()), "map.toml", of_text(parse_drive_map)),
    "scenario": (lambda: FILE_EXAMPLE, "s.toml", load_scenario),
    "faults": (lambda: EXAMPLE, "f.toml", load_faults),
    "faults text": (lambda: EXAMPLE, "f.toml", of_text(parse_faults)),
    "toml": (machine_text, "t.toml", of_text(lambda text: parse_toml(text, where="t.toml"))),
    "flux map csv": (lambda: flux_map_csv(small_map()), "map.csv", load_flux_map),
    "trace csv": (lambda: trace_csv(a_trace()), "t.csv", read_trace),
    "snapshot": (a_snapshot, "s.json", read_snapshot),
    "snapshot text": (a_snapshot, "s.json", of_text(lambda text: parse_snapshot(text, "s.json"))),
    "eds": (a_dcf, "d.eds", of_bytes(lambda data: parse_eds(data, "d.eds"))),
    "dcf values": (a_dcf, "d.dcf", of_bytes(lambda data: values_of(parse_eds(data, "d.dcf")))),
    "dcf update": (a_dcf, "d.dcf", of_bytes(lambda data: update_dcf(data, {(0x1000, 0): b"\1\0\0\0"}, "d.dcf"))),
    "dcf as parameters": (a_dcf, "d.dcf", load_parameters),
    "run": (a_run, "run.json", lambda path: RunDirectory(path.parent).read()),
    "channel": (lambda: "interior-2k2?seed=7&nodes=2&speed=2.5", "c.txt", of_text(parse_channel)),
}
BINARIES: dict[str, tuple[Callable[[], bytes], str, Callable[[Path], object]]] = {
    "flux map npz": (lambda: flux_map_npz(small_map()), "map.npz", load_flux_map),
    "trace npz": (lambda: trace_npz(a_trace()), "t.npz", read_trace),
    "npz": (lambda: trace_npz(a_trace()), "t.npz", read_npz),
    "iron-loss map": (lambda: flux_map_npz(small_map()), "loss.npz", load_iron_loss_map),
    "look-up table": (lambda: trace_npz(a_trace()), "l.npz", lambda path: table_parameters(read_npz(path), str(path))),
    "prediction": (lambda: trace_npz(a_trace()), "p.npz", lambda path: from_arrays(read_npz(path))),
    "matlab": (lambda: flux_map_npz(small_map()), "map.mat", load_flux_map),
}  # fmt: skip


def refusals(read: Callable[[Path], object], path: Path, contents: list[bytes]) -> list[ConfigError]:
    """Return what is refused of many files; anything but our own error ends the test."""
    found = []
    for content in contents:
        path.write_bytes(content)
        try:
            read(path)
        except ConfigError as error:
            found.append(error)
    return found


@pytest.mark.parametrize("name", [*TEXTS, *BINARIES])
def test_every_refused_file_comes_with_a_next_step(name: str, tmp_path: Path) -> None:
    rng = random.Random(name)
    if name in TEXTS:
        make, file, read = TEXTS[name]
        text = make()
        contents = [damaged(text, rng).encode() for _ in range(ATTEMPTS)] + [b"", b"\xff\xfe\0", b"schema = 1\n"]
    else:
        make_bytes, file, read = BINARIES[name]
        data = make_bytes()
        contents = [damaged_bytes(data, rng) for _ in range(ATTEMPTS)] + [b"", b"PK"]
    found = refusals(read, tmp_path / file, contents)
    assert len(found) >= 2, "the files are damaged"
    bare = sorted({f"{error.where}: {error.what}" for error in found if not error.hint})
    assert bare == []


READERS = (
    "machine/machine_file", "machine/flux_map_import", "machine/mat_file", "trace",
    "sim/scenarios", "sim/faults", "sim/channel", "sim/simulated_machine", "drive_maps/dcf", "drive_maps/eds",
    "drive_maps/drive_map_file", "drive_maps/drive_map", "params/parameter_set", "design/design_file",
    "proof/judgement", "machine/iron_loss_map", "design/lookup/file", "npz_file", "toml_file", "flash/journal",
    "commissioning/parameter_source",
)  # fmt: skip


def bare_functions(source: str) -> list[str]:
    """Return the public functions that make an error without a hint, and do not stand behind ``next_step``."""
    found = []
    for node in ast.parse(source).body:
        for function in [node, *getattr(node, "body", [])] if isinstance(node, ast.ClassDef) else [node]:
            if not isinstance(function, ast.FunctionDef) or function.name.startswith("_"):
                continue
            hinted = any("next_step" in ast.unparse(decorator) for decorator in function.decorator_list)
            if not hinted and any(_is_bare(call) for call in ast.walk(function)):
                found.append(function.name)
    return found


def _is_bare(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "ConfigError"
        and not any(keyword.arg == "hint" for keyword in node.keywords)
    )


INSIDE = {"encode", "decode"}
"""Of a cell: called by the map's own, which add the step."""


@pytest.mark.parametrize("module", READERS)
def test_every_reader_adds_a_next_step(module: str) -> None:
    source = (ROOT / "pmsmtool" / f"{module}.py").read_text(encoding="utf-8")
    assert [name for name in bare_functions(source) if not (module == "drive_maps/drive_map" and name in INSIDE)] == []


ERRORS = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, PmsmtoolError)}
ELSEWHERE = {
    "design/closed_drive", "design/lookup/design", "design/tolerance", "design/tune_request", "machine/flux_map",
    "machine/machine_reader",
}  # fmt: skip
"""Modules whose step is added by the command line (by option) or by the reader of the file."""
HAVE_A_STEP = {"NotAvailable", "Interrupted", "PmsmtoolError"}
"""`pmsmtool caps` is the step of the first; the second says that the machine was stopped; the last is a bug."""


@pytest.mark.chain
def test_every_other_error_names_a_next_step() -> None:
    bare = []
    for path in sorted((ROOT / "pmsmtool").rglob("*.py")):
        module = path.relative_to(ROOT / "pmsmtool").with_suffix("").as_posix()
        for node in ast.walk(parsed(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or getattr(node.func, "id", "") not in ERRORS - HAVE_A_STEP:
                continue
            behind = module in ELSEWHERE or (module in READERS and ast.unparse(node.func) == "ConfigError")
            if not behind and not any(keyword.arg in ("hint", None) for keyword in node.keywords):
                bare.append(f"{module}:{node.lineno}")
    assert bare == []


def test_a_reader_that_adds_none_is_seen() -> None:
    assert bare_functions("def read():\n    raise ConfigError('bad', where='x')\n") == ["read"]
    assert bare_functions("@next_step('do')\ndef read():\n    raise ConfigError('bad')\n") == []


def test_a_step_of_its_own_is_kept() -> None:
    with pytest.raises(ConfigError) as caught, next_step("the general one"):
        raise ConfigError("bad", hint="its own")
    assert caught.value.hint == "its own"
