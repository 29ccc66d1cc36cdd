# SPDX-License-Identifier: MIT
"""Exports: the bytes a drive would get, in every form; same set, same bytes; refused without a half-written file."""

from __future__ import annotations

import csv
import io
import re
import shutil
import struct
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import canopen
import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli, run
from pmsmtool.commissioning.export import concise_dcf, csv_text, image_of
from pmsmtool.commissioning.parameter_source import load_parameters
from pmsmtool.design.design_file import Design, DesignValue, design_text, load_design
from pmsmtool.design.tune import tune
from pmsmtool.drive_maps.drive_map import Cell, DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map
from pmsmtool.drive_maps.shipped_maps import family_names
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.firmware.export_c import FLAGS
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import ASSUMED, ParameterSet
from pmsmtool.run_directory import RunDirectory, new_record
from tests.concise_dcf import read_concise
from tests.firmware.exported_image import image_of_json
from tests.foreign.data_sheets import epos4, write_eds

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def with_table(design: Design) -> Design:
    """Return the design with a look-up table of 3 x 2 cells, one of them without a point, as int16."""
    lut = {"lut.format": 2, "lut.n_x": 3, "lut.n_y": 2, "lut.n_z": 1, "lut.lsb_a": 0.001}
    tables = {
        "lut.axis_x": (-1.0, 0.0, 1.5),
        "lut.axis_y": (0.0, 1000.0),
        "lut.axis_z": (540.0,),
        "lut.i_d_a": (-1.0, -2.0, 0.0, -1.25, -1.5, float("nan")),
        "lut.i_q_a": (-2.0, -2.5, 0.0, 0.0, 2.0, float("nan")),
    }
    values = {**design.values, **{name: DesignValue(value, "test") for name, value in lut.items()}}
    return replace(design, values={row.name: values[row.name] for row in CATALOGUE}, tables=tables)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a design that has a look-up table, and its parameter set."""
    path = tmp_path_factory.mktemp("design")
    design = with_table(tune(load_machine_file(data_folder("profiles") / "interior-2k2.toml")))
    (path / "design.toml").write_text(design_text(design))
    (path / "params.toml").write_text(design.parameter_set().to_toml())
    return path


def export(*arguments: str | Path) -> None:
    assert run(["export", *map(str, arguments)]) == 0


@pytest.mark.parametrize("form", ["dcf", "cdcf", "header", "csv", "params"])
def test_same_set_same_bytes_from_design_set_and_folder(form: str, folder: Path, tmp_path: Path) -> None:
    for k, source in enumerate((folder / "design.toml", folder / "params.toml", folder)):
        export(form, source, "-o", tmp_path / f"{k}")
    contents = {(tmp_path / f"{k}").read_bytes() for k in range(3)}
    if form == "params":  # of equal content; the set names its own sources
        assert len({load_parameters(folder).content_hash()} | {c.split(b"\n")[2] for c in contents}) == 2
    assert len(contents) == 1
    assert str(folder).encode() not in contents.pop()


def test_the_run_of_a_mapped_drive_names_the_map_of_its_file(folder: Path, tmp_path: Path, capsys) -> None:
    run_of = RunDirectory(folder)
    for made_on, warned in (("epos4", True), ("pmsmsim", False)):
        run_of.write(new_record(["test"], drive={"map": made_on}, bus={}, versions={}))
        export("dcf", folder, "-o", tmp_path / f"{made_on}.dcf")
        assert ("this file is for the reference drive: --map epos4" in capsys.readouterr().err) is warned
    (folder / "run.json").unlink()


def test_a_dcf_is_read_by_canopen_and_gives_the_set_back(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "drive.dcf"
    export("dcf", folder, "-n", "5", "-o", path)
    wanted = load_design(folder / "design.toml").parameter_set()
    dictionary = canopen.import_od(str(path))
    assert dictionary.node_id == 5
    for cell in reference_map().cells.values():
        variable = dictionary.get_variable(cell.index, cell.sub)
        assert variable is not None and variable.value is not None
        assert variable.encode_raw(variable.value) == cell.encode(wanted.values[cell.name], wanted.values), cell.name
    assert image_of(load_parameters(path)) == image_of(wanted)


def test_a_concise_dcf_stages_the_whole_set(folder: Path) -> None:
    wanted = load_parameters(folder)
    entries = read_concise(concise_dcf(wanted))
    crc = next(e for e in entries if (e.index, e.sub) == (0x2000, 5))
    commands = [e.data for e in entries if (e.index, e.sub) == (0x2000, 6)]
    assert commands == [b"\1", b"\2", b"\3"]
    assert (entries[0].index, entries[0].sub) == (0x2000, 6)
    assert entries[-3] is crc
    assert crc.data == struct.pack("<I", zlib.crc32(image_of(wanted)))
    assert {(e.index, e.sub): e.data for e in entries[1:-3]} == {
        reference_map().address(name): data for name, data in reference_map().encode(wanted).items()
    }


def test_an_incomplete_set_is_written_directly_but_never_a_table() -> None:
    gains = ParameterSet({"current.K_p_d_v_per_a": 2.0, "current.K_i_d_v_per_as": 30.0})
    assert [(e.index, e.data) for e in read_concise(concise_dcf(gains))] == [
        (0x2020, struct.pack("<f", 2.0)),
        (0x2020, struct.pack("<f", 30.0)),
    ]
    with pytest.raises(ConfigError, match="only together with the whole set"):
        concise_dcf(ParameterSet({"lut.format": 0}))


@pytest.mark.chain
@pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
def test_exported_c_compiles_and_is_the_image(folder: Path, tmp_path: Path) -> None:
    export("c", folder, "--prefix", "left", "--fixed-point", "-o", tmp_path / "new" / "firmware")
    sources = tmp_path / "new" / "firmware"
    image = image_of(load_parameters(folder))
    assert image_of_json((sources / "left_cfg.json").read_text()) == image
    (sources / "main.c").write_text(
        '#include <stdio.h>\n#include "left_cfg.h"\n'
        "int main(void) { return fwrite(&left_cfg, 1, LEFT_CFG_BYTES, stdout) == LEFT_CFG_BYTES ? 0 : 1; }\n"
    )
    names = sorted(path.name for path in sources.glob("*.c"))
    assert {"left_cfg_q.c", "pmsm_governor_q.c", "left_main.c"} <= set(names)
    subprocess.run([str(COMPILER), *FLAGS.split(), "-o", "read_back", *names], cwd=sources, check=True)
    assert subprocess.run([sources / "read_back"], capture_output=True, check=True).stdout == image


def test_the_header_alone_compiles(folder: Path, tmp_path: Path) -> None:
    if COMPILER is None:
        pytest.skip("no C compiler on this machine")
    export("c", folder, "-o", tmp_path)
    export("header", folder, "-o", tmp_path / "one.h")
    (tmp_path / "one.c").write_text('#include "one.h"\nfloat read_it(void) { return pmsm_cfg.params.motor_R_s_ohm; }\n')
    subprocess.run([COMPILER, *FLAGS.split(), "-c", "one.c"], cwd=tmp_path, check=True)


def test_csv_shows_what_the_drive_will_hold(folder: Path) -> None:
    wanted = load_parameters(folder)
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(csv_text(wanted)))}
    held = reference_map().quantised(wanted)
    assert {name: float(rows[name]["held"]) for name in wanted.values} == held.values
    assert rows["lut.i_d_a[3]"]["held"] == "-1.25"
    assert rows["lut.i_d_a"]["object"] == "0x2042:00"
    assert sum(name.startswith("lut.i_q_a[") for name in rows) == 6


def test_csv_through_another_drives_map(folder: Path, tmp_path: Path) -> None:
    cells = {
        "current.K_p_d_v_per_a": Cell("current.K_p_d_v_per_a", 0x3000, 1, "UNSIGNED16", factor=0.01),
        "current.K_i_d_v_per_as": Cell(
            "current.K_i_d_v_per_as", 0x3000, 2, "UNSIGNED16", factor=1e-5, gain="current.K_p_d_v_per_a"
        ),
    }
    (tmp_path / "map.toml").write_text(dump_drive_map(DriveMap("other", 1, 2, cells)))
    outcome = CliRunner().invoke(cli, ["export", "csv", str(folder), "--map", str(tmp_path / "map.toml")])
    assert outcome.exit_code == 0
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(outcome.stdout))}
    K_p, K_i = (float(rows[name]["value"]) for name in cells)
    assert int.from_bytes(bytes.fromhex(rows["current.K_i_d_v_per_as"]["bytes"]), "little") == round(1e5 * K_p / K_i)
    assert rows["motor.R_s_ohm"]["object"] == ""
    (warning,) = outcome.stderr.splitlines()
    assert "has no object for" in warning and "motor.R_s_ohm, " in warning and "... (-v names all)" in warning
    assert len(warning) < 240 and "polar.V_ref_ratio" not in warning, "dozens of names are no reading"
    outcome = CliRunner().invoke(cli, ["export", "csv", str(folder), "--map", str(tmp_path / "map.toml"), "-v"])
    every = outcome.stderr.splitlines()[1].removeprefix("no object for ").split(", ")
    assert f" {len(every)} of {len(every) + len(cells)} parameters" in warning and "polar.V_ref_ratio" in every


@pytest.mark.parametrize("family", [name for name in family_names() if name != "cia402"])
def test_csv_for_every_family(family: str, folder: Path) -> None:
    """A gain in amperes of a torque constant that the set lacks ended as an internal error, exit 70."""
    outcome = CliRunner().invoke(cli, ["export", "csv", str(folder), "--map", family])
    assert outcome.exit_code == 0, outcome.exception
    rows = list(csv.DictReader(io.StringIO(outcome.stdout)))
    told = {row["name"]: bool(row["object"]) != bool(row["not written because"]) for row in rows}
    assert [name for name, once in told.items() if not once and "[" not in name] == []


@pytest.mark.chain
def test_a_users_file_keeps_its_other_bytes(folder: Path, tmp_path: Path) -> None:
    base = (data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds").read_bytes()
    theirs = b"; our own line\r\n" + base.replace(b"\n", b"\r\n")
    (tmp_path / "theirs.eds").write_bytes(theirs)
    export("dcf", folder, "--into", tmp_path / "theirs.eds", "-o", tmp_path / "out.dcf")
    lines = (tmp_path / "out.dcf").read_bytes().split(b"\r\n")
    added = [line for line in lines if line not in set(theirs.split(b"\r\n"))]
    assert lines[0] == b"; our own line"
    assert all(line.startswith((b"ParameterValue=", b"[DeviceComissioning]", b"Node")) for line in added)


@pytest.mark.chain
def test_the_map_of_a_data_sheet_is_that_of_its_family(folder: Path, tmp_path: Path) -> None:
    """Without --map a hundred rows of the reference drive's map were held against an EPOS4's file, exit 2."""
    sheet = write_eds(tmp_path / "theirs.eds", epos4())
    export("dcf", folder, "--into", sheet, "-o", tmp_path / "chosen.dcf")
    export("dcf", folder, "--into", sheet, "--map", "epos4", "-o", tmp_path / "given.dcf")
    written = (tmp_path / "chosen.dcf").read_bytes()
    assert written == (tmp_path / "given.dcf").read_bytes() and b"ParameterValue=" in written


BAD = {
    "no file": (["csv", "missing.toml"], "no such file|cannot be read"),
    "not toml": (["csv", "text.toml"], "is not TOML"),
    "another schema": (["csv", "machine.toml"], "schema is"),
    "no schema": (["csv", "bare.toml"], "has no schema, expected 'pmsmtool.design/1' or 'pmsmtool.params/1'"),
    "no design in the folder": (["csv", "empty"], "no design in this folder"),
    "a sheet without values": (["csv", "empty.dcf"], "holds no parameter|no usable|object"),
    "out of bounds": (["dcf", "bounds.toml", "-o", "out"], "outside"),
    "incomplete for C": (["header", "gain.toml", "-o", "out"], "missing"),
    "prefix": (["header", "params.toml", "--prefix", "2x", "-o", "out"], "prefix"),
    "map without sheet": (["dcf", "params.toml", "--map", "map.toml"], "needs --into"),
    "no folder": (["csv", "params.toml", "-o", "nowhere/out"], "cannot be written"),
    "a file in the way": (["c", "params.toml", "-o", "params.toml/c"], "cannot be made"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_writes_nothing(
    case: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments, message = BAD[case]
    monkeypatch.chdir(tmp_path)
    shutil.copy(folder / "params.toml", tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.toml").write_text("R_s = \n")
    (tmp_path / "machine.toml").write_text('schema = "pmsmtool.machine/1"\n')
    (tmp_path / "bare.toml").write_text("a = 1\n")
    (tmp_path / "empty.dcf").write_text("[FileInfo]\nFileName=x\n")
    (tmp_path / "bounds.toml").write_text(ParameterSet({"motor.pole_pairs": 65}).to_toml())
    (tmp_path / "gain.toml").write_text(ParameterSet({"motor.pole_pairs": 6}).to_toml())
    (tmp_path / "map.toml").write_text(dump_drive_map(reference_map()))
    (tmp_path / "out").write_text("kept")
    before = _contents(tmp_path)
    assert run(["export", *arguments]) == 2
    told = capsys.readouterr()
    assert re.search(message, told.err), told.err
    assert told.out == ""
    assert _contents(tmp_path) == before


def test_params_is_what_tune_wrote(folder: Path, tmp_path: Path) -> None:
    export("params", folder / "design.toml", "-o", tmp_path / "params.toml")
    assert (tmp_path / "params.toml").read_bytes() == (folder / "params.toml").read_bytes()


def _contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_no_file_for_another_makers_drive_holds_a_value_that_nobody_stated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """0x2112 of a Copley, 10 s by assumption; `flash-params` leaves it alone, too."""
    values = {"motor.I_max_time_s": 10.0, "motor.pole_pairs": 4.0}
    path = tmp_path / "p.toml"
    for how, count in (({}, 2), ({"motor.I_max_time_s": ASSUMED}, 1)):
        path.write_text(ParameterSet(values, provenance=how).to_toml(), encoding="utf-8")
        assert run(["export", "cdcf", str(path), "--map", "copley", "-o", str(tmp_path / f"{count}.bin")]) == 0
        assert len(read_concise((tmp_path / f"{count}.bin").read_bytes())) == count
    assert "not written: motor.I_max_time_s: 10 s is assumed" in capsys.readouterr().err
