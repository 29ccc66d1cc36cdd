# SPDX-License-Identifier: MIT
"""Scales of the drive's sensors against an instrument: ``--cal V_dc=540V:537V:0.5V``.

No experiment on the machine sees the gain of its own current or DC-link measurement. An instrument does: what it reads
over what the drive shows at the same moment is a factor on every voltage or current of the traces, and the instrument's
tolerance takes the place of the sensor's. Nor does one see the thresholds of the bridge's devices, by whose difference
a leg swings further than the DC link; their data sheet does: ``--cal bridge=0.9V:1.1V:0.2V``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.estimators.estimate import COVERAGE_FACTOR, SensorTolerance
from pmsmtool.trace import Trace
from pmsmtool.units import parse_quantity

QUANTITIES = {"V_dc": "voltage", "I": "current"}
"""What can be calibrated: its dimension, and which tolerance it replaces."""
EXAMPLES = {"V_dc": "540V:537V:0.5V", "I": "5.00Apk:5.02Apk:0.01Apk"}
LARGEST_DEVIATION = 0.2
"""A ratio further from one is a slip of the pen or a broken sensor, not a scale."""
UNDRIVEN = "coast_"
"""How the names of traces of an undriven machine begin."""
BRIDGE = "bridge"
BRIDGE_EXAMPLE = "thresholds of switch and diode, and the 95 % tolerance of their difference: bridge=0.9V:1.1V:0.2V"
LARGEST_THRESHOLD_V = 3.0
"""No silicon or silicon carbide device that a drive is made of has more at no current."""


def calibrated_tolerance(tolerance: SensorTolerance, texts: Sequence[str]) -> SensorTolerance:
    """Return the tolerances with scales measured by an instrument.

    Raises ConfigError: not of that form, an unknown quantity, or values that are no calibration.

    Parameters
    ----------
    tolerance : SensorTolerance
        Declared tolerances.
    texts : sequence of str
        ``V_dc=SHOWN:TRUE:TOLERANCE`` or ``I=SHOWN:TRUE:TOLERANCE``, each with its unit, a current with its kind; the
        tolerance is the instrument's 95 % half width, a quantity or a percentage of TRUE. Or
        ``bridge=SWITCH:DIODE:TOLERANCE``: thresholds of the devices, and the 95 % half width of their difference.
    """
    for text in texts:
        name, _, numbers = text.partition("=")
        if name == BRIDGE:
            tolerance = _with_bridge(tolerance, text, numbers)
            continue
        if name not in QUANTITIES:
            raise ConfigError(f"{name!r} cannot be calibrated", hint=f"one of {', '.join((*QUANTITIES, BRIDGE))}")
        kind = QUANTITIES[name]
        shown, true, tolerated = _readings(text, name, numbers)
        ratio = true / shown if shown else math.inf
        if not abs(ratio - 1.0) <= LARGEST_DEVIATION or not 0.0 < tolerated < LARGEST_DEVIATION * abs(true):
            raise ConfigError(
                f"{text!r}: the instrument reads {ratio:.4g} of what the drive shows",
                hint=f"a calibration is within {100 * LARGEST_DEVIATION:g} % and has a tolerance",
            )
        tolerance = replace(tolerance, **{f"{kind}_scale": ratio, f"{kind}_gain": tolerated / abs(true)})
    return tolerance


def _with_bridge(tolerance: SensorTolerance, text: str, numbers: str) -> SensorTolerance:
    parts = numbers.split(":")
    if len(parts) != 3:
        raise ConfigError(f"{text!r} is not {BRIDGE}=SWITCH:DIODE:TOLERANCE", hint=BRIDGE_EXAMPLE)
    try:
        switch, diode, tolerated = (parse_quantity(part, "voltage") for part in parts)
    except ConfigError as error:
        raise ConfigError(f"{text!r}: {error.what}", likely=error.likely, hint=BRIDGE_EXAMPLE) from None
    if not all(0.0 <= threshold <= LARGEST_THRESHOLD_V for threshold in (switch, diode)) or not (
        0.0 < tolerated <= LARGEST_THRESHOLD_V
    ):
        raise ConfigError(
            f"{text!r}: thresholds are 0 to {LARGEST_THRESHOLD_V:g} V, and their difference has a tolerance",
            likely="a drop at rated current instead of the threshold, where the characteristic begins",
            hint=BRIDGE_EXAMPLE,
        )
    return replace(tolerance, bridge_difference_v=diode - switch, bridge_threshold_v=tolerated / COVERAGE_FACTOR)


def _readings(text: str, name: str, numbers: str) -> tuple[float, float, float]:
    hint = f"what the drive shows, what the instrument reads, and its tolerance: {name}={EXAMPLES[name]}"
    parts = numbers.split(":")
    if len(parts) != 3:
        raise ConfigError(f"{text!r} is not {name}=SHOWN:TRUE:TOLERANCE", hint=hint)
    try:
        shown, true = (parse_quantity(part, QUANTITIES[name]) for part in parts[:2])
        if parts[2].rstrip().endswith("%"):
            return shown, true, abs(true) * parse_quantity(parts[2], "ratio")
        return shown, true, parse_quantity(parts[2], QUANTITIES[name])
    except ConfigError as error:
        raise ConfigError(f"{text!r}: {error.what}", likely=error.likely, hint=hint) from None


def calibrated_traces(traces: Mapping[str, Trace], tolerance: SensorTolerance) -> Mapping[str, Trace]:
    """Return the traces in true volts and amperes; the same ones where nothing was calibrated.

    What the terminals of an undriven machine show (``coast_*``) is neither the DC link's sensor nor the bridge.

    Raises NotAvailable: the thresholds of the bridge were told, and the DC link they act on is not known.
    """
    if tolerance.bridge_difference_v is not None and math.isinf(tolerance.U_dc_v):
        raise NotAvailable(
            "the thresholds of the bridge act on a DC link that this run did not record",
            likely="a recorder, whose traces hold voltages and no DC link",
            hint=f"leave --cal {BRIDGE} out",
        )
    if tolerance.applied_scale == 1.0 and tolerance.current_scale == 1.0:
        return traces
    driven, current = tolerance.applied_scale, tolerance.current_scale
    return {n: _scaled(trace, 1.0 if n.startswith(UNDRIVEN) else driven, current) for n, trace in traces.items()}


def _scaled(trace: Trace, voltage_scale: float, current_scale: float) -> Trace:
    signals = copy(trace.signals)  # its own kind: it names its file when something is missing
    assert isinstance(signals, dict)
    for name, values in trace.signals.items():
        if name == "U_dc_v" or (name.startswith("u_") and name.endswith("_v")):
            values = voltage_scale * values
        elif name.startswith("i_") and name.endswith("_a"):
            values = current_scale * values
        signals[name] = values
    return replace(trace, signals=signals)
