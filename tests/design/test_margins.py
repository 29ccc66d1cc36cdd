# SPDX-License-Identifier: MIT
"""Margins over the tolerance box: arrays against single loops, executors against each other, headroom by physics."""

from __future__ import annotations

import concurrent.futures
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from pmsmtool.cli.main import cli
from pmsmtool.design.design_file import Design, design_text
from pmsmtool.design.loops.current_loop import AxisPlant, axis_loop, imc, second_order
from pmsmtool.design.loops.margins import (
    BLOCK,
    BLOCKS_PER_TASK,
    JUDGED_PERCENTILE,
    Blocks,
    BlockTask,
    MarginReport,
    MarginRequest,
    Spread,
    _risks,
    _with_headroom,
    evaluate,
    margin_problem,
    margin_report,
)
from pmsmtool.design.loops.sampled_loop import margins
from pmsmtool.design.loops.speed_loop import SpeedGains, SpeedMethod, SpeedPath, speed_loop
from pmsmtool.design.loops.vector_margins import current_response, vector_margins
from pmsmtool.design.operating_machine import at_temperature
from pmsmtool.design.tolerance import NORMAL_95, Headroom, OperatingCells, Samples, _fluxes, tolerance_box
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import load_machine_file
from pmsmtool.machine.parameters import Estimate

PROFILES = Path(__file__).resolve().parents[2] / "profiles"

CURRENT_TOLERANCE = 1e-9
"""Array margins of the current loops against polynomial roots, relative (measured 3e-12)."""

SPEED_TOLERANCE_DEG, SPEED_TOLERANCE_DB = 0.1, 0.1
"""Array margins of the speed loop against the exact lifted loop (measured 0.02 degree, 0.03 dB)."""


def design_of(profile: str = "jercic-2017", request: TuneRequest | None = None) -> Design:
    return tune(load_machine_file(PROFILES / f"{profile}.toml"), request)


@pytest.mark.chain
@pytest.mark.parametrize(("delay", "predictor"), [(0.5, False), (1.5, False), (1.8, False), (1.5, True)])
def test_array_margins_are_those_of_each_loop(delay: float, predictor: bool) -> None:
    T_s, rng = 1.0 / 12e3, np.random.default_rng(3)
    R, L = rng.uniform(0.05, 1.0, (40, 1)), rng.uniform(1e-3, 4e-3, (40, 1))
    for gains in (imc(0.137, 2.3e-3, 3000.0), second_order(0.137, 2.3e-3, 1500.0, 0.8)):
        model = (0.137, 2.3e-3) if predictor else None
        found = vector_margins(current_response(gains, R, L, T_s, delay, model), T_s, gains.K_p / 2.3e-3)
        for k in range(40):
            plant = AxisPlant(float(R[k, 0]), float(L[k, 0]), T_s, delay)
            believed = AxisPlant(0.137, 2.3e-3, T_s, delay) if predictor else None
            one = margins(axis_loop(gains, plant, believed))
            assert found.phase_deg[k] == pytest.approx(one.phase_margin_deg, rel=CURRENT_TOLERANCE)
            assert found.gain_db[k] == pytest.approx(one.gain_margin_db, rel=1e-7)
            assert found.delay_s[k] == pytest.approx(one.delay_margin_s, rel=CURRENT_TOLERANCE)


def test_an_unstable_loop_has_no_positive_margin() -> None:
    T_s = 1.0 / 12e3
    loop = current_response(imc(0.137, 2.3e-3, 15000.0), np.array([[0.137]]), np.array([[2.3e-3]]), T_s, 1.5)
    found = vector_margins(loop, T_s, 15000.0)
    assert found.phase_deg[0] < 0.0
    assert found.gain_db[0] < 0.0
    assert found.delay_s[0] == 0.0


@pytest.mark.parametrize(("sign", "least"), [(1.0, 60.0), (-1.0, -math.inf)])
def test_a_resonance_far_from_minus_one_takes_no_margin(sign: float, least: float) -> None:
    """|L| passes 1 again around the positive real axis, or around -1. A healthy elastic shaft had -174, not 43 deg."""
    place = 400.0

    def loop(omega: np.ndarray) -> np.ndarray:
        s = 1j * np.atleast_2d(omega)
        return 100.0 / s + sign * 0.8 * place * s / (s**2 + 0.2 * place * s + place**2)

    found = vector_margins(loop, 1e-4, 100.0)
    assert least < found.phase_deg[0] and (found.phase_deg[0] > 0.0) == (sign > 0.0)


def test_speed_margins_of_other_machines_are_those_of_their_own_loop() -> None:
    design = design_of()
    source = design.machine
    problem, box = margin_problem(design), tolerance_box(source)
    samples = box.draw(12, seed=5, block=0)
    found = evaluate(problem, samples).values
    machine = source.machine
    assert machine.J_kgm2 is not None
    for k in range(len(samples)):
        s = samples.describe(k)
        warm = 1.0 + machine.alpha_psi_per_k * (s["T_magnet_c"] - machine.T_ref_c)
        R = s["R_s_ohm"] * machine.R_s_ohm * (1.0 + machine.alpha_R_per_k * (s["T_winding_c"] - machine.T_ref_c))
        plant = AxisPlant(R, s["L_q_h"] * machine.L_q_h, source.inverter.T_s, source.inverter.delay_periods)
        current = axis_loop(problem.gains["q"], plant)
        # torque per demanded torque acts like an inertia smaller by that factor
        torque = s["psi_f_wb"] * warm
        path = SpeedPath(
            s["J_kgm2"] * machine.J_kgm2 / torque, (machine.B_nms or 0.0) / torque, current,
            int(design["speed.decimation"]), design["encoder.pll_bandwidth_rad_s"], design["speed.filter_hz"],
        )  # fmt: skip
        gains = SpeedGains(
            design["speed.K_p_nms_per_rad"], design["speed.K_i_nm_per_rad"], 0.0, SpeedMethod.SYMMETRIC_OPTIMUM
        )
        one = margins(speed_loop(gains, path))
        assert found["speed_phase"][k] == pytest.approx(one.phase_margin_deg, abs=SPEED_TOLERANCE_DEG)
        assert found["speed_gain"][k] == pytest.approx(one.gain_margin_db, abs=SPEED_TOLERANCE_DB)


@pytest.mark.chain
def test_the_nominal_row_is_the_design_itself() -> None:
    for profile in ("jercic-2017", "saturated-pmsyrm"):
        design = design_of(profile)
        nominal = evaluate(margin_problem(design), tolerance_box(design.machine).nominal(design.machine)).values
        for loop in ("current_d", "current_q", "speed"):
            assert nominal[f"{loop}_phase"][0] == pytest.approx(design.loops[loop].phase_margin_deg, abs=1e-6)
            assert nominal[f"{loop}_gain"][0] == pytest.approx(design.loops[loop].gain_margin_db, abs=1e-6)
            assert nominal[f"{loop}_delay"][0] == pytest.approx(1e6 * design.loops[loop].delay_margin_s, rel=1e-6)


@pytest.mark.chain
def test_the_least_inductance_of_a_map_is_a_corner() -> None:
    design = design_of("saturated-pmsyrm")
    box = replace(tolerance_box(design.machine), factors={})
    found = evaluate(margin_problem(design), Samples(box.names, np.array([[0.0, 20.0, 20.0, 540.0, 1.0]]))).values
    saturated = design.loops["current_q_saturated"]
    assert found["current_q_phase"][0] == pytest.approx(saturated.phase_margin_deg, abs=1e-6)
    assert found["current_q_gain"][0] == pytest.approx(saturated.gain_margin_db, abs=1e-6)


# -- the box -------------------------------------------------------------------------------------------------


def test_corners_are_the_ends_of_the_intervals() -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    source = replace(source, systematic={"R_s_ohm": 0.00137})
    box = tolerance_box(source, U_dc_v=(190.0, 230.0))
    corners = box.corners()
    assert len(corners) == 2 ** len(box.names)
    assert box.factors["R_s_ohm"].half_width == pytest.approx(NORMAL_95 * 0.03 + 0.01)
    assert set(np.round(corners.column("R_s_ohm").ravel(), 12)) == {
        round(1.0 - box.factors["R_s_ohm"].half_width, 12), round(1.0 + box.factors["R_s_ohm"].half_width, 12),
    }  # fmt: skip
    assert set(corners.column("U_dc_v").ravel()) == {190.0, 230.0}


def test_random_samples_have_the_deviation_they_were_given() -> None:
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    box = tolerance_box(source)
    samples = box.draw(40_000, seed=1, block=0)
    for name, deviation in box.factors.items():
        assert samples.column(name).std() == pytest.approx(deviation.std, rel=0.03)
        assert samples.column(name).mean() == pytest.approx(1.0, abs=4.0 * deviation.std / 200.0)
    assert samples.column("T_winding_c").min() >= box.T_winding_c[0]
    point = samples.column("operating_point")  # between the inductance of the design and the least
    assert 0.0 <= point.min() < 0.02 and 0.98 < point.max() <= 1.0


def test_assumptions_and_bad_ranges_are_told() -> None:
    source = replace(load_machine_file(PROFILES / "jercic-2017.toml"), std={})
    assert sum("assumed" in note for note in tolerance_box(source).notes) == 7
    with pytest.raises(ConfigError, match="box"):
        tolerance_box(source, U_dc_v=(300.0, 200.0))
    assert tolerance_box(source, U_dc_v=(200.0, 200.0)).U_dc_v == (200.0, 200.0)
    own = replace(source, estimates={"J_kgm2": Estimate(0.05, 0.0, 0.0, "kg m^2", source="vendor")})
    notes = tolerance_box(own).notes
    assert "J_kgm2: the drive's own value has no interval, 5 % assumed" in notes
    assert "R_s_ohm: no standard deviation is given, 3 % assumed" in notes


def test_what_a_data_sheet_leaves_open() -> None:
    """Without deviations, limits or a range of the link; a reference temperature below a cold start's."""
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    source = replace(source, std={}, systematic={}, limits=replace(source.limits, T_winding_max_c=None))
    box, U_dc = tolerance_box(source), source.inverter.U_dc_v
    assert {name: box.factors[name].std for name in box.factors} == pytest.approx(
        {"R_s_ohm": 0.03, "L_d_h": 0.05, "L_q_h": 0.05, "psi_f_wb": 0.02, "J_kgm2": 0.05}
    )
    assert box.encoder_rad.half_width == pytest.approx(1.959964 * math.radians(1.0))
    assert box.U_dc_v == pytest.approx((0.95 * U_dc, 1.05 * U_dc))
    assert box.T_winding_c == (-20.0, 155.0)
    cold = replace(source, machine=replace(source.machine, T_ref_c=-40.0))
    assert tolerance_box(cold).T_winding_c[0] == tolerance_box(cold).T_magnet_c[0] == -40.0


def test_a_factor_that_nobody_measured_stays_between_a_fifth_and_five() -> None:
    box = tolerance_box(load_machine_file(PROFILES / "jercic-2017.toml"))
    wild = replace(box, factors={"R_s_ohm": replace(box.factors["R_s_ohm"], std=50.0)})
    column = wild.draw(100, seed=1, block=0).column("R_s_ohm")
    assert column.min() == 0.2 and column.max() == 5.0


# -- headroom ------------------------------------------------------------------------------------------------


def test_headroom_is_the_physics_of_the_other_machine() -> None:
    design = design_of("mtpv-test")
    source = design.machine
    problem, box = margin_problem(design), tolerance_box(source)
    row = {"R_s_ohm": 1.1, "L_d_h": 0.9, "L_q_h": 1.2, "psi_f_wb": 0.95, "J_kgm2": 1.0, "encoder_rad": 0.03,
           "T_winding_c": 120.0, "T_magnet_c": 90.0, "U_dc_v": 160.0, "operating_point": 0.0}  # fmt: skip
    samples = Samples(box.names, np.array([[row[name] for name in box.names]]))
    found = evaluate(problem, samples)
    m = source.machine
    other = replace(m, R_s_ohm=1.1 * m.R_s_ohm, L_d_h=0.9 * m.L_d_h, L_q_h=1.2 * m.L_q_h, psi_f_wb=0.95 * m.psi_f_wb)
    hot = at_temperature(other, T_winding_c=120.0, T_magnet_c=90.0)
    cells = problem.cells
    turned = (cells.i_d_a + 1j * cells.i_q_a) * np.exp(0.03j)
    voltage = hot.voltage_v(turned.real, turned.imag, cells.omega_e)
    room = 1.0 - voltage / (source.inverter.voltage_utilisation * 160.0)
    assert found.values["headroom_voltage"][0] == pytest.approx(room.min(), rel=1e-9)
    assert found.cells["headroom_voltage"][0] == int(np.argmin(room))
    torque = hot.torque_nm(turned.real, turned.imag)
    driving = np.abs(cells.torque_nm) > 0.0
    need = np.abs(turned[driving]) * np.abs(cells.torque_nm[driving] / torque[driving])
    assert found.values["headroom_current"][0] == pytest.approx(1.0 - need.max() / 150.0, rel=1e-9)


def test_fluxes_of_a_turned_frame_follow_all_inductances() -> None:
    """Of constant inductances, those across the axes among them, the first order is all there is."""
    source = load_machine_file(PROFILES / "jercic-2017.toml")
    box, i, M = tolerance_box(source), np.array([-10.0, 20.0]), np.array([[3e-3, -4e-4], [-4e-4, 5e-3]])
    psi_f = source.machine.psi_f_wb
    psi = M @ i + [psi_f, 0.0]
    one = np.ones(1)
    cells = OperatingCells(one, one, one, *(i[:, None]), *(psi[:, None]), M.reshape(4, 1))
    row = {name: 0.3 if name == "encoder_rad" else 1.0 for name in box.names}
    samples = Samples(box.names, np.array([list(row.values())]))
    i_d, i_q, psi_d, psi_q = _fluxes(source.machine, cells, psi_f * np.ones((1, 1)), samples)
    turned = np.array([[math.cos(0.3), -math.sin(0.3)], [math.sin(0.3), math.cos(0.3)]]) @ i
    assert [float(x[0, 0]) for x in (i_d, i_q)] == pytest.approx(turned)
    assert [float(x[0, 0]) for x in (psi_d, psi_q)] == pytest.approx(M @ turned + [psi_f, 0.0])


def test_what_just_holds_is_within_its_limit() -> None:
    spread = Spread("x", "1", 0.5, 0.2, {}, "", {JUDGED_PERCENTILE: 0.2}, 0.2)
    assert spread.ok
    assert not replace(spread, worst=0.1).ok and not replace(spread, percentiles={JUDGED_PERCENTILE: 0.1}).ok
    headroom = Headroom(np.array([[0.0, -0.1]]), np.array([[0.1, 0.0]]), np.zeros(1))
    block = _with_headroom({}, headroom)
    assert {name: beyond.tolist() for name, beyond in block.beyond.items()} == {
        "headroom_voltage": [0.0, 1.0], "headroom_current": [0.0, 0.0],
    }  # fmt: skip
    problem = margin_problem(design_of())
    assert [risk.cell for risk in _risks(problem, [block])] == [problem.cells.name(1)]


def test_nominal_voltage_headroom_is_the_reserve_that_was_kept() -> None:
    report = margin_report(design_of(), tolerance_box(design_of().machine))
    voltage = next(s for s in report.headroom if s.name == "headroom_voltage")
    assert voltage.nominal == pytest.approx(0.08, abs=1e-9)
    assert voltage.worst < 0.0
    assert voltage.worst_cell
    told = [note for note in report.notes if "not judged" in note]
    assert [note.split()[0] for note in told] == [s.name for s in report.headroom if s.worst < 0.0]
    asked = margin_report(design_of(), tolerance_box(design_of().machine), MarginRequest(voltage_headroom=-1.0))
    assert not [note for note in asked.notes if note.startswith("headroom_voltage")]
    assert report.unreachable and "rpm" in report.unreachable[0]
    worst = voltage.worst_sample
    assert worst["U_dc_v"] == pytest.approx(0.95 * 210.0)
    assert worst["psi_f_wb"] > 1.0


# -- random samples and executors ----------------------------------------------------------------------------


class Shuffled:
    """An executor that works from the last task to the first."""

    def map(self, function: Callable[[BlockTask], Blocks], tasks: Iterable[BlockTask], /) -> Iterator[Blocks]:
        waiting = list(tasks)
        done = [function(task) for task in reversed(waiting)]
        return iter(reversed(done))


class Dying:
    """An executor that loses its workers after one task."""

    def map(self, function: Callable[[BlockTask], Blocks], tasks: Iterable[BlockTask], /) -> Iterator[Blocks]:
        for count, task in enumerate(tasks):
            if count == 1:
                raise concurrent.futures.BrokenExecutor("a worker died")
            yield function(task)


@pytest.mark.chain
def test_the_result_is_the_same_whoever_works() -> None:
    design = design_of()
    box = tolerance_box(design.machine)
    count = BLOCKS_PER_TASK * BLOCK + 17

    def report(executor: object = None) -> MarginReport:
        return margin_report(design, box, samples=count, seed=7, executor=executor)  # type: ignore[arg-type]

    alone = report()
    assert report(Shuffled()) == alone
    assert report(Dying()) == alone
    for workers in (1, 3):
        with concurrent.futures.ProcessPoolExecutor(workers) as pool:
            assert report(pool) == alone
    assert margin_report(design, box, samples=count, seed=8) != alone


def test_percentiles_and_progress() -> None:
    design = design_of()
    box = tolerance_box(design.machine)
    told: list[tuple[int, int]] = []
    report = margin_report(design, box, samples=5000, progress=lambda done, wanted: told.append((done, wanted)))
    assert told[-1] == (5000, 5000)
    phase = next(s for s in report.loops if s.name == "current_d_phase")
    assert phase.percentiles[1.0] < phase.percentiles[5.0] < phase.percentiles[50.0] < phase.percentiles[95.0]
    # the 95 % box lies inside the random range, so its worst corner is rarer than one in twenty
    assert phase.worst < phase.percentiles[5.0] < phase.nominal


def test_what_was_asked_must_hold_at_the_corner_and_at_the_percentile() -> None:
    design = design_of()
    box = tolerance_box(design.machine)
    assert margin_report(design, box, MarginRequest(phase_margin_deg=58.0)).ok
    assert not margin_report(design, box, MarginRequest(phase_margin_deg=58.1)).ok
    assert not margin_report(design, box, MarginRequest(voltage_headroom=0.0)).ok
    assert margin_report(design, box, MarginRequest(speed_phase_margin_deg=None)).ok


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(cli, ["margins", *arguments])
    return int(getattr(result.exception, "exit_code", result.exit_code)), result.stdout


@pytest.mark.chain
def test_command(tmp_path: Path) -> None:
    path = tmp_path / "design.toml"
    path.write_text(design_text(design_of()))
    code, text = run(str(path), "--monte-carlo", "3000")
    assert code == 0
    assert "PASS" in text and "worst headroom_voltage" in text and "3000 samples" in text
    code, text = run(str(tmp_path), "--phase-margin-deg", "70", "--json")
    assert code == 1
    data = json.loads(text)
    assert data["schema"] == "pmsmtool.margins/1"
    assert data["ok"] is False
    assert run(str(path), "--u-dc", "300V", "200V")[0] == 2


def test_box_names_and_columns_agree() -> None:
    box = tolerance_box(load_machine_file(PROFILES / "interior-2k2.toml"))
    assert box.draw(3, 0, 0).rows.shape == (3, len(box.names))
    assert np.array_equal(box.draw(3, 0, 1).column("absent"), np.ones((3, 1)))
