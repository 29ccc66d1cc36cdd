# SPDX-License-Identifier: MIT
"""The figures show the data and the model that was fitted to it, not something else."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from pmsmtool.design.loops.current_loop import AxisPlant, axis_loop, imc
from pmsmtool.design.loops.sampled_loop import margins
from pmsmtool.estimators.flux.linkage import estimate_flux_linkage
from pmsmtool.estimators.injection.axis_fit import AxisFit
from pmsmtool.estimators.injection.axis_layout import Timing
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.report import figures
from pmsmtool.trace import Trace

CURVE = InverterCurve(np.array([0.5, 1.0, 2.0, 4.0]), np.array([0.3, 0.5, 0.8, 0.9]), 0.0)


@pytest.fixture
def canvases(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every figure that is turned into SVG, as matplotlib knows it."""
    found: list[Any] = []
    draw = figures.svg

    def keep(canvas: Any) -> str:
        found.append(canvas)
        return draw(canvas)

    monkeypatch.setattr(figures, "svg", keep)
    return found


def trace(columns: dict[str, np.ndarray], **meta: object) -> Trace:
    n = len(next(iter(columns.values())))
    return Trace(1e-4 * np.arange(n), columns, dict.fromkeys(columns, "1"), meta)


def lines(canvas: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {
        line.get_label(): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
        for axes in canvas.axes
        for line in axes.lines
    }


@pytest.mark.chain
def test_resistance_shows_the_levels_on_their_model(canvases: list[Any]) -> None:
    i = np.array([-4.0, -2.0, 2.0, 4.0])
    factor = math.sqrt(3.0) / 2.0
    u = 1.5 * i + CURVE.error_v(factor * i) / factor
    figure = figures.resistance_figure(trace({"i_d_a": i, "u_d_v": u}), 1.5, CURVE)
    drawn = lines(canvases[0])
    assert np.array_equal(drawn["levels"][1], u)
    x, y = drawn["R i + inverter error"]
    assert np.interp(i, x, y) == pytest.approx(u, abs=1e-9)
    assert "R = 1.5 ohm" in figure.caption
    assert figures.resistance_figure(trace({"i_d_a": i, "u_d_v": u}), 1.5, CURVE).svg == figure.svg


@pytest.mark.chain
def test_the_fitted_response_is_measured_plus_residual(canvases: list[Any]) -> None:
    n, sigma = 200, 0.02
    current = np.sin(np.arange(n))
    residual = np.random.default_rng(1).standard_normal(n - SKIP_SAMPLES)
    timing = Timing(1.0, 1e-3, -3.0, 1.0, 1.0, 1e-3, 0.0, 0.0)
    fit = AxisFit(1e-3, 1e-6, 1e-6, (1e-3,), 0.1, 1.0, 0.0, 0.0, 1.0, n, (residual,), (), 1.0, timing)
    shots = {axis: trace({f"i_{axis}_a": current}, half_period=6) for axis in "dq"}
    figures.inductance_figure(shots, {"d": fit, "q": fit}, sigma)
    drawn = lines(canvases[0])
    measured, predicted = drawn["measured"][1], drawn["fitted response"][1]
    assert len(measured) == 2 * 6 * figures.PERIODS_SHOWN
    assert np.array_equal(measured, current[SKIP_SAMPLES : SKIP_SAMPLES + len(measured)])
    assert predicted - measured == pytest.approx(sigma * residual[: len(measured)])


@pytest.mark.chain
def test_flux_shows_what_each_pair_is_off(canvases: list[Any]) -> None:
    w = np.repeat([-400.0, -300.0, -200.0, -150.0, 150.0, 200.0, 300.0, 400.0], 2)
    T, R, psi, L_d = 1e-4, 0.5, 0.2, 2e-3
    i_d = np.tile([1.0, -1.0], 8)
    x = 0.5 * w * T
    off = np.where(w == 300.0, 0.01, 0.0)
    u_q = w * (psi * (1.0 + off) + L_d * i_d) * np.sin(x) / x
    rows = {"omega_e_rad_s": w, "i_d_a": i_d, "i_q_a": 1e-3 * np.tile([1.0, 1.0, -1.0, -1.0], 4), "u_q_v": u_q,
            "u_d_v": R * i_d, "half_s": 0.0 * w + 0.1}  # fmt: skip
    halves = {f"{n}_{k}_{u}": rows[f"{n}_{m}{u}"] for n, m, u in (("i_d", "", "a"), ("i_q", "", "a"),
              ("omega", "e_", "rad_s")) for k in ("first", "second")}  # fmt: skip
    speeds = trace({**rows, **halves, "T_magnet_c": np.full_like(w, math.nan)})
    result = estimate_flux_linkage(speeds, R, period_s=T)
    figures.flux_figure(result)
    _, deviation = canvases[0].axes[1].lines[1].get_data()
    assert int(np.argmax(np.abs(deviation))) == 6
    assert deviation[6] - deviation[0] == pytest.approx(1.0, rel=0.01)


@pytest.mark.chain
def test_the_crossings_lie_on_the_curves(canvases: list[Any]) -> None:
    plant = AxisPlant(0.137, 2.3e-3, 1.0 / 12e3, 1.5)
    loop = axis_loop(imc(plant.R, plant.L, 4000.0), plant)
    found = margins(loop)
    figure = figures.bode_figure({"current_d": loop}, {"current_d": found})
    upper, lower = canvases[0].axes
    hz = found.crossover_rad_s / (2.0 * math.pi)
    curve = lower.lines[0]
    assert np.interp(hz, curve.get_xdata(), curve.get_ydata()) == pytest.approx(lower.lines[1].get_ydata()[0], abs=0.1)
    assert upper.lines[1].get_xdata()[0] == pytest.approx(hz)
    assert f"{found.phase_margin_deg:.1f} deg" in figure.caption


def test_rows_are_drawn_from_quantile_to_quantile_against_their_limit(canvases: list[Any]) -> None:
    rows = {"phase margin": (41.0, 60.0, 62.0, 45.0), "headroom": (3.0, 4.0, 5.0, math.nan)}
    figures.band_figure(rows, "deg", "spread")
    x = [tuple(line.get_xdata()) for line in canvases[0].axes[0].lines]
    assert x == [(41.0, 62.0), (60.0,), (45.0, 45.0), (3.0, 5.0), (4.0,)]


def test_a_difference_beyond_its_interval_lies_outside_the_band(canvases: list[Any]) -> None:
    figures.difference_figure({"R_s_ohm": (0.1, 0.2), "L_d_h": (-0.5, 0.1)}, "")
    axes = canvases[0].axes[0]
    assert [float(line.get_xdata()[0]) for line in axes.lines] == [0.5, -5.0]
    assert len({line.get_color() for line in axes.lines}) == 2 and axes.get_xlim() == pytest.approx((-5.5, 5.5))


def test_one_difference_far_out_leaves_the_others_apart(canvases: list[Any]) -> None:
    figures.difference_figure({"offset_rad": (5.0, 0.005), "L_d_h": (-0.5, 0.1)}, "")
    (axes,) = canvases[0].axes
    inside, out = (axes.transData.transform((x, 0.0))[0] for x in (0.0, -5.0))
    assert inside - out > 0.1 * axes.bbox.width


def test_text_stays_text_and_no_date_is_written(canvases: list[Any]) -> None:
    inside, beyond = (np.array([-0.5, 0.0]), np.array([0.5, 0.0])), (np.array([-9.0, -8.0]), np.array([5.0, 4.0]))
    figure = figures.envelope_figure(
        np.linspace(0.0, 10.0, 5), np.ones(5), {"mtpa": inside, "mtpv": beyond}, 1.0, ["current"]
    )
    assert {"mtpa", "I_max"} <= set(lines(canvases[0])) and "mtpv" not in lines(canvases[0])
    assert "largest torque / N m" in figure.svg
    assert "dc:date" not in figure.svg and "matplotlib.org" not in figure.svg
    assert figure.caption.endswith("bind in the table: current.")
