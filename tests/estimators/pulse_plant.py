# SPDX-License-Identifier: MIT
"""A saturating machine under hysteresis pulses, in plain numpy: what a flux-map scan records, i(psi) in closed form.

Independent of the simulated drive: the flux is integrated exactly in the stator frame, the rotor moves as it is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pmsmtool.trace import Trace

Array = NDArray[np.float64]
Currents = Callable[[Array, Array], tuple[Array, Array]]

T_S = 1.0 / 12000.0
SUBSTEPS = 4


def _turn(angle: Array, x: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * x[0] - s * x[1], s * x[0] + c * x[1]])


def record_pulses(
    currents: Currents,
    psi_f: float,
    bands: Array,
    volts: Array,
    rng: np.random.Generator,
    *,
    R: float = 0.6,
    sigma: float = 0.01,
    pole_pairs: int = 2,
    offset: float = 0.3,
    frame_error: float = 0.0,
    swing: float = 0.0,
    samples: int = 1500,
) -> list[Trace]:
    """Return one trace per row of ``bands`` and ``volts``, shape (n, 2); ``swing`` (rad electrical) moves the rotor.

    ``frame_error`` is what the drive's offset is off: its frame stands that much behind the d axis.
    """
    n = len(bands)
    times = np.arange(samples * SUBSTEPS + 1) * T_S / SUBSTEPS
    theta_true = swing * np.sin(2.0 * math.pi * 9.0 * times)
    psi_s = _turn(np.full(n, theta_true[0]), np.stack([np.full(n, psi_f), np.zeros(n)]))
    sign = np.ones((2, n))
    pending = np.zeros((2, n))
    rows: dict[str, list[Array]] = {name: [] for name in ("i_d_a", "i_q_a", "u_d_v", "u_q_v")}
    for k in range(samples):
        at = theta_true[k * SUBSTEPS]
        frame = at - frame_error
        i = np.stack(currents(*_turn(np.full(n, -at), psi_s)))
        seen = _turn(np.full(n, at - frame), i) + sigma * rng.standard_normal((2, n))
        sign = np.where(seen > bands.T, -1.0, np.where(seen < -bands.T, 1.0, sign))
        u = sign * volts.T
        speed = (theta_true[(k + 1) * SUBSTEPS] - at) / T_S
        acting, pending = pending, _turn(np.full(n, frame + 1.5 * T_S * speed), u)
        for step in range(SUBSTEPS):
            angle = np.full(n, theta_true[k * SUBSTEPS + step])
            i_s = _turn(angle, np.stack(currents(*_turn(-angle, psi_s))))
            middle = psi_s + 0.5 * T_S / SUBSTEPS * (acting - R * i_s)
            angle = angle + 0.5 * (theta_true[k * SUBSTEPS + step + 1] - angle[0])
            i_s = _turn(angle, np.stack(currents(*_turn(-angle, middle))))
            psi_s = psi_s + T_S / SUBSTEPS * (acting - R * i_s)
        for name, values in zip(rows, (seen[0], seen[1], u[0], u[1]), strict=True):
            rows[name].append(values)
    theta = theta_true[: samples * SUBSTEPS : SUBSTEPS]
    speeds = np.diff(theta_true[::SUBSTEPS]) / T_S
    meta = {"control_period_s": T_S, "voltage_lag": 1, "held": swing == 0.0, "i_max_a": float(np.max(bands))}
    facts = {"signed_pole_pairs": pole_pairs, "offset_rad": offset + frame_error, "psi_f_wb": psi_f, "I_nom_a": 10.0}
    traces = []
    for k in range(n):
        signals = {name: np.ascontiguousarray(np.array(values)[:, k]) for name, values in rows.items()}
        signals["theta_M_rad"] = (theta + offset) / pole_pairs
        signals["omega_e_rad_s"] = speeds
        signals["flagged"] = np.zeros(samples)
        traces.append(Trace(np.arange(samples) * T_S, signals, dict.fromkeys(signals, "1"), {**meta, **facts}))
    return traces
