# SPDX-License-Identifier: MIT
"""``pmsmtool simulate`` as a program, and the figures it draws."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from pmsmtool.cli.main import run
from pmsmtool.files import data_folder
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.report.plots import POINTS_MAX, Panel, thinned, trace_figure
from pmsmtool.trace import Trace, read_trace

pytestmark = pytest.mark.chain


Program = Callable[..., SimpleNamespace]


@pytest.fixture
def pmsmtool(capsys: pytest.CaptureFixture[str]) -> Program:
    """The program in this process; a start of its own is below."""

    def call(*arguments: str) -> SimpleNamespace:
        capsys.readouterr()
        code = run(list(arguments))
        said = capsys.readouterr()
        return SimpleNamespace(returncode=int(code), stdout=said.out, stderr=said.err)

    return call


def test_writes_trace_and_figure_the_same_bytes_twice(pmsmtool, tmp_path):
    for name in ("first", "second"):
        done = pmsmtool(
            "simulate", "interior-2k2", "--scenario", "q-step", "-o", str(tmp_path / f"{name}.npz"),
            "--plot", str(tmp_path / f"{name}.svg"), "--seed", "5",
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "i_q_a" in done.stdout
        assert "wrote" in done.stderr
    for suffix in ("npz", "svg"):
        assert (tmp_path / f"first.{suffix}").read_bytes() == (tmp_path / f"second.{suffix}").read_bytes()
    assert (tmp_path / "first.svg").read_text(encoding="utf-8").startswith("<?xml")
    assert len(read_trace(tmp_path / "first.npz")) == 600


def test_csv_holds_the_same_numbers(pmsmtool, tmp_path):
    for name in ("t.npz", "t.csv"):
        assert pmsmtool("simulate", "interior-2k2", "--scenario", "q-step", "-o", str(tmp_path / name)).returncode == 0
    npz, csv = read_trace(tmp_path / "t.npz"), read_trace(tmp_path / "t.csv")
    assert all(np.array_equal(npz[name], csv[name]) for name in npz.signals)
    assert npz.units == csv.units
    assert npz.meta == csv.meta


def test_json_is_one_object_and_needs_no_file(pmsmtool, tmp_path):
    done = pmsmtool("simulate", "interior-2k2", "--scenario", "q-step", "--json", "--set", "sensor_noise_apk=0")
    data = json.loads(done.stdout)
    assert data["schema"] == "pmsmtool.simulate/1"
    assert data["machine"] == "interior-2k2"
    assert data["signals"]["i_q_a"]["unit"] == "A"
    assert data["trace"] is None
    assert data["meta"]["event_overruns"] == 0


def test_duration_and_scenario_file(pmsmtool, tmp_path):
    scenario = tmp_path / "still.toml"
    scenario.write_text(
        'schema = "pmsmtool.scenario/1"\nduration_s = 1.0\nmode = "current"\nrotor = "locked"\n', encoding="utf-8"
    )
    done = pmsmtool("simulate", "interior-2k2", "--scenario", str(scenario), "--duration", "20ms", "--json")
    assert json.loads(done.stdout)["rows"] == 240
    freed = pmsmtool("simulate", "interior-2k2", "--scenario", str(scenario), "--set", "rotor=free", "--json")
    assert freed.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--scenario", "q-step"), "nothing to write"),
        (("-o", "t.npz"), "which --scenario"),
        (("--scenario", "q-step", "-o", "t.xlsx"), "no trace format"),
        (("--scenario", "q-step", "-o", "t.npz", "--plot", "t.gif"), "figure format"),
        (("--scenario", "no-step"), "did you mean"),
        (("--scenario", "q-step", "--json", "--set", "seed"), "not KEY=VALUE"),
        (("--scenario", "q-step", "--json", "--set", "adc_bits=many"), "adc_bits"),
        (("--scenario", "q-step", "--json", "--duration", "20"), "has no unit"),
        (("--scenario", "q-step", "-o", "/nonexistent/t.npz"), "cannot be written"),
    ],
)
def test_bad_use_is_exit_2_with_one_clear_message(pmsmtool, arguments, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = pmsmtool("simulate", "interior-2k2", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


def test_what_the_design_has_to_say_is_said(pmsmtool, tmp_path):
    machine = (data_folder("profiles") / "interior-2k2.toml").read_text(encoding="utf-8")
    kept = [line for line in machine.splitlines() if not line.startswith("J_kgm2")]
    (tmp_path / "machine.toml").write_text("\n".join(kept), encoding="utf-8")
    done = pmsmtool(
        "simulate", str(tmp_path / "machine.toml"), "--scenario", "q-step", "--json", "--set", "J_kgm2=0.01"
    )
    assert done.returncode == 0, done.stderr
    assert "speed control is off" in done.stderr


def test_design_is_needed(pmsmtool):
    done = pmsmtool("simulate", "--scenario", "q-step", "--json")
    assert done.returncode == 2
    assert "missing argument DESIGN" in done.stderr


def test_unknown_design_is_exit_2(pmsmtool):
    done = pmsmtool("simulate", "nothing-here", "--scenario", "q-step", "--json")
    assert done.returncode == 2
    assert "nothing-here" in done.stderr


def test_trip_is_a_warning_with_its_time(pmsmtool, tmp_path):
    params = ParameterSet({"protection.i_trip_apk": 4.0, "field_weakening.mode": 0})
    (tmp_path / "params.toml").write_text(params.to_toml(), encoding="utf-8")
    done = pmsmtool(
        "simulate", "jercic-2017", "--scenario", "field-weakening-sweep", "--json",
        "--params", str(tmp_path / "params.toml"),
    )  # fmt: skip
    assert done.returncode == 0
    assert "tripped (error code 0x2310) at 0.0" in done.stderr
    assert "field weakening is off" in done.stderr


def test_list_names_the_scenarios(pmsmtool):
    done = pmsmtool("simulate", "--list")
    assert done.returncode == 0
    assert "load-step" in done.stdout


NOT_FOR_A_SIMULATION = (
    *("scipy", "matplotlib", "can", "canopen", "rich", "jinja2"),
    *("pmsmtool.design.polar", "pmsmtool.design.lookup.design", "pmsmtool.machine.flux_map_check"),
)


def test_a_simulation_imports_what_it_needs_and_is_not_searched_for_garbage():
    code = (
        "import contextlib, gc, io, sys; from pmsmtool.cli.main import main\n"
        "def collections(): return sum(generation['collections'] for generation in gc.get_stats())\n"
        "before = collections()\n"
        "sys.argv[1:] = ['simulate', 'interior-2k2', '--scenario', 'q-step', '--json']\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):\n"
        "    main()\n"
        f"print(sorted(set({NOT_FOR_A_SIMULATION!r}) & set(sys.modules)), collections() - before)\n"
        "assert 'pmsmtool.sim.closed_loop' in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[] 0"


def test_help_has_examples(pmsmtool):
    assert "Examples" in pmsmtool("simulate", "--help").stdout


# ---- figures ---------------------------------------------------------------------------------------------------------


def trace(n: int) -> Trace:
    t = np.arange(n) * 1e-4
    return Trace(t, {"i_d_a": np.sin(50.0 * t), "i_q_a": np.cos(50.0 * t)}, {"i_d_a": "A", "i_q_a": "A"})


def test_figure_has_a_panel_per_present_quantity():
    figure = trace_figure(trace(100), title="test")
    assert [axes.get_ylabel() for axes in figure.axes] == ["i_d / A", "i_q / A"]
    assert figure.axes[-1].get_xlabel() == "time / s"
    with pytest.raises(ValueError, match="none of the signals"):
        trace_figure(trace(100), [Panel("x", (("nothing", "n", "-"),))])


def test_rounding_is_not_drawn_as_a_signal():
    t = np.arange(100) * 1e-4
    rounding = {"i_d_a": 1e-13 * np.sin(50.0 * t), "i_q_a": 6.0 * np.cos(50.0 * t)}
    upper, lower = trace_figure(Trace(t, rounding, {"i_d_a": "A", "i_q_a": "A"})).axes
    assert upper.get_ylim() == pytest.approx((-3e-4, 3e-4), rel=1e-6)
    assert lower.get_ylim()[1] > 6.0


def test_thinning_keeps_every_extreme_value():
    t = np.arange(100_003) * 1e-5
    value = np.random.default_rng(0).normal(size=len(t))
    value[77_777] = 40.0
    kept_t, kept = thinned(t, value)
    assert len(kept) <= POINTS_MAX + 4
    assert kept.max() == 40.0
    assert kept_t[kept.argmax()] == t[77_777]
    assert kept.min() == value.min()
    assert (kept_t[0], kept_t[-1]) == (t[0], t[-1])
    assert np.all(np.diff(kept_t) > 0.0)
    short = thinned(t[:100], value[:100])
    assert np.array_equal(short[1], value[:100])
