# SPDX-License-Identifier: MIT
"""The exported C compiles without a warning, and its memory is the image, byte for byte."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.export_c import (
    FLAGS,
    application_files,
    c_files,
    core_files,
    header_file,
    not_read,
    not_read_by_core,
)
from pmsmtool.firmware.image import crc32, pack_image
from pmsmtool.firmware.params_header import c_float
from pmsmtool.params.catalogue import CATALOGUE
from tests.firmware.exported_image import image_of_json

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")

MAIN = r"""
#include <stdio.h>
#include "%(prefix)s_cfg.h"
#include "pmsm_image.h"
int main(void)
{
    const uint8_t *bytes = (const uint8_t *)&%(prefix)s_cfg;
    uint32_t status = pmsm_image_check(bytes, %(up)s_CFG_BYTES, %(up)s_CFG_SCHEMA_VERSION, %(up)s_CFG_SIGNATURE,
                                       %(up)s_CFG_CRC32);
    if (fwrite(bytes, 1, %(up)s_CFG_BYTES, stdout) != %(up)s_CFG_BYTES) { return 99; }
    (void)%(up)s_CFG_LUT;
    return (int)status;
}
"""


def _values(**changes: float) -> dict[str, float]:
    return {row.name: row.default for row in CATALOGUE} | changes


def _with_table(fmt: int) -> bytes:
    n_x, n_y = 3, 4
    axes = struct.pack("<8f", -10.0, 0.0, 10.0, 0.0, 500.0, 1000.0, 2000.0, 210.0)
    cells = [0.1 * k - 0.7 for k in range(n_x * n_y)]
    if fmt == 1:
        tables = struct.pack("<24f", *cells, *reversed(cells))
    else:
        steps = [round(cell / 1e-3) for cell in cells]
        tables = struct.pack("<24h", *steps, *reversed(steps))
    shape = {"lut.format": fmt, "lut.n_x": n_x, "lut.n_y": n_y, "lut.n_z": 1, "lut.lsb_a": 1e-3}
    return pack_image(_values(**shape), axes + tables)


IMAGES = {"no table": pack_image(_values()), "binary32": _with_table(1), "int16": _with_table(2)}


@pytest.mark.chain
@needs_compiler
@pytest.mark.parametrize("content", IMAGES)
def test_compiled_memory_is_the_image(content: str, tmp_path: Path) -> None:
    image = IMAGES[content]
    for name, text in c_files(image, prefix="left_motor", design_id="sha256:00").items():
        (tmp_path / name).write_text(text)
    (tmp_path / "main.c").write_text(MAIN % {"prefix": "left_motor", "up": "LEFT_MOTOR"})
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    subprocess.run([COMPILER, *FLAGS.split(), "-o", "read_back", *sources], cwd=tmp_path, check=True)
    result = subprocess.run([tmp_path / "read_back"], capture_output=True)
    assert result.stdout == image
    assert result.returncode == 0, "the drive's own check accepts the exported image"


@needs_compiler
def test_a_core_of_another_layout_is_refused_by_the_compiler(tmp_path: Path) -> None:
    files = c_files(IMAGES["no table"])
    files["pmsm_params.h"] = files["pmsm_params.h"].replace("_SIGNATURE 0x", "_SIGNATURE 0x1")
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    result = subprocess.run([COMPILER, "-std=c99", "-c", "pmsm_cfg.c"], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode != 0 and "different layouts" in result.stderr


@needs_compiler
def test_the_single_header_compiles_in_two_translation_units(tmp_path: Path) -> None:
    (tmp_path / "pmsm_cfg.h").write_text(header_file(IMAGES["binary32"]))
    for name, text in c_files(IMAGES["binary32"]).items():
        if name.startswith("pmsm_") and name.endswith(".h") and name != "pmsm_cfg.h":
            (tmp_path / name).write_text(text)
    (tmp_path / "one.c").write_text(
        '#include "pmsm_cfg.h"\nuint32_t f(void) { return pmsm_cfg.params.motor_pole_pairs; }\n'
    )
    (tmp_path / "two.c").write_text('#include "pmsm_cfg.h"\nint main(void) { return (int)pmsm_cfg.lut[0] == 0; }\n')
    subprocess.run([COMPILER, "-std=c99", "-Werror", "-o", "p", "one.c", "two.c"], cwd=tmp_path, check=True)


@pytest.mark.parametrize("content", IMAGES)
def test_json_carries_the_same_image(content: str) -> None:
    text = c_files(IMAGES[content])["pmsm_cfg.json"]
    assert image_of_json(text) == IMAGES[content]
    assert json.loads(text)["crc32"] == crc32(IMAGES[content])


def test_two_exports_are_equal_and_the_text_is_plain() -> None:
    first, second = (c_files(IMAGES["int16"], design_id="sha256:ab") for _ in range(2))
    assert first == second
    assert all(text.isascii() and "\r" not in text for text in first.values())
    sources = [text for name, text in first.items() if name.endswith((".c", ".h"))]
    assert max(len(line) for text in sources for line in text.splitlines()) <= 120


@pytest.mark.parametrize("prefix", ["", "2nd", "a-b", "x" * 40, "a b"])
def test_a_prefix_that_is_no_c_name_is_refused(prefix: str) -> None:
    with pytest.raises(ConfigError, match="prefix"):
        c_files(IMAGES["no table"], prefix=prefix)


@pytest.mark.chain
@settings(max_examples=500)
@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_a_literal_reads_back_to_the_same_bits(value: float) -> None:
    text = c_float(value)
    assert text.endswith("F")
    assert struct.pack("<f", float(text[:-1])) == struct.pack("<f", value)


@pytest.mark.chain
@needs_compiler
def test_what_no_file_reads_is_said_and_is_what_a_compiler_does_not_miss(tmp_path: Path) -> None:
    """Without the members that are named, the files compile; without the others, the compiler misses every one."""
    unread = set(not_read())
    by_application = {"encoder.pll_bandwidth_rad_s", "encoder.offset_rad", "protection.i_trip_apk"}
    assert by_application <= set(not_read_by_core()) - unread
    assert not {"current.K_p_d_v_per_a", "motor.psi_f_wb", "governor.k_max"} & set(not_read_by_core())

    def missed(gone: set[str]) -> str:
        for name, text in (*core_files(), *application_files()):
            if name == "pmsm_params.h":
                for row in CATALOGUE:
                    if row.name in gone:
                        text = text.replace(f" {row.c_name};", f" gone_{row.index:x}_{row.sub:x};")
            (tmp_path / name).write_text(text)
        sources = [str(path) for path in sorted(tmp_path.glob("*.c"))]
        assert COMPILER is not None
        asked = [COMPILER, "-std=c99", "-fsyntax-only", *sources]
        return subprocess.run(asked, capture_output=True, text=True, check=False, timeout=60).stderr

    assert "error" not in missed(unread)
    told = missed({row.name for row in CATALOGUE} - unread)
    assert [row.name for row in CATALOGUE if row.name not in unread and row.c_name not in told] == []


def test_the_export_says_of_every_value_whether_its_code_reads_it() -> None:
    files = c_files(pack_image(_values()))
    source = " ".join(files["pmsm_cfg.c"].split())
    by_application = set(not_read_by_core()) - set(not_read())
    assert by_application and not_read()
    for said, names in (("read by the application alone", by_application), ("not read by this code", set(not_read()))):
        listed = files["pmsm_cfg.h"].split("#ifndef")[0].split(said)[1].split(" * for")[0]
        for row in CATALOGUE:
            comment = source.split(f".{row.c_name} = ")[1].split("*/")[0]
            assert (said in comment) is (row.name in names), row.name
            assert (row.name in listed.replace(",", " ").split()) is (row.name in names)
    content = json.loads(files["pmsm_cfg.json"])
    assert (content["not_read_by_core"], content["not_read"]) == (list(not_read_by_core()), list(not_read()))
