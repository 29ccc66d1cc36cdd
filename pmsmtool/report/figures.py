# SPDX-License-Identifier: MIT
"""Figures of a commissioning report: what was measured, with the model that was fitted to it, as inline SVG.

Same data, same bytes: no date, ids from a fixed salt, text kept as text.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pmsmtool.arrays import Array
from pmsmtool.design.loops.margins import MarginReport
from pmsmtool.design.loops.sampled_loop import LoopMargins, SampledLoop
from pmsmtool.design.prediction import Prediction
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.injection.axis_fit import AxisFit
from pmsmtool.estimators.injection.axis_response import SKIP_SAMPLES
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.report.report import Figure
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


_BAND = "#e5e7eb"
_SALT = "pmsmtool"
_SIZE = (9.0, 3.4)
_MEASURED, _MODEL, _OTHER, _LIMIT = "#1f5fa8", "#c2410c", "#4b5563", "#9ca3af"
PERIODS_SHOWN = 6
"""Periods of an injection that are drawn; the fit uses all."""
BODE_POINTS = 400
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": _SALT,
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.grid": True,
    "grid.color": "#e5e7eb",
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}
_ID = re.compile(r' id="([^"]+)"')
_REFERENCE = re.compile(r'(?:url\(#|xlink:href="#)([^)"]+)')


def resistance_figure(levels: Trace, R_ohm: float, curve: InverterCurve) -> Figure:
    """Draw the DC levels without R i, and the inverter curve they give.

    Parameters
    ----------
    levels : Trace
        ``i_d_a u_d_v`` per level, as ``estimate_resistance`` takes them.
    R_ohm : float
        Loop resistance at the temperature of the measurement (ohm).
    curve : InverterCurve
        Voltage error of one phase.
    """
    i, u = levels["i_d_a"], levels["u_d_v"]
    offset = float(np.mean(u - R_ohm * i))
    canvas, (left, right) = _canvas(1, 2)
    left.plot(i, u, "o", ms=3.5, color=_MEASURED, label="levels")
    fine = np.linspace(float(np.min(i)), float(np.max(i)), 401)
    left.plot(fine, R_ohm * fine + curve.vector_error_v(fine) + offset, color=_MODEL, label="R i + inverter error")
    left.plot(fine, R_ohm * fine, "--", color=_LIMIT, label="R i")
    left.set(xlabel="current along the vector / A", ylabel="commanded voltage / V")
    left.legend()
    right.plot(curve.i_phase_a, curve.u_error_v, "o-", ms=3.5, color=_MEASURED)
    right.set(xlabel="phase current / A", ylabel="voltage error of one phase / V", xlim=(0.0, None))
    right.set_ylim(min(0.0, float(np.min(curve.u_error_v))), None)
    peak = float(np.max(np.abs(i)))
    caption = (
        f"DC levels up to {peak:.4g} A and R = {R_ohm:.5g} ohm at the temperature of the measurement; what is left "
        f"over is the voltage error of one inverter phase, sampled at {len(curve.i_phase_a)} currents."
    )
    return _finished(canvas, caption)


def inductance_figure(shots: Mapping[str, Trace], fits: Mapping[str, AxisFit], sigma_a: float) -> Figure:
    """Draw the first periods of the square-wave injection on each axis, with the current the fit predicts.

    Parameters
    ----------
    shots : mapping of str to Trace
        Per axis (``d``, ``q``) the record with the shortest half period.
    fits : mapping of str to AxisFit
        Their fits.
    sigma_a : float
        Noise of one current sample (A), which whitened the residuals.
    """
    canvas, panels = _canvas(2, 2, height=1.35)
    texts = []
    for axes, below, axis in zip(panels[:2], panels[2:], "dq", strict=True):
        shot, fit = shots[axis], fits[axis]
        half = int(shot.meta["half_period"])
        shown = min(2 * half * PERIODS_SHOWN, len(shot) - SKIP_SAMPLES)
        t_ms = 1e3 * (shot.t_s[SKIP_SAMPLES : SKIP_SAMPLES + shown] - shot.t_s[SKIP_SAMPLES])
        measured = shot[f"i_{axis}_a"][SKIP_SAMPLES : SKIP_SAMPLES + shown]
        predicted = measured + sigma_a * fit.residuals[0][:shown]
        axes.plot(t_ms, predicted, "-", color=_MODEL, label="fitted response")
        axes.plot(t_ms, measured, ".", ms=4.0, color=_MEASURED, label="measured")
        axes.set(ylabel=f"i_{axis} / A")
        axes.set_title(f"{axis}, half period {half}", loc="left", fontsize=9)
        below.plot(t_ms, 1e3 * sigma_a * fit.residuals[0][:shown], ".", ms=3.0, color=_OTHER)
        below.set(xlabel="time / ms", ylabel="residual / mA")
        rms = sigma_a * math.sqrt(float(np.mean(fit.residuals[0] ** 2)))
        texts.append(f"{axis}: rms residual {1e3 * rms:.3g} mA over {len(shot)} samples, chi2 {fit.chi2:.3g}")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
    return _finished(canvas, f"Square-wave injection, first periods; {'; '.join(texts)}.")


def flux_figure(result: FluxResult) -> Figure:
    """Draw the voltage of the magnets over speed, and how far each pair of windows lies off the common flux linkage."""
    w, residual, psi = result.omega_rad_s, result.residual_wb, result.psi_measured.value
    canvas, (left, right) = _canvas(1, 2)
    order = np.argsort(w)
    left.plot(w[order], psi * w[order], color=_MODEL, label="psi_f omega")
    left.plot(w, (psi + residual) * w, "o", ms=3.5, color=_MEASURED, label="measured")
    left.set(xlabel="electrical speed / rad/s", ylabel="voltage of the magnets / V")
    left.legend()
    right.axhline(0.0, color=_MODEL)
    right.plot(w, 1e2 * residual / psi, "o", ms=3.5, color=_MEASURED)
    right.set(xlabel="electrical speed / rad/s", ylabel="deviation from psi_f / %")
    caption = (
        f"Coasting in both directions, {len(w)} pairs of d currents of both signs: psi_f = {psi:.5g} Wb at the "
        f"temperature of the run; the largest d current changes the flux of the magnets by "
        f"{100 * result.curvature:+.2g} %."
    )
    return _finished(canvas, caption)


def bode_figure(loops: Mapping[str, SampledLoop], found: Mapping[str, LoopMargins]) -> Figure:
    """Draw the open loops, gain crossing and phase crossing marked.

    Parameters
    ----------
    loops : mapping of str to SampledLoop
        Open loops, by name.
    found : mapping of str to LoopMargins
        Their margins.
    """
    canvas, (upper, lower) = _canvas(2, 1, height=1.5, sharex=True)
    for k, ((name, loop), colour) in enumerate(zip(loops.items(), _colours(len(loops)), strict=True)):
        nyquist = math.pi / loop.T_s
        omega = np.geomspace(1e-3 * nyquist, 0.999 * nyquist, BODE_POINTS)
        response = loop.at(omega)
        hz = omega / (2.0 * math.pi)
        dashes = "--" if k % 2 else "-"  # those of d and q often lie on each other
        upper.loglog(hz, np.abs(response), dashes, color=colour, label=name)
        lower.semilogx(hz, np.degrees(np.unwrap(np.angle(response))), dashes, color=colour)
        crossing = found[name].crossover_rad_s
        if math.isfinite(crossing):
            angle = -180.0 + found[name].phase_margin_deg
            upper.plot(crossing / (2.0 * math.pi), 1.0, "o", ms=5, color=colour)
            lower.plot(crossing / (2.0 * math.pi), angle, "o", ms=5, color=colour)
    upper.axhline(1.0, color=_LIMIT, lw=0.8)
    lower.axhline(-180.0, color=_LIMIT, lw=0.8)
    upper.set(ylabel="|L|")
    upper.legend()
    lower.set(xlabel="frequency / Hz", ylabel="phase / deg", ylim=(-270.0, None))
    texts = [
        f"{name}: {m.phase_margin_deg:.1f} deg at {m.crossover_rad_s / (2.0 * math.pi):.4g} Hz, "
        f"{m.gain_margin_db:.1f} dB, {1e6 * m.delay_margin_s:.0f} us"
        for name, m in found.items()
        if name in loops
    ]
    return _finished(
        canvas, f"Open loops as sampled, delay included; phase, gain and delay margin: {'; '.join(texts)}."
    )


NYQUIST_SIZE = 2.0
"""Half side of the drawn part of the plane."""


def nyquist_figure(loops: Mapping[str, SampledLoop], found: Mapping[str, LoopMargins]) -> Figure:
    """Draw the open loops in the complex plane, with -1, the unit circle and the circle of the modulus margin.

    Parameters
    ----------
    loops, found : as :func:`bode_figure`
    """
    canvas, panels = _canvas(1, len(loops))
    turn = np.linspace(0.0, 2.0 * math.pi, 181)
    for axes, (name, loop), colour in zip(panels, loops.items(), _colours(len(loops)), strict=True):
        crossing = found[name].crossover_rad_s
        start = 0.02 * crossing if math.isfinite(crossing) else 1e-3 * math.pi / loop.T_s
        response = loop.at(np.geomspace(start, math.pi / loop.T_s, BODE_POINTS))
        axes.plot(np.cos(turn), np.sin(turn), "--", lw=0.8, color=_LIMIT)
        axes.plot(response.real, response.imag, color=colour)
        least = float(np.min(np.abs(1.0 + response)))
        axes.plot(-1.0 + least * np.cos(turn), least * np.sin(turn), ":", lw=1.0, color=_MODEL)
        axes.plot(-1.0, 0.0, "+", ms=9, color=_MODEL)
        axes.set(xlim=(-NYQUIST_SIZE, 1.0), ylim=(-NYQUIST_SIZE, 1.0), aspect="equal", xlabel="Re L")
        axes.set_title(f"{name}: {least:.2f} from -1", loc="left", fontsize=9)
    panels[0].set_ylabel("Im L")
    caption = "Nyquist curves of the open loops as sampled. Dotted: least distance from -1 (modulus margin); dashed: "
    return _finished(canvas, caption + "unit circle.")


def margin_map_figure(
    inductance: Array, delay: Array, phase_deg: NDArray[np.float64], designed: tuple[float, float], caption: str
) -> Figure:
    """Draw the phase margin of a current loop over an inductance and a delay that differ from the design.

    Parameters
    ----------
    inductance : ndarray, shape (n,)
        Of the machine over that of the design.
    delay : ndarray, shape (m,)
        In control periods.
    phase_deg : ndarray, shape (m, n)
        Least phase margin (deg); below 0 unstable.
    designed : tuple of float
        What the design assumes.
    """
    canvas, (axes,) = _canvas(1, 1)
    levels = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
    shown = np.clip(phase_deg, -15.0, 89.0)
    axes.contourf(inductance, delay, shown, levels=(-15.0, *levels, 90.0), cmap="RdYlGn", alpha=0.75)
    lines = axes.contour(inductance, delay, shown, levels=levels, colors=_OTHER, linewidths=0.8)
    axes.clabel(lines, fmt="%g deg", fontsize=8)
    axes.plot(*designed, "o", ms=6, color=_MEASURED)
    axes.annotate("designed", designed, xytext=(8, 6), textcoords="offset points", color=_MEASURED)
    axes.grid(False)
    axes.set(xlabel="inductance of the machine / designed", ylabel="delay / control periods")
    return _finished(canvas, caption)


def envelope_figure(
    speed_rpm: Array,
    largest_nm: Array,
    lines: Mapping[str, tuple[Array, Array]],
    I_max_apk: float,
    binding: Sequence[str] = (),
) -> Figure:
    """Draw the torque that can be reached over speed, and the current loci of the table.

    Parameters
    ----------
    speed_rpm, largest_nm : ndarray, shape (n,)
        Largest torque per speed; NaN where there is no admissible point.
    lines : mapping of str to (i_d, i_q)
        Loci in the current plane (A); what lies beyond the current limit is not drawn.
    I_max_apk : float
        Current limit (A peak).
    binding : sequence of str
        Limits that bind somewhere in the table.
    """
    canvas, (left, right) = _canvas(1, 2)
    left.plot(speed_rpm, largest_nm, color=_MEASURED)
    left.set(xlabel="speed / rpm", ylabel="largest torque / N m", ylim=(0.0, None))
    for (name, (i_d, i_q)), colour in zip(lines.items(), _colours(len(lines)), strict=True):
        if np.any(np.hypot(i_d, i_q) <= I_max_apk * (1.0 + 1e-6)):
            right.plot(i_d, i_q, color=colour, label=name)
    angle = np.linspace(0.5 * math.pi, math.pi, 91)
    right.plot(I_max_apk * np.cos(angle), I_max_apk * np.sin(angle), "--", color=_LIMIT, zorder=1.0, label="I_max")
    edge = 1.08 * I_max_apk
    right.set(xlabel="i_d / A", ylabel="i_q / A", aspect="equal", xlim=(-edge, 0.15 * edge), ylim=(0.0, edge))
    right.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    limits = f" Limits that bind in the table: {', '.join(binding)}." if binding else ""
    return _finished(canvas, f"Torque over speed and the current loci behind it.{limits}")


def band_figure(rows: Mapping[str, tuple[float, float, float, float]], unit: str, caption: str) -> Figure:
    """Draw numbers with their spread over a tolerance box, each against its limit.

    Parameters
    ----------
    rows : mapping of str to (low, middle, high, limit)
        Per row the 5 % quantile, the median, the 95 % quantile, and the least value allowed (NaN: none).
    unit : str
        Of all four.
    """
    return bands_figure({unit: rows}, caption)


def bands_figure(groups: Mapping[str, Mapping[str, tuple[float, float, float, float]]], caption: str) -> Figure:
    """As :func:`band_figure`, one pair of axes per unit.

    ``groups``: rows by unit.
    """
    lines = sum(map(len, groups.values()))
    canvas, panels = _canvas(len(groups), 1, height=0.25 * len(groups) + 0.12 * lines)
    for axes, (unit, rows) in zip(panels, groups.items(), strict=True):
        for y, (low, middle, high, limit) in enumerate(rows.values()):
            axes.plot([low, high], [y, y], "-", lw=5.0, color=_LIMIT, solid_capstyle="butt")
            axes.plot(middle, y, "o", ms=5, color=_MEASURED)
            if math.isfinite(limit):
                axes.plot([limit, limit], [y - 0.35, y + 0.35], color=_MODEL)
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set(xlabel="share" if unit == "1" else unit, ylim=(len(rows) - 0.5, -0.5))
    return _finished(canvas, caption)


def margin_figure(report: MarginReport) -> Figure:
    """Draw margins and headroom from the worst corner to the 95 % quantile, else nominal; no delay margins."""
    groups: dict[str, dict[str, tuple[float, float, float, float]]] = {}
    for spread in (row for row in (*report.loops, *report.headroom) if row.unit != "us"):
        high = spread.percentiles.get(95.0, spread.nominal)
        limit = math.nan if spread.least is None else spread.least
        if all(map(math.isfinite, (spread.worst, spread.nominal, high))):
            groups.setdefault(spread.unit, {})[spread.name] = (spread.worst, spread.nominal, high, limit)
    return bands_figure(groups, "")


FAR_OUT = 20.0
"""Half widths beyond which the axis of a difference is logarithmic."""


def difference_figure(rows: Mapping[str, tuple[float, float]], caption: str) -> Figure:
    """Draw differences of two runs over the half widths of their 95 % intervals: inside -1 to 1 they agree.

    ``rows``: in one unit each; the interval is not zero.
    """
    shares = {name: difference / interval for name, (difference, interval) in rows.items()}
    canvas, (axes,) = _canvas(1, 1, height=0.3 + 0.12 * len(rows))
    axes.axvspan(-1.0, 1.0, color=_BAND)
    for y, share in enumerate(shares.values()):
        axes.plot(share, y, "o", ms=5, color=_MEASURED if abs(share) <= 1.0 else _MODEL)
    edge = 1.1 * max(1.5, *(abs(share) for share in shares.values()))
    axes.set_yticks(range(len(rows)), list(rows))
    axes.set(xlabel="second minus first / half width of the 95 % interval", xlim=(-edge, edge))
    if edge > FAR_OUT:  # one that is far out would put all others on one line
        axes.set_xscale("symlog", linthresh=2.0)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    return _finished(canvas, caption)


def series_figure(
    name: str, unit: str, numbers: Sequence[int], values: Sequence[float], halves: Sequence[float]
) -> Figure:
    """Draw a quantity over the runs it was measured in, each with its total 95 % interval, and the median.

    Parameters
    ----------
    numbers : sequence of int
        Numbers of the runs in order of time.
    values, halves : sequence of float
        Values and half widths of their intervals.
    """
    canvas, (axes,) = _canvas(1, 1, height=0.6)
    axes.axhline(float(np.median(values)), color=_LIMIT)
    axes.errorbar(numbers, values, yerr=halves, fmt="o", ms=4, lw=1.0, color=_MEASURED)
    axes.set(xlabel="run", ylabel=f"{name} / {unit}")
    axes.xaxis.get_major_locator().set_params(integer=True)
    return _finished(canvas, f"{name} over the runs, with the total 95 % interval of each; grey: the median.")


_SIGNAL_LABELS = {"i_d_a": "i_d / A", "i_q_a": "i_q / A", "omega_e_rad_s": "speed / rad/s (el)"}


def proof_figure(
    prediction: Prediction,
    experiment: str,
    measured: Mapping[str, Array],
    caption: str,
    fastest: tuple[Array, Mapping[str, Array]] | None = None,
) -> Figure:
    """Draw the measured response of one experiment over its predicted band.

    Parameters
    ----------
    prediction : Prediction
        As committed before the first step.
    experiment : str
        One of its experiments.
    measured : mapping of str to ndarray, shape (n,)
        Response by signal; without one only the band is drawn.
    fastest : tuple of ndarray and mapping, optional
        Least times (s) to some of the measured values, and these by signal.
    """
    signals = prediction.signals(experiment)
    canvas, panels = _canvas(len(signals), 1, height=0.3 + 0.45 * len(signals), sharex=True)
    t_ms = 1e3 * prediction.t_s[experiment]
    for axes, signal in zip(panels, signals, strict=True):
        band = prediction.bands[experiment, signal]
        axes.fill_between(t_ms, band.low, band.high, color=_LIMIT, alpha=0.4, lw=0.0, label="predicted 95 % band")
        if signal in measured:
            outside = (measured[signal] < band.low) | (measured[signal] > band.high)
            axes.plot(t_ms, measured[signal], color=_MEASURED, label="measured")
            if np.any(outside):
                axes.plot(t_ms[outside], measured[signal][outside], "x", ms=4, color=_MODEL, label="outside")
        if fastest is not None and signal in fastest[1]:
            axes.plot(1e3 * fastest[0], fastest[1][signal], "--", color=_OTHER, label="least time to it")
        axes.set_ylabel(_SIGNAL_LABELS.get(signal, signal))
    panels[0].legend(loc="best")
    panels[-1].set_xlabel("time / ms")
    return _finished(canvas, caption)


def move_figure(moves: Mapping[str, Trace], caption: str) -> Figure:
    """Draw the following error of moves over the time since their demand began.

    ``moves``: recorded moves (``theta_ref_rad``, ``theta_m_rad``) by their names.
    """
    canvas, (axes,) = _canvas(1, 1, height=0.7)
    for (name, trace), colour in zip(moves.items(), _colours(len(moves)), strict=True):
        demand = trace["theta_ref_rad"]
        t_s = trace.t_s - trace.t_s[int(np.argmax(demand != demand[0]))]
        axes.plot(1e3 * t_s, np.degrees(demand - trace["theta_m_rad"]), color=colour, label=name)
    axes.set(xlabel="time / ms", ylabel="following error / deg")
    axes.legend(loc="best")
    return _finished(canvas, caption)


def _finished(canvas: Canvas, caption: str) -> Figure:
    return Figure(svg(canvas), caption, canvas=canvas)


def _canvas(rows: int, columns: int, *, height: float = 1.0, sharex: bool = False) -> tuple[Canvas, Any]:
    """Return a figure and its axes; matplotlib is imported here (0.3 s)."""
    import matplotlib
    from matplotlib.figure import Figure as Canvas

    with matplotlib.rc_context(_STYLE):
        canvas = Canvas(figsize=(_SIZE[0], _SIZE[1] * height), layout="constrained")
        axes = canvas.subplots(rows, columns, sharex=sharex, squeeze=False)
    return canvas, list(axes.ravel())


def _colours(count: int) -> list[str]:
    wheel = (_MEASURED, _MODEL, "#15803d", "#7e22ce", _OTHER, "#b45309")
    return [wheel[k % len(wheel)] for k in range(count)]


def svg(canvas: Canvas) -> str:
    """Return a figure as SVG text without what changes from run to run, ids only where something refers to them."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    out = io.StringIO()
    metadata = {"Date": None, "Creator": None, "Format": None, "Type": None}
    with matplotlib.rc_context(_STYLE):
        # Lay out once, with the renderer of SVG: with a layout engine, savefig draws the figure twice.
        FigureCanvasSVG(canvas)
        canvas.dpi = FigureCanvasSVG.fixed_dpi
        if engine := canvas.get_layout_engine():
            engine.execute(canvas)
            canvas.set_layout_engine(None)
        canvas.savefig(out, format="svg", metadata=metadata)
    text = out.getvalue()
    used = set(_REFERENCE.findall(text))
    return _ID.sub(lambda match: match[0] if match[1] in used else "", text)
