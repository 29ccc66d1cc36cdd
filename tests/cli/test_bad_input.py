# SPDX-License-Identifier: MIT
"""Bad input through the command line: one clear message each, the documented exit code, and nothing written."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.cli import main
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file

ROOT = Path(__file__).resolve().parents[2]

SCENARIO = """schema = "pmsmtool.scenario/1"
duration_s = 0.01
mode = "current"
rotor = "driven"
start_rpm = 300.0

[schedule]
i_q_a = 2.0
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a machine file, its flux map and a scenario, all good; the current one."""
    for suffix in ("toml", "csv"):
        shutil.copy(data_folder("profiles") / f"saturated-pmsyrm.{suffix}", tmp_path)
    (tmp_path / "saturated-pmsyrm.toml").rename(tmp_path / "machine.toml")
    (tmp_path / "saturated-pmsyrm.csv").rename(tmp_path / "map.csv")
    (tmp_path / "scenario.toml").write_text(SCENARIO, encoding="utf-8")
    edit(tmp_path / "machine.toml", "saturated-pmsyrm.csv", "map.csv")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding="utf-8")


def told(code: int, command: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a command that must fail with a code; return its message, which is one and has no traceback."""
    before = {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()}
    assert main.run(command.split()) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    assert [line.split(":")[0] for line in printed.err.splitlines() if not line.startswith(" ")] == ["error"]
    assert {path: path.read_bytes() for path in Path().rglob("*") if path.is_file()} == before
    return printed.err


READERS = (
    "tune machine.toml -o new.toml",
    "lut machine.toml -o new.npz",
    "simulate machine.toml --scenario scenario.toml -o new.npz",
)
"""Commands that read a machine file; a bad one is refused by each alike."""

# ---- the machine file ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("R_s_ohm = 0.63", "R_s_ohms = 0.63", ("R_s_ohms: unknown key; did you mean R_s_ohm?", "R_s_ohm is missing")),
        ("R_s_ohm = 0.63", "R_s_mohm = 630", ("R_s_mohm: unknown key; did you mean R_s_ohm?",)),
        ("R_s_ohm = 0.63", 'R_s_ohm = "0.63 ohm"', ("R_s_ohm is text; write the number 0.63 (in ohm)",)),
        ("R_s_ohm = 0.63", "R_s_ohm = -0.63", ("R_s_ohm = -0.63 is below 1e-05 ohm",)),
        ("psi_f_wb = 0.47669", "psi_f_wb = nan", ("psi_f_wb = nan",)),
        ("pole_pairs = 2\n", "", ("pole_pairs is missing",)),
        ("[machine]", "[motor]", ("motor: unknown key or table",)),
        ("[machine]", "[machine", ("is not TOML",)),
        ('schema = "pmsmtool.machine/1"', 'schema = "pmsmtool.machine/9"', ("schema",)),
    ],
)
def test_machine_file(
    command: str, old: str, new: str, says: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(folder / "machine.toml", old, new)
    message = told(2, command, capsys)
    assert [part for part in says if part not in message] == [], message
    assert "machine.toml" in message


def test_all_that_is_wrong_is_listed_with_its_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(folder / "machine.toml", "R_s_ohm = 0.63", "R_s_ohm = -0.63")
    edit(folder / "machine.toml", "f_s_hz = 12000.0", "f_s_khz = 12")
    edit(folder / "machine.toml", "direction = 1", "direction = 0")
    edit(folder / "map.csv", "A,A,Wb,Wb", "A,A,Nm,Wb")
    lines = (folder / "machine.toml").read_text(encoding="utf-8").splitlines()
    message = told(2, READERS[0], capsys)
    for text in ("R_s_ohm = -0.63", "f_s_khz = 12", "direction = 0", 'flux_map = "map.csv"'):
        assert f"  - machine.toml:{1 + lines.index(text)}: " in message
    assert "5 things are wrong" in message  # and f_s_hz is missing


def test_a_machine_where_a_design_is_due_is_to_be_tuned(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in ("margins machine.toml", "export c machine.toml -o c", "prove machine.toml --sim interior-2k2"):
        assert "`pmsmtool tune machine.toml -o design.toml` designs them" in told(2, command, capsys)


# ---- the flux map ------------------------------------------------------------------------------------------------


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def not_numeric(path: Path) -> None:
    edit(path, "-26.0,-26.0,0.0462771304,", "-26.0,-26.0,n/a?,")


def folded(path: Path) -> None:
    """The q flux of one strip has its sign turned: it falls with the current there."""
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for row in rows[2:-1]:
        if 4.0 <= float(row[1]) <= 8.0:
            row[3] = str(-float(row[3]))
    path.write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")


def wrong_unit(path: Path) -> None:
    edit(path, "A,A,Wb,Wb", "A,A,V,Wb")


def as_archive(change: Callable[[dict[str, np.ndarray]], None]) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        flux_map = load_machine_file(path.with_name("machine.toml")).flux_map
        arrays = {name: np.array(getattr(flux_map, name)) for name in ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb")}
        change(arrays)
        np.savez(path.with_suffix(".npz"), **arrays)
        edit(path.with_name("machine.toml"), "map.csv", "map.npz")

    return make


def backwards(arrays: dict[str, np.ndarray]) -> None:
    arrays["i_d_a"][[3, 4]] = arrays["i_d_a"][[4, 3]]


def with_holes(arrays: dict[str, np.ndarray]) -> None:
    arrays["psi_q_wb"][5, 6:9] = np.nan


def of_text(arrays: dict[str, np.ndarray]) -> None:
    arrays["psi_d_wb"] = arrays["psi_d_wb"].astype(str)


def cut_archive(path: Path) -> None:
    as_archive(lambda arrays: None)(path)
    cut(path.with_suffix(".npz"))


def gone(path: Path) -> None:
    path.unlink()


MAPS: dict[str, tuple[Callable[[Path], None], str]] = {
    "missing": (gone, "no such file"),
    "truncated": (cut, r"holes|the row ends|leaves out zero current"),
    "truncated archive": (cut_archive, "not a complete .npz archive"),
    "not numeric": (not_numeric, r"'n/a\?' in psi_d_wb is not a number"),
    "not numeric archive": (as_archive(of_text), "psi_d_wb is not numeric"),
    "flux not monotonic": (folded, r"flux does not rise with current at \d+ of \d+ points, worst near i_d = "),
    "axis not monotonic": (as_archive(backwards), "axis i_d_a does not increase: -2[0-9] A is followed by -2[0-9] A"),
    "holes": (as_archive(with_holes), "3 of 2809 nodes are holes"),
    "wrong unit": (wrong_unit, "'V' .* is a unit of voltage, not of flux linkage"),
}


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("kind", MAPS)
def test_flux_map(command: str, kind: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil, says = MAPS[kind]
    spoil(folder / "map.csv")
    message = told(2, command, capsys)
    assert re.search(says, message)
    assert "1 thing is wrong" in message
    assert "[machine] flux_map: " in message


@pytest.mark.parametrize("kind", sorted(MAPS.keys() - {"flux not monotonic"}))
def test_flux_map_alone(kind: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil, says = MAPS[kind]
    spoil(folder / "map.csv")
    name = "map.npz" if (folder / "map.npz").exists() else "map.csv"
    message = told(2, f"machine map {name}", capsys)
    assert re.search(says, message)
    assert name in message


def test_a_map_that_is_not_monotonic_is_reported_with_numbers(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folded(folder / "map.csv")
    assert main.run(["machine", "map", "map.csv"]) == 1
    printed = capsys.readouterr()
    assert re.search(r"BAD  monotonic: flux rises with current at \d+ of \d+ points", printed.out)
    assert "not good" in printed.err


def turned(path: Path) -> None:
    """The q fluxes are a tenth too large where i_d is positive: no machine has such a map, but it can be inverted."""
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    for row in rows[2:-1]:
        row[3] = str(float(row[3]) * (1.1 if float(row[0]) > 0.0 else 1.0))
    path.write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")


@pytest.mark.chain
@pytest.mark.parametrize(
    "command",
    [
        "tune machine.toml -o new.toml",
        "lut machine.toml --torque-points 5 --speed-points 4 --torque-bound 1 --voltage-bound 1 -o new.npz",
        "simulate machine.toml --scenario scenario.toml -o new.npz",
    ],
)
def test_a_map_without_a_co_energy_is_used_but_not_silently(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned(folder / "map.csv")
    assert main.run(command.split()) == 0
    assert re.search(r"flux map, reciprocal: [\d.]+ % rms", capsys.readouterr().err)


# ---- what is typed -------------------------------------------------------------------------------------------------


@pytest.mark.chain
@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("tune nothing.toml -o new.toml", "no such file"),
        ("lut nothing.toml -o new.npz", "no such file"),
        ("simulate nothing.toml --scenario scenario.toml -o new.npz", "no such file"),
        ("simulate machine.toml --scenario nothing.toml -o new.npz", "no such file"),
        ("machine map nothing.npz", "no such file"),
        ("tune map.csv -o new.toml", "is not TOML"),
        ("tune scenario.toml -o new.toml", "schema"),
        ("tune machine.toml -o new.toml --drive-bandwidth-hz 95", "for a drive that cannot be reflashed"),
        ("tune machine.toml -o new.toml --limit-speed-rpm 600", "--limit-speed-rpm: for a drive that"),
        ("simulate machine.toml --scenario machine.toml -o new.npz", "schema"),
        ("simulate machine.toml --scenario scenario.toml -o new.npz --duration 250", "has no unit"),
        ("simulate machine.toml --scenario scenario.toml -o new.npz --duration 250Hz", "of frequency, not of time"),
        ("simulate machine.toml --scenario scenario.toml -o new.npz --set R_s_ohm=-1", "R_s_ohm = -1 is below"),
        ("simulate machine.toml --scenario scenario.toml -o new.npz --set R_s=1", "did you mean R_s_ohm?"),
        ("lut machine.toml -o new.npz --u-dc 540Nm", "not of voltage"),
        ("machine new --name m --pole-pairs 4 --r 0.3 --l 4mH --ke 58Vrms/krpm --u-dc 540V --pwm 12kHz -o new.toml",
         "has no unit"),
        ("machine new --name m --pole-pairs 4 --r -0.3ohm --l 4mH --kt 1Nm/Arms --u-dc 540V --pwm 12kHz -o new.toml",
         "--r -0.3 is not above zero"),
        ("machine new --pole-pairs 1e30", "'1e30' is not a whole number"),
    ],
)  # fmt: skip
def test_arguments(command: str, says: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert says in told(2, command, capsys)


# ---- a folder that cannot be written -----------------------------------------------------------------------------

WRITERS = (
    "tune machine.toml -o {}/new.toml",
    "lut machine.toml --torque-points 5 --speed-points 4 --torque-bound 1 --voltage-bound 1 -o {}/new.npz",
    "simulate machine.toml --scenario scenario.toml -o {}/new.npz",
    "simulate machine.toml --scenario scenario.toml -o {}/new.csv",
    "simulate machine.toml --scenario scenario.toml --plot {}/new.svg",
    "machine map map.csv -o {}/new.npz",
    "machine new --name m --pole-pairs 4 --r 0.3ohm --l 4mH --ke 58Vrms/krpm --ke-between line-line --u-dc 540V"
    " --pwm 12kHz -o {}/new.toml",
)
NOBODY = 65534
"""A user without rights; the superuser writes everywhere."""


@pytest.fixture
def read_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that everybody may read and nobody write, beside the good files; all where everybody may enter."""
    if sys.platform == "win32":
        pytest.skip("folders are not made read-only by their mode")
    above = Path(tempfile.mkdtemp())
    above.chmod(0o755)
    for path in folder.iterdir():
        shutil.copy(path, above)
    (above / "writable").mkdir()
    (above / "read-only").mkdir()
    (above / "read-only").chmod(0o555)
    monkeypatch.chdir(above)
    yield above / "read-only"
    monkeypatch.chdir(folder)
    shutil.rmtree(above)


@pytest.mark.chain
@pytest.mark.parametrize("command", WRITERS, ids=lambda command: " ".join(command.split()[:3]))
def test_read_only_folder(command: str, read_only: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(command.format("writable").split()) == 0  # it is the folder; and all modules are loaded
    capsys.readouterr()
    superuser = os.geteuid() == 0
    try:
        if superuser:
            os.seteuid(NOBODY)
        code = main.run(command.format("read-only").split())
    finally:
        if superuser:
            os.seteuid(0)
    message = capsys.readouterr().err
    assert code == 2, message
    assert message.count("error: ") == 1
    assert "cannot be written: Permission denied" in message
    assert "read-only" in message
    assert "choose another folder" in message
    assert "Traceback" not in message
    assert list(read_only.iterdir()) == []


@pytest.mark.chain
def test_fresh_process_says_the_same(folder: Path) -> None:
    """What the tests above see in one process is what a shell sees."""
    edit(folder / "machine.toml", "R_s_ohm = 0.63", "R_s_ohm = -0.63")
    done = subprocess.run(
        [sys.executable, "-m", "pmsmtool", *READERS[0].split()],
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[0] == "error: 1 thing is wrong in this machine"
    assert not (folder / "new.toml").exists()


# ---- what an option may be -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("tune machine.toml -o new.toml --bandwidth-hz -4", "--bandwidth-hz -4.0 is not a positive number"),
        ("tune machine.toml -o new.toml --phase-margin-deg 95", "--phase-margin-deg 95.0 is not between 0 and 90"),
        ("tune machine.toml -o new.toml --eps 2", "--eps 2.0 is outside 0..0.5"),
        ("tune machine.toml -o new.toml --map copley --drive-bandwidth-hz -4", "--drive-bandwidth-hz -4.0 is not a"),
        ("tune machine.toml -o new.toml --map copley --limit-rise-s 0", "--limit-rise-s 0.0 is not a positive number"),
        ("lut machine.toml -o new.npz --speed-points 1", "--speed-points 1 is outside 2..4096"),
        ("commission machine.toml --bandwidth-hz 0", "--bandwidth-hz 0.0 is not a positive number"),
    ],
)
def test_a_value_out_of_range_names_the_option_that_was_typed(
    folder: Path, command: str, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    err = told(2, command, capsys)
    assert f"  - {says}" in err and "--help says what each option takes" in err
