"""Scales of the drive's sensors against an instrument: ``--cal V_dc=SHOWN:TRUE:TOLERANCE``.

No experiment on the machine sees the gain of its own current or DC-link measurement. An instrument does: what it reads
over what the drive shows at the same moment is a factor on every voltage or current of the traces, and the instrument's
tolerance takes the place of the sensor's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from pmsmtool.errors import ConfigError
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.trace import Trace

QUANTITIES = {"V_dc": "voltage", "I": "current"}
"""What can be calibrated, and which tolerance it replaces."""
LARGEST_DEVIATION = 0.2
"""A ratio further from one is a slip of the pen or a broken sensor, not a scale."""


def calibrated_tolerance(tolerance: SensorTolerance, texts: Sequence[str]) -> SensorTolerance:
    """Return the tolerances with scales measured by an instrument.

    Parameters
    ----------
    tolerance : SensorTolerance
        Declared tolerances.
    texts : sequence of str
        ``V_dc=SHOWN:TRUE:TOLERANCE`` (V) or ``I=SHOWN:TRUE:TOLERANCE`` (A); the tolerance is the instrument's 95 % half
        width in the same unit.

    Raises
    ------
    ConfigError
        Not of that form, an unknown quantity, or values that are no calibration.
    """
    for text in texts:
        name, _, numbers = text.partition("=")
        if name not in QUANTITIES:
            raise ConfigError(f"{name!r} cannot be calibrated", hint=f"one of {', '.join(QUANTITIES)}")
        try:
            shown, true, tolerated = (float(number) for number in numbers.split(":"))
        except ValueError:
            raise ConfigError(
                f"{text!r} is not {name}=SHOWN:TRUE:TOLERANCE",
                hint="what the drive shows, what the instrument reads, and its tolerance, e.g. V_dc=47.9:48.2:0.05",
            ) from None
        ratio = true / shown if shown else math.inf
        if not abs(ratio - 1.0) <= LARGEST_DEVIATION or not 0.0 < tolerated < LARGEST_DEVIATION * abs(true):
            raise ConfigError(
                f"{text!r}: the instrument reads {ratio:.4g} of what the drive shows",
                hint=f"a calibration is within {100 * LARGEST_DEVIATION:g} % and has a tolerance",
            )
        kind = QUANTITIES[name]
        tolerance = replace(tolerance, **{f"{kind}_scale": ratio, f"{kind}_gain": tolerated / abs(true)})
    return tolerance


def calibrated_traces(traces: Mapping[str, Trace], tolerance: SensorTolerance) -> Mapping[str, Trace]:
    """Return the traces in true volts and amperes; the same ones where nothing was calibrated."""
    if tolerance.voltage_scale == 1.0 and tolerance.current_scale == 1.0:
        return traces
    return {name: _scaled(trace, tolerance) for name, trace in traces.items()}


def _scaled(trace: Trace, tolerance: SensorTolerance) -> Trace:
    signals = {}
    for name, values in trace.signals.items():
        if name.startswith("u_") and name.endswith("_v"):
            values = tolerance.voltage_scale * values
        elif name.startswith("i_") and name.endswith("_a"):
            values = tolerance.current_scale * values
        signals[name] = values
    return replace(trace, signals=signals)
