# SPDX-License-Identifier: MIT
"""The ramp by which a drive compensates its dead time, from what the machine file says of the voltage error."""

from __future__ import annotations

import numpy as np

from pmsmtool.machine.parameters import InverterParameters

_KNEE_DEFAULT_A = 0.5
_KNEE_LEAST_A = 1e-3


def dead_time_compensation(inverter: InverterParameters) -> tuple[float, float, str]:
    """Return plateau (V), knee (A) and method of the drive's ramp-shaped voltage-error compensation.

    Where only the identified table is given, the plateau is its last value and the knee makes the ramp miss the same
    area below the plateau as the table does.
    """
    if inverter.V_dead_v is not None:
        return inverter.V_dead_v, inverter.i_knee_apk or _KNEE_DEFAULT_A, "machine file"
    current, error = np.asarray(inverter.voltage_error_i_apk), np.asarray(inverter.voltage_error_v)
    positive = current > 0.0
    if not positive.any() or error[positive][-1] <= 0.0:
        return 0.0, _KNEE_DEFAULT_A, "off: no voltage error is identified"
    i, v = np.concatenate(([0.0], current[positive])), np.concatenate(([0.0], error[positive]))
    missing = float(np.sum(np.diff(i) * (v[-1] - 0.5 * (v[1:] + v[:-1]))))
    knee = 2.0 * missing / float(v[-1])
    return float(v[-1]), max(knee, _KNEE_LEAST_A), "ramp of equal area to the identified voltage error"
