# SPDX-License-Identifier: MIT
"""`pmsmtool diff` and `fleet`: what two runs identified, and many."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.errors import CheckFailed, ConfigError
from pmsmtool.identification.compared_runs import LEAST_SERIES, differences, drift, same_drive, series
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.machine.parameters import Estimate
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.run_directory import RunDirectory, RunRecord, Stage

R = Estimate(0.5, 0.001, 0.005, "ohm", T_c=25.0)
PSI = Estimate(0.1, 0.0001, 0.001, "Wb", T_c=25.0)


def moved(estimate: Estimate, share: float) -> Estimate:
    return replace(estimate, value=estimate.value * (1.0 + share))


def run_of(
    folder: Path, label: str, estimates: dict[str, Estimate], serial: int = 5, name: str = "interior-2k2"
) -> Path:
    path = folder / label
    path.mkdir(parents=True)
    record = RunRecord("2026-01-01T00:00:00Z", "x", ("identify",), {}, {"serial": serial, "vendor": 1}, {})
    run = RunDirectory.create(path, serial, record)
    machine = replace(load_machine_file(machine_path("interior-2k2")), estimates=estimates, name=name)
    run.save("machine.toml", dump_machine_file(machine))
    return run.path


def told(*arguments: object) -> dict[str, object]:
    outcome = CliRunner().invoke(cli, ["--json", *map(str, arguments)])
    assert outcome.exception is None, outcome.exception
    found: dict[str, object] = json.loads(outcome.stdout)
    return found


def test_the_sensors_part_counts_between_two_drives_only() -> None:
    """1 % of R is 2.5 of the scattering intervals and 0.7 of the total ones."""
    other = moved(R, 0.01)
    (same,) = differences({"R_s_ohm": R}, {"R_s_ohm": other}, same_sensors=True)
    (two,) = differences({"R_s_ohm": R}, {"R_s_ohm": other}, same_sensors=False)
    assert (same.verdict, two.verdict) == ("differs", "agrees")
    assert same.difference == pytest.approx(0.005)
    assert same.interval == pytest.approx(1.96 * 0.001 * math.sqrt(2), rel=1e-3)
    assert two.interval == pytest.approx(math.sqrt(2) * math.hypot(1.96 * 0.001, 0.005), rel=1e-3)
    (gone,) = differences({"R_s_ohm": R}, {}, same_sensors=True)
    assert gone.verdict == "only in the first" and math.isnan(gone.difference)


def test_the_way_to_the_reference_temperature_counts_on_one_drive_too() -> None:
    """35 K apart one machine showed 2 % of R, 3.6 of the scattering intervals: its devices are no copper."""
    machine = load_machine_file(machine_path("interior-2k2")).machine
    first = {"R_s_ohm": R, "psi_f_wb": PSI, "offset_rad": Estimate(3.14, 0.001, 0.0, "rad")}

    def verdicts(share: float, T_c: float, offset: float = 3.14, **known: float) -> list[str]:
        second = {name: replace(moved(e, share), T_c=T_c) for name, e in first.items()}
        second["offset_rad"] = replace(first["offset_rad"], value=offset)
        rows = differences(first, second, same_sensors=True, machine=replace(machine, **known))
        return [row.verdict for row in rows]

    R_s, offset, psi = range(3)
    assert verdicts(0.02, 25.0)[R_s] == "differs" and verdicts(0.02, 60.0)[R_s] == "agrees"
    assert verdicts(0.02, 60.0, R_winding_ohm=0.4)[R_s] == "differs", "the copper part is known"
    assert verdicts(0.012, 60.0, R_winding_ohm=0.4)[R_s] == "agrees", "but within a data sheet's 10 % only"
    assert verdicts(0.012, 25.0, R_winding_ohm=0.4)[R_s] == "differs", "which counts by what the two are apart"
    assert verdicts(0.05, 60.0)[R_s] == "differs" and verdicts(0.05, math.nan)[R_s] == "agrees"
    assert verdicts(0.02, 60.0)[psi] == "agrees" and verdicts(0.02, 60.0, alpha_psi_per_k=-0.001)[psi] == "differs"
    assert verdicts(0.0, 25.0, -3.142)[offset] == "agrees" and verdicts(0.0, 25.0, -3.1)[offset] == "differs"


def test_values_that_scatter_as_they_say_differ_in_one_of_twenty() -> None:
    """400 pairs: 5 % of 95 % intervals, here at most 9 % (measured 4.5)."""
    rng = np.random.default_rng(7)
    pairs = rng.normal(R.value, R.std, (400, 2))
    two = [({"R": replace(R, value=a)}, {"R": replace(R, value=b)}) for a, b in pairs]
    found = [differences(*both, same_sensors=True)[0].verdict for both in two]
    assert 0.01 < found.count("differs") / 400 < 0.09


def test_a_drive_is_known_by_its_serial_number_whatever_else_was_recorded() -> None:
    """A commissioning records level and map of the drive, too: `diff` took it for another one."""
    drive = {"node": 1, "vendor": 5, "product": 2, "serial": 7, "software": "1.0"}
    assert same_drive(drive, {**drive, "node": 3, "software": "1.1", "level": "full", "map": "pmsmsim"})
    assert not same_drive(drive, {**drive, "serial": 8}) and not same_drive(drive, {**drive, "product": 3})
    assert not same_drive({**drive, "serial": 0}, {**drive, "serial": 0})


def test_two_runs_on_the_command_line(tmp_path: Path) -> None:
    first = run_of(tmp_path, "a", {"R_s_ohm": R, "psi_f_wb": PSI})
    second = run_of(tmp_path, "b", {"R_s_ohm": moved(R, 0.02), "psi_f_wb": PSI})
    found = told("diff", first, second)
    assert found["same_drive"] is True
    assert {row["name"]: row["verdict"] for row in found["quantities"]} == {"R_s_ohm": "differs", "psi_f_wb": "agrees"}  # type: ignore[attr-defined, index]
    outcome = CliRunner().invoke(cli, ["diff", str(first), str(second), "--check"])
    assert isinstance(outcome.exception, CheckFailed) and "R_s_ohm" in str(outcome.exception)
    assert "1 of 2 quantities agree" in outcome.stdout
    assert CliRunner().invoke(cli, ["diff", str(first), str(first), "--check"]).exit_code == 0
    assert CliRunner().invoke(cli, ["diff", str(first), str(second), "--check", "--tol", "3%"]).exit_code == 0
    assert CliRunner().invoke(cli, ["diff", str(first), str(second), "--check", "--tol", "1%"]).exit_code == 1
    assert CliRunner().invoke(cli, ["diff", str(first), str(second), "--tol", "5"]).exit_code == 2
    outcome = CliRunner().invoke(cli, ["diff", str(first), str(tmp_path)])
    assert isinstance(outcome.exception, ConfigError) and "run.json" in str(outcome.exception)


def test_what_neither_run_measured_does_not_agree(tmp_path: Path) -> None:
    """A drive with fixed firmware gives J alone; R of the data sheet was one of six that agreed."""
    given = {"R_s_ohm": replace(R, source="datasheet"), "psi_f_wb": PSI}
    first, second = run_of(tmp_path, "a", given), run_of(tmp_path, "b", given)
    out = CliRunner().invoke(cli, ["diff", str(first), str(second), "--check"]).stdout
    assert "1 of 1 quantities agree (one drive: without its sensors' part); as given, not compared: R_s_ohm" in out


def test_verdicts_and_parameters_of_two_runs_are_compared(tmp_path: Path) -> None:
    """A quantity that one run alone has is no quantity that disagrees; the verdict and the set were not looked at."""
    first = run_of(tmp_path, "a", {"R_s_ohm": R, "psi_f_wb": PSI})
    second = run_of(tmp_path, "b", {"R_s_ohm": R})
    for path, gain in ((first, 10.0), (second, 10.3)):
        values = {"current.K_p_d_v_per_a": gain, "current.K_p_q_v_per_a": 20.0}
        (path / "params.toml").write_text(ParameterSet(values).to_toml())
    RunDirectory(second).add(Stage("identify", "fail", 1.0, note="too noisy"))
    outcome = CliRunner().invoke(cli, ["diff", str(first), str(second), "--check"])
    assert "1 of 1 quantities agree (one drive: without its sensors' part); 1 in one run alone" in outcome.stdout
    assert " -> FAIL\nparameters: 1 differ; `pmsmtool param diff" in outcome.stdout
    assert "psi_f_wb, verdict: not the same" in str(outcome.exception)
    assert [row["name"] for row in told("diff", first, second)["parameters"]] == ["current.K_p_d_v_per_a"]  # type: ignore[attr-defined]
    assert told("diff", first, second, "--tol", "5%")["parameters"] == []


def test_a_folder_of_runs_names_the_one_that_stands_out(tmp_path: Path) -> None:
    for k, share in enumerate((0.0, 0.001, -0.001, 0.002, -0.002, 0.08)):
        path = run_of(tmp_path / "made", str(k), {"R_s_ohm": moved(R, share)}, serial=k)
        path.rename(tmp_path / f"run-{k}")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "run.json").write_text("{")
    found = told("fleet", tmp_path)
    (motor,) = found["motors"]  # type: ignore[misc]
    (row,) = motor["quantities"]
    assert (motor["runs"], motor["drives"]) == (6, 6) and motor["name"].endswith(", 3 pole pairs")
    assert row["odd"] == ["run-5"] and row["runs"] == 6 == found["runs"]
    assert row["median"] == pytest.approx(0.5 * 1.0005, rel=1e-4)
    assert len(found["left_out"]) == 1  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="no run"):
        CliRunner().invoke(cli, ["fleet", str(tmp_path / "made")], catch_exceptions=False, standalone_mode=False)


def test_two_motors_are_two_tables_and_what_was_stated_is_none_of_them(tmp_path: Path) -> None:
    stated = replace(PSI, source="datasheet", method="conversion")
    for k in range(4):
        path = run_of(tmp_path / "made", f"a{k}", {"R_s_ohm": R, "psi_f_wb": stated})
        path.rename(tmp_path / f"a-{k}")
        path = run_of(tmp_path / "made", f"b{k}", {"R_s_ohm": moved(R, 3.0)}, name="other <motor>")
        path.rename(tmp_path / f"b-{k}")
    found = told("fleet", tmp_path, "-o", tmp_path / "fleet.html")
    assert [len(motor["quantities"]) for motor in found["motors"]] == [1, 1]  # type: ignore[attr-defined]
    page = (tmp_path / "fleet.html").read_text()
    assert "8 runs, nothing stands out" in page and "other &lt;motor&gt;, 3 pole pairs: 4 runs, 1 drive" in page
    assert page.count("<figure>") == 2 and "psi_f_wb" not in page
    told("fleet", tmp_path, "-o", tmp_path / "fleet.csv")
    rows = (tmp_path / "fleet.csv").read_text().splitlines()
    assert len(rows) == 1 + 8 and rows[0].startswith("motor,run,started_utc,serial,quantity,value")
    assert rows[1] == '"interior-2k2, 3 pole pairs",a-0,2026-01-01T00:00:00Z,5,R_s_ohm,0.5,0.00537,ohm,no'


def test_a_drift_is_seen_and_scatter_is_none() -> None:
    scatter = [0.3, -0.2, 0.1, -0.4, 0.2, 0.4, -0.1, -0.3]
    assert math.isnan(drift(scatter)) and math.isnan(drift([1.0])) and math.isnan(drift([1.0, 2.0, 3.0]))
    assert drift([0.1 * k + 0.02 * s for k, s in enumerate(scatter)]) == pytest.approx(0.7, abs=0.03)
    assert drift([-2.0 * k for k in range(8)]) == pytest.approx(-14.0)


def test_few_runs_have_no_spread() -> None:
    (row,) = series((str(k), {"R_s_ohm": R}) for k in range(LEAST_SERIES - 1))
    assert math.isnan(row.spread) and row.odd == () and row.runs == LEAST_SERIES - 1


@pytest.mark.chain
def test_figures_of_design_margins_and_two_runs(tmp_path: Path) -> None:
    first, second = run_of(tmp_path, "a", {"R_s_ohm": R}), run_of(tmp_path, "b", {"R_s_ohm": moved(R, 0.01)})
    told("diff", first, second, "--plot", tmp_path / "diff.svg")
    told("tune", "interior-2k2", "-o", tmp_path / "d.toml", "--plot", tmp_path / "tune.png")
    told("margins", tmp_path / "d.toml", "--plot", tmp_path / "margins.pdf")
    heads = {name: (tmp_path / name).read_bytes()[:5] for name in ("diff.svg", "tune.png", "margins.pdf")}
    assert heads == {"diff.svg": b"<?xml", "tune.png": b"\x89PNG\r", "margins.pdf": b"%PDF-"}
    outcome = CliRunner().invoke(cli, ["diff", str(first), str(second), "--plot", "x.gif"])
    assert isinstance(outcome.exception, ConfigError) and "use .svg, .png or .pdf" in str(outcome.exception)
