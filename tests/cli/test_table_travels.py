# SPDX-License-Identifier: MIT
"""A look-up table on its way: from ``lut`` through every export into the drive and back, the same everywhere."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import struct
import subprocess
import zlib
from collections.abc import Mapping
from pathlib import Path

import canopen
import numpy as np
import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.commissioning.export import image_of
from pmsmtool.commissioning.parameter_source import load_parameters
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.export_c import FLAGS
from pmsmtool.npz_file import npz_bytes, read_npz
from pmsmtool.params.parameter_set import ParameterSet, default_set, read_parameter_set
from tests.concise_dcf import read_concise
from tests.firmware.exported_image import image_of_json
from tests.simulated_bus import settle

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
KINDS = {
    "speed, float32": ("--axis", "speed", "--stored", "float32"),
    "speed, int16": ("--axis", "speed", "--stored", "int16"),
    "flux, float32": ("--axis", "flux", "--stored", "float32"),
    "flux, int16": ("--axis", "flux", "--stored", "int16"),
    "three voltages, int16": ("--stored", "int16", "--u-dc", "150V", "--u-dc", "160V", "--u-dc", "173V"),
}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Journals and backups stay here: where the tests run there may be no home folder."""
    settle(tmp_path, monkeypatch)


def run(*arguments: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(cli, [str(a) for a in arguments])
    return int(getattr(result.exception, "exit_code", result.exit_code)), result.stdout


def table(folder: Path, kind: str) -> Path:
    path = folder / "lut.npz"
    points = ("--torque-points", "9", "--speed-points", "7")
    assert run("lut", "mtpv-test", "-o", path, *points, *KINDS[kind])[0] == 0
    return path


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete parameter set without a table."""
    folder = tmp_path_factory.mktemp("design")
    code, _ = run("tune", "mtpv-test", "-o", folder / "design.toml", "--field-weakening", "accelerated")
    assert code == 0
    return folder / "params.toml"


def stored_currents(path: Path) -> tuple[np.ndarray, np.ndarray]:
    arrays = read_npz(path)
    return arrays["i_d_a"].ravel(), arrays["i_q_a"].ravel()


@pytest.mark.parametrize("kind", KINDS)
def test_the_file_gives_the_numbers_of_the_table(kind: str, tmp_path: Path) -> None:
    path = table(tmp_path, kind)
    found = load_parameters(path)
    assert found.violations() == ()
    assert found.values["lut.axis_kind"] == (1.0 if kind.startswith("flux") else 0.0)
    assert found.values["lut.n_z"] == (3.0 if kind.startswith("three") else 1.0)
    for name, currents in zip(("lut.i_d_a", "lut.i_q_a"), stored_currents(path), strict=True):
        assert np.array_equal(found.tables[name], currents)
    facts = json.loads(str(read_npz(path)["meta"]))
    words = image_of(over_defaults(found))[-4 * words_of(found.values) :]
    assert zlib.crc32(words) == facts["words_crc32"]


def words_of(values: Mapping[str, float]) -> int:
    n_x, n_y, n_z = (int(values[f"lut.n_{axis}"]) for axis in "xyz")
    cells = n_x * n_y * n_z
    return n_x + n_y + n_z + 2 * (cells if values["lut.format"] == 1.0 else (cells + 1) // 2)


def over_defaults(found: ParameterSet) -> ParameterSet:
    return default_set().merged(found)


@pytest.mark.parametrize("kind", KINDS)
def test_every_export_holds_the_same_table(kind: str, complete: Path, tmp_path: Path) -> None:
    path = table(tmp_path, kind)
    whole = tmp_path / "whole.toml"
    whole.write_text(read_parameter_set(complete).merged(load_parameters(path)).to_toml())
    image = image_of(load_parameters(whole))
    # CSV: what the drive will hold, number by number
    code, text = run("export", "csv", path)
    assert code == 0
    rows = {row["name"]: row for row in csv.DictReader(io.StringIO(text))}
    i_d, _ = stored_currents(path)
    held = np.array([float(rows[f"lut.i_d_a[{k}]"]["held"]) for k in range(i_d.size)])
    assert np.allclose(held, i_d, rtol=1e-7, atol=1e-9)
    # DCF and concise DCF: the bytes of the DOMAIN objects
    wanted = domains(load_parameters(path))
    assert run("export", "dcf", whole, "-o", tmp_path / "drive.dcf")[0] == 0
    assert image_of(load_parameters(tmp_path / "drive.dcf")) == image
    assert canopen.import_od(str(tmp_path / "drive.dcf")) is not None
    assert run("export", "cdcf", whole, "-o", tmp_path / "drive.cdcf")[0] == 0
    entries = {e.index: e.data for e in read_concise((tmp_path / "drive.cdcf").read_bytes())}
    assert {index: entries[index] for index in wanted} == wanted
    # C: the image with its CRC-32
    assert run("export", "c", whole, "-o", tmp_path / "c")[0] == 0
    assert image_of_json(next((tmp_path / "c").glob("*.json")).read_text()) == image
    assert run("export", "header", whole, "-o", tmp_path / "c" / "one.h")[0] == 0
    if COMPILER is None:
        pytest.skip("no C compiler on this machine")
    (tmp_path / "c" / "main.c").write_text(
        '#include <stdio.h>\n#include "one.h"\n'
        "int main(void) { return fwrite(&pmsm_cfg, 1, sizeof pmsm_cfg, stdout) == sizeof pmsm_cfg ? 0 : 1; }\n"
    )
    flags = [*FLAGS.split(), "-o", "read_back", "main.c"]
    subprocess.run([COMPILER, *flags], cwd=tmp_path / "c", check=True)
    assert subprocess.run([tmp_path / "c" / "read_back"], capture_output=True, check=True).stdout == image


def domains(found: ParameterSet) -> dict[int, bytes]:
    """DOMAIN objects of a table, packed here."""
    formats = {1.0: "f", 2.0: "h"}
    letter = formats[found.values["lut.format"]]
    made = {}
    for index, name in ((0x2044, "lut.axis_x"), (0x2045, "lut.axis_y"), (0x2046, "lut.axis_z")):
        made[index] = struct.pack(f"<{len(found.tables[name])}f", *found.tables[name])
    for index, name in ((0x2042, "lut.i_d_a"), (0x2043, "lut.i_q_a")):
        numbers = found.tables[name]
        if letter == "h":
            steps = [-32768 if x != x else round(x / found.values["lut.lsb_a"]) for x in numbers]
            made[index] = struct.pack(f"<{len(steps)}h", *steps) + bytes(2 * (len(steps) % 2))
        else:
            made[index] = struct.pack(f"<{len(numbers)}f", *numbers)
    return made


@pytest.mark.chain
@pytest.mark.parametrize("kind", KINDS)
def test_the_drive_takes_it_and_gives_it_back(kind: str, complete: Path, tmp_path: Path) -> None:
    path = table(tmp_path, kind)
    bus = ("-i", "pmsmsim", "-c", f"mtpv-test?nv={tmp_path / 'drive.nv'}")
    code, text = run("--yes", *bus, "flash-params", path)
    assert code == 0
    crc = int(re.search(r"CRC-32 0x([0-9a-f]+)", text)[1], 16)  # type: ignore[index]
    # another process, after a reset: the bytes of every DOMAIN are compared
    assert run(*bus, "verify", path)[0] == 0
    # what it holds, read back as a whole: the image has the CRC-32 the drive reported
    assert run(*bus, "param", "dump", "--all", "-o", tmp_path / "held.toml")[0] == 0
    held = read_parameter_set(tmp_path / "held.toml")
    assert zlib.crc32(image_of(held)) == crc
    for name, currents in zip(("lut.i_d_a", "lut.i_q_a"), stored_currents(path), strict=True):
        assert np.allclose(held.tables[name], currents, rtol=1e-7, atol=1e-9, equal_nan=True)
    # one current that differs is found
    found = load_parameters(path)
    moved = list(found.tables["lut.i_q_a"])
    moved[5] += 0.5
    (tmp_path / "moved.toml").write_text(over_defaults(found).merged(ParameterSet({}, {"lut.i_q_a": moved})).to_toml())
    assert run(*bus, "verify", tmp_path / "moved.toml")[0] == 1


def test_an_edited_table_is_refused(tmp_path: Path) -> None:
    path = table(tmp_path, "speed, float32")
    arrays = read_npz(path)
    arrays["i_d_a"] = arrays["i_d_a"] * 1.001
    path.write_bytes(npz_bytes(arrays))
    with pytest.raises(ConfigError, match="CRC-32"):
        load_parameters(path)
    assert run("export", "csv", path)[0] == 2
    path.write_bytes(npz_bytes({"meta": np.array("{}")}))
    with pytest.raises(ConfigError, match="no look-up table"):
        load_parameters(path)
