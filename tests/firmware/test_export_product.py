# SPDX-License-Identifier: MIT
"""An exported folder as a product: its page, only the laws in use, and no need of a C library."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import pytest

from pmsmtool.firmware.export_c import FLAGS, c_files, not_read_by_core
from pmsmtool.firmware.export_readme import COSTS, counted_law, period_share, structure_bytes
from pmsmtool.firmware.image import pack_image
from pmsmtool.firmware.laws import LAWS, laws_in_use
from pmsmtool.params.catalogue import CATALOGUE
from tests.pages import fenced

PAGE = Path(__file__).resolve().parents[2] / "docs/firmware.md"
COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
needs_linux_compiler = pytest.mark.skipif(
    COMPILER is None or not sys.platform.startswith("linux"), reason="no C compiler that links ELF on this machine"
)
OFF = {"governor.mode": 0, "field_weakening.mode": 1, "polar.mode": 0}
ALONE = {law.name: OFF | {law.mode: law.last_without + 1} for law in LAWS} | {"none": OFF}

CHECK = r"""
#include "pmsm_core.h"
#include "pmsm_image.h"
typedef char state_check[(sizeof(pmsm_state) == %(state)uu) ? 1 : -1];
typedef char measurement_check[(sizeof(pmsm_measurement) == %(measurement)uu) ? 1 : -1];
typedef char reference_check[(sizeof(pmsm_reference) == %(reference)uu) ? 1 : -1];
typedef char output_check[(sizeof(pmsm_output) == %(output)uu) ? 1 : -1];
#include "pmsm_application.h"
typedef char sensors_check[(sizeof(pmsm_sensors) == %(sensors)uu) ? 1 : -1];
typedef char application_check[(sizeof(pmsm_application) - 4u * (sizeof(void *) - 4u) == %(application)uu) ? 1 : -1];
"""


def values(changes: Mapping[str, float]) -> dict[str, float]:
    return {row.name: row.default for row in CATALOGUE} | changes


def exported(changes: Mapping[str, float], *, all_laws: bool = False, prefix: str = "left") -> dict[str, str]:
    return c_files(pack_image(values(changes)), prefix=prefix, all_laws=all_laws)


def included(files: Mapping[str, str]) -> set[str]:
    return {name for text in files.values() for name in re.findall(r'^#include "(.+)"', text, re.MULTILINE)}


@pytest.mark.parametrize("law", ALONE)
def test_only_the_laws_in_use_are_written(law: str) -> None:
    files = exported(ALONE[law])
    assert included(files) <= set(files), "every header that is included is there"
    assert {name.split("_")[0] for name in files} == {"left", "pmsm", "README.md"}
    kept = {one.name for one in laws_in_use(values(ALONE[law]))}
    assert kept == {law} - {"none"}
    for one in LAWS:
        source = "pmsm_" + one.sources[0]
        assert (source in files) is (one.name in kept)
        assert f"#define {one.macro} {int(one.name in kept)}" in files["pmsm_laws.h"]
    assert set(files) < set(exported(ALONE[law], all_laws=True))


@pytest.mark.chain
@needs_linux_compiler
@pytest.mark.parametrize(
    ("law", "optimised"), [("none", "-O0"), ("polar control", "-O1"), ("reference governor", "-O2")]
)
def test_it_links_without_a_c_library(law: str, optimised: str, tmp_path: Path) -> None:
    """As its page says; every function called is in the folder, so nothing is missing when all must be resolved."""
    files = exported(ALONE[law]) | {"check.c": CHECK % structure_bytes()}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    page = files["README.md"]
    assert all(flag in page for flag in ("-ffreestanding", "-DPMSM_NO_C_LIBRARY", FLAGS))
    command = [COMPILER, *FLAGS.split(), optimised, "-ffreestanding", "-DPMSM_NO_C_LIBRARY", "-fPIC", "-nostdlib"]
    link = ["-shared", "-Wl,-z,defs", "-Wl,-Bsymbolic", "-o", "core.so"]
    done = subprocess.run([*command, *link, *sources], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.chain
@pytest.mark.skipif(find_spec("ziglang") is None, reason="no ziglang: pip install -e '.[cross]'")
def test_the_documented_command_links_the_example_for_a_cortex_m4(tmp_path: Path) -> None:
    """As docs/firmware.md says, word by word: no symbol is missing without a C library."""
    for name, text in exported(ALONE["none"]).items():
        (tmp_path / name).write_text(text)
    (block,) = (text for text in fenced(PAGE.read_text(encoding="utf-8"), "") if "thumb" in text)
    command = block.partition("python -m ")[2].replace("\\\n", " ").split()
    at = command.index("*.c")
    command[at : at + 1] = sorted(path.name for path in tmp_path.glob("*.c"))
    done = subprocess.run([sys.executable, "-m", *command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert struct.unpack_from("<HH", (tmp_path / command[-1]).read_bytes(), 16) == (2, 40), "a program, for ARM"


@pytest.mark.chain
@needs_linux_compiler
def test_a_set_for_a_law_that_was_left_out_is_refused(tmp_path: Path) -> None:
    """The image check of a core without polar control takes its own set, and no polar one."""
    (tmp_path / "main.c").write_text(
        '#include "left_cfg.h"\n#include "right_cfg.h"\n#include "pmsm_image.h"\nint main(void)\n{\n'
        "    return (int)(pmsm_image_check_content((const uint8_t *)&left_cfg, LEFT_CFG_BYTES) * 16u +\n"
        "                 pmsm_image_check_content((const uint8_t *)&right_cfg, RIGHT_CFG_BYTES));\n}\n"
    )
    left = exported(ALONE["none"])
    right = {k: text for k, text in exported(ALONE["polar control"], prefix="right").items() if k.startswith("right")}
    for name, text in (left | right).items():
        (tmp_path / name).write_text(text)
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    assert COMPILER is not None
    subprocess.run([COMPILER, "-std=c99", "-fno-math-errno", "-o", "check", *sources], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "check"], check=False).returncode == 5, "PMSM_IMAGE_OK, PMSM_IMAGE_RANGE"


@pytest.mark.chain
@needs_linux_compiler
@pytest.mark.parametrize("changed", [False, True], ids=["as exported", "a constant changed by hand"])
def test_the_example_that_the_page_names_checks_the_constants(changed: bool, tmp_path: Path) -> None:
    """Before, the page's calls began with ``pmsm_init``: a program by the page ran on any constants."""
    files = exported(ALONE["none"])
    assert "`pmsm_image_check(...)` as in `left_main.c`" in files["README.md"]
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    if changed:
        held = files["left_cfg.c"]
        other = re.sub(r"(\.motor_R_s_ohm = )[0-9.]+F", r"\g<1>4.0F", held)
        assert other != held
        (tmp_path / "left_cfg.c").write_text(other)
    assert COMPILER is not None
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    flags = ["-std=c99", "-fno-math-errno", "-DPMSM_EXAMPLE_MAIN", "-o", "example"]
    subprocess.run([COMPILER, *flags, *sources, "-lm"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "example"], check=False).returncode == (2 if changed else 0)


def test_the_share_of_a_fast_period_exceeds_it() -> None:
    slow, fast = (period_share(values({"governor.mode": 3}) | {"inverter.T_s_ns": T}) for T in (83_333.0, 35_000.0))
    assert slow < 1.0 < fast


def test_what_the_kept_laws_do_not_read_is_said() -> None:
    source = " ".join(exported(ALONE["none"])["left_cfg.c"].split())
    for row in CATALOGUE:
        comment = source.split(f".{row.c_name} = ")[1].split("*/")[0]
        dead = row.name in not_read_by_core(()) and row.name not in not_read_by_core()
        assert ("of a law that is left out" in comment) is dead, row.name
    assert {"polar.gamma", "governor.eps"} <= set(not_read_by_core(())) - set(not_read_by_core())


def test_the_page_states_the_numbers_that_were_measured() -> None:
    table = (Path(__file__).resolve().parents[2] / "benchmarks" / "core_cost.md").read_text(encoding="ascii")
    for law, cost in COSTS.items():
        cells = next(line for line in table.splitlines() if line.startswith(f"| {law} |")).split("|")
        counted = [int(cell.split("(")[1].split(")")[0]) for cell in cells[2:6]]
        assert (counted[0], counted[1], counted[3]) == cost[:3], law


@pytest.mark.parametrize(
    ("changes", "law"),
    [
        ({"governor.mode": 0, "current.options": 7}, "PI"),
        ({"governor.mode": 0, "current.options": 23}, "PI, predictor"),
        ({"governor.mode": 2}, "line search"),
        ({"governor.mode": 1}, "exact, 12 rows"),
        ({"governor.mode": 3, "governor.options": 2, "field_weakening.mode": 1}, "best, delay"),
        ({"governor.mode": 3, "governor.options": 0, "field_weakening.mode": 3}, "best + accelerated FW"),
        ({"polar.mode": 2}, "polar, proposed"),
        ({"polar.mode": 5}, "polar, regularised"),
        ({"polar.mode": 6}, "polar, unified"),
    ],
)
def test_the_page_takes_the_counted_law_of_the_set(changes: dict[str, float], law: str) -> None:
    assert counted_law(values(changes)) == law
    page = exported(changes)["README.md"]
    assert f"`{law}`" in " ".join(page.split()) and f"{COSTS[law].worst} at worst" in " ".join(page.split())
    assert f"most found | {COSTS[law].stack} |" in page and f"each motor | {structure_bytes()['state']} |" in page
    assert "{" not in page and "@" not in page and max(map(len, page.splitlines())) <= 130


def test_a_set_with_the_tables_of_a_saturated_machine_states_its_own_cost() -> None:
    """It stated that of the constant inductances, 45 % of a period instead of 51."""
    saturated = {"governor.mode": 3, "saturation.n_d": 7, "field_weakening.mode": 1}
    assert counted_law(values(saturated)) == "saturated: best + table"
    assert counted_law(values({**saturated, "governor.options": 2})) == "saturated: best + table, predictor"
    assert period_share(values(saturated)) > 1.1 * period_share(values({"governor.mode": 3}))
