# SPDX-License-Identifier: MIT
"""What the page of a report computes again while its reader moves R, L, the delay or a limit.

The step is computed in the page by the code that predicts it here (``proof/simulated_margins.py``). Loop margins are
interpolated in a map that is made here, by the function that the stage ``margins`` is judged with.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pmsmtool.design.design_file import Design
from pmsmtool.design.loops.current_loop import HOLD_PERIODS
from pmsmtool.design.loops.margins import MarginProblem, margin_problem
from pmsmtool.design.loops.vector_margins import VectorMargins, current_response, vector_margins
from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.native import page_module
from pmsmtool.proof.simulated_margins import DRAWN, MOVED, PARTS, SHIFT, SIGNALS, StepTask, step_task

NO_MODULE = (
    "This page does not compute the step again: the installation has no WebAssembly module. In a checkout: pip install "
    "'.[cross]', then python -m pmsmtool.packaging.build_kernels."
)
R_NODES = np.array([0.5, 0.75, 1.0, 1.5, 2.0])
L_NODES = np.round(np.geomspace(0.4, 1.8, 22), 6)
DELAY_NODES = np.linspace(-0.9, 0.9, 25)
"""Nodes of the margin map: factors of the design's R and L, control periods beside its delay. Between them the phase
margin is off by 0.25 deg below 90 deg, 0.6 deg above (the largest of 1120 points of 14 random drives)."""
GAIN_MOST_DB = 60.0
"""A larger gain margin is shown as this."""
MARGINS = {"phase": ("phase", "deg", 1), "gain": ("gain", "dB", 1), "delay": ("delay", "us", 0)}
"""Names, units and decimals of the margins."""


def recomputed(design: Design) -> Mapping[str, Any]:
    """Return what the page's template takes: data, sliders and texts, or under ``missing`` why there are none."""
    module = page_module()
    if module is None:
        return {"missing": NO_MODULE}
    try:
        task = step_task(design)
    except (NotAvailable, ConfigError) as error:
        return {"missing": f"This page does not compute the step again: {error.what}."}
    sliders = _sliders(design, task)
    data = {
        "module": base64.b64encode(module).decode("ascii"),
        "image": base64.b64encode(task.image).decode("ascii"),
        "setups": base64.b64encode(b"".join(task.setups)).decode("ascii"),
        "setup_bytes": len(task.setups[0]),
        "schedules": task.schedules, "mode": task.mode, "periods": task.periods, "T_s": task.T_s,
        "step_row": math.ceil(task.step_s / task.T_s), "step_a": task.scenario.schedule["i_q_a"][-1][1],
        "signals": [int(signal) for signal in SIGNALS.values()],
        "moved": {name: {"setup": places.setup, "params": places.params} for name, places in MOVED.items()},
        "shift": SHIFT,
        "parts": PARTS,
        "sliders": sliders, "margins": _margins(margin_problem(design)),
    }  # fmt: skip
    speed = next(value for _, value in task.scenario.schedule["driven_rpm"])
    caption = (
        f"Step of i_q to {data['step_a']:.4g} A at {speed:.4g} rpm, the rotor driven. Blue: with the values above. "
        f"Dashed: as designed. Dotted: the reference. Grey: range of {DRAWN} machines drawn from the tolerance box, "
        "moved in the same way. Margins are interpolated in a map of the design."
    )
    return {
        "missing": "", "data": _embedded(data), "sliders": sliders, "caption": caption,
        "margin_names": {name: f"{text} margin" for name, (text, _, _) in MARGINS.items()},
    }  # fmt: skip


def _embedded(data: Mapping[str, Any]) -> Any:
    """Return JSON that may stand inside a script element."""
    import markupsafe

    return markupsafe.Markup(json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))


def _slider(label: str, nominal: float, unit: str, low: float, high: float) -> dict[str, Any]:
    return {"label": label, "nominal": nominal, "unit": unit, "least": low, "most": high, "step": 0.01, "start": 1,
            "digits": 3, "added": False}  # fmt: skip


def _sliders(design: Design, task: StepTask) -> dict[str, dict[str, Any]]:
    delay = design["inverter.delay_periods"]
    return {
        "R": _slider("resistance R_s", design.machine.machine.R_s_ohm, "ohm", float(R_NODES[0]), float(R_NODES[-1])),
        "L": _slider("inductances L_d, L_q", 100.0, "%", float(L_NODES[0]), float(L_NODES[-1])),
        # a sample later than the start of the period needs a whole period of computation delay
        "delay": _slider("delay", delay, "periods", -0.9 if delay >= 1.5 else 0.0, 0.9)
        | {"step": 0.05, "start": 0, "added": True},
        "I_max": _slider("current limit", design["motor.I_max_apk"], "A peak", 0.1, 1.2),
        "U_dc": _slider("DC link", task.U_dc_v, "V", 0.3, 1.2),
    }  # fmt: skip


def _margins(problem: MarginProblem) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for axis in "qd":
        plant = problem.plants[axis]
        found = [loop_margins(problem, axis, L_NODES, float(extra), R_NODES) for extra in DELAY_NODES]
        shape = (len(R_NODES), len(L_NODES))
        for name, (_, unit, digits) in MARGINS.items():
            rows = [getattr(one, f"{name}_{'s' if name == 'delay' else unit.lower()}").reshape(shape) for one in found]
            table = np.clip(np.stack(rows, axis=-1), -90.0, GAIN_MOST_DB if name == "gain" else np.inf)
            table = np.minimum(1e6 * table, 1e8 * plant.T_s) if name == "delay" else np.minimum(table, 180.0)
            tables[f"{name}_{axis}"] = {"table": np.round(table, 3).tolist(), "unit": unit, "digits": digits}
    return {"R": R_NODES.tolist(), "L": L_NODES.tolist(), "delay": DELAY_NODES.tolist(), "tables": tables}


def loop_margins(
    problem: MarginProblem, axis: str, inductance: Any, periods: float, resistance: Any = (1.0,)
) -> VectorMargins:
    """Return the margins of a current loop whose machine and delay are not those of the design.

    Parameters
    ----------
    problem : MarginProblem
        Of the design.
    axis : str
        ``d`` or ``q``.
    inductance, resistance : array_like, shape (n,), (m,)
        Factors of the design's.
    periods : float
        Delay beside the design's (control periods); never less than the hold itself.

    Returns
    -------
    VectorMargins
        Each shape (m n,), the inductance fastest.
    """
    gains, plant = problem.gains[axis], problem.plants[axis]
    R, L = (grid.reshape(-1, 1) for grid in np.meshgrid(
        plant.R * np.asarray(resistance), plant.L * np.asarray(inductance), indexing="ij"
    ))  # fmt: skip
    model = (plant.R, plant.L) if problem.predictor else None
    delay = max(HOLD_PERIODS, plant.delay_periods + periods)
    return vector_margins(current_response(gains, R, L, plant.T_s, delay, model), plant.T_s, gains.K_p / plant.L)
