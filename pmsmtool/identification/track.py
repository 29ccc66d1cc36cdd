# SPDX-License-Identifier: MIT
"""Follow R(T) and psi(T) of a machine in operation: observations from the drive or from stored traces, then the filter.

A run keeps the observations and what was known, so that a replay gives the same numbers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.estimators.tracking import Track, track
from pmsmtool.estimators.tracking_model import INDUCTANCE_STD, TRACKED, Known
from pmsmtool.files import read_text
from pmsmtool.identification.request import stored_traces
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.temperature import loop_coefficient_per_k
from pmsmtool.run_directory import RunDirectory, Stage
from pmsmtool.trace import Trace, trace_npz

OBSERVATIONS, KNOWN = "track", "track.json"
KNEE_POINTS = 64


def known_of(machine: MachineFile, *, compensated: bool) -> Known:
    """Return what a machine file knows before tracking.

    Parameters
    ----------
    machine : MachineFile
        As identified.
    compensated : bool
        Whether the drive compensates the inverter's error, so that the recorded voltage does not contain it.
    """
    values, inverter = machine.machine, machine.inverter
    L = {"L_d_h": values.L_d_decoupling_h, "L_q_h": values.L_q_decoupling_h}
    std = [max(INDUCTANCE_STD, _total_std(machine, name) / value) for name, value in L.items()]
    curve, doubt = _curve(machine)
    return Known(
        values.R_s_ohm, values.psi_f_wb, L["L_d_h"], L["L_q_h"], inverter.T_s, (std[0], std[1]), curve,
        (0.0, 2.0 * doubt) if compensated else (1.0, doubt),
    )  # fmt: skip


def _total_std(machine: MachineFile, name: str) -> float:
    """Standard deviation with the systematic part, which is a 95 % half width."""
    return math.hypot(machine.std.get(name, 0.0), machine.systematic.get(name, 0.0) / 1.96)


def _curve(machine: MachineFile) -> tuple[InverterCurve | None, float]:
    """Return the inverter's error and the relative doubt of its size."""
    inverter = machine.inverter
    if inverter.voltage_error_i_apk:
        i, u = np.array(inverter.voltage_error_i_apk), np.array(inverter.voltage_error_v)
        positive = i > 0.0
        return InverterCurve(i[positive], u[positive], 0.0), 0.1
    plateau, doubt = inverter.V_dead_v, 0.2
    if plateau is None:
        plateau, doubt = inverter.U_dc_v * inverter.dead_time_s / inverter.T_s, 0.5
    if plateau <= 0.0:
        return None, 0.1
    largest = machine.machine.I_max_apk or machine.machine.I_nom_apk or 1.0
    knee = inverter.i_knee_apk or 0.02 * largest
    i = np.linspace(0.0, largest, KNEE_POINTS + 1)[1:]
    return InverterCurve(i, plateau * np.tanh(i / knee), 0.0), doubt


# ---- observations from stored traces ----------------------------------------------------------------------------


def replay_observations(run: RunDirectory) -> Trace:
    """Return the observations that a run of ``track`` kept.

    What identification and commissioning record does not serve: their pushes are transients, in which inductance and
    delay decide the voltage, and their steady speeds are too few to tell the noise.

    Raises NotAvailable: the run is not one of ``track``.
    """
    traces = stored_traces(run)
    if OBSERVATIONS not in traces:
        others = ", ".join(sorted(traces)) or "none"
        raise NotAvailable(
            f"the run holds no observations of `track` (traces/{OBSERVATIONS}.npz); its traces: {others}",
            where=str(run.path),
            likely="a run of identify or commission, whose traces do not show steady operation over time",
            hint="`pmsmtool track` while the machine is operated records what a replay needs",
        )
    return traces[OBSERVATIONS]


# ---- the result ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Tracked:
    """A track with what it says of the temperatures."""

    track: Track
    """R and psi over time."""
    temperatures: dict[str, tuple[float, float]]
    """``T_winding_c`` from R and ``T_magnet_c`` from psi at the end (degC), with the doubt of the identified values.
    Mapping of str to (value, std)."""
    systematic: dict[str, float]
    """95 % half widths that the sensors' scales leave (:func:`systematic_of`)."""
    sensor_c: float
    """Mean reading of the winding's sensor (degC); NaN without one."""


def follow(observations: Trace, known: Known, machine: MachineFile, wanted: Sequence[str] = TRACKED) -> Tracked:
    """Run the filter and add the temperatures.

    Raises IdentificationError: as :func:`pmsmtool.estimators.tracking.track`.
    """
    found = track(observations, known, wanted)
    values = machine.machine
    temperatures = {}
    for name, quantity, alpha in (
        ("T_winding_c", "R_s_ohm", loop_coefficient_per_k(values)),
        ("T_magnet_c", "psi_f_wb", values.alpha_psi_per_k),
    ):
        reference = {"R_s_ohm": values.R_s_ohm, "psi_f_wb": values.psi_f_wb}[quantity]
        if quantity in wanted and alpha != 0.0:
            relative = float(found.value[quantity][-1]) / reference - 1.0
            std = math.hypot(float(found.std[quantity][-1]), machine.std.get(quantity, 0.0)) / reference
            temperatures[name] = (values.T_ref_c + relative / alpha, abs(std / alpha))
    if machine.inverter.voltage_error_i_apk:
        # the curve was what R_s i had left of the voltage: an error of R_s there is one of the same size here
        own = np.hypot(found.std["R_s_ohm"], machine.std.get("R_s_ohm", 0.0))
        found = replace(found, std={**found.std, "R_s_ohm": own})
    sensor = float(np.mean(observations["T_winding_c"])) if "T_winding_c" in observations.signals else math.nan
    return Tracked(found, temperatures, {name: systematic_of(machine, name) for name in wanted}, sensor)


def systematic_of(machine: MachineFile, name: str) -> float:
    """Return the 95 % half width of R or psi that the sensors' scales leave.

    As the machine file states it; without a statement, as of a drive's own values or a data sheet, with sensors of the
    tolerance that ``identify`` takes by default.
    """
    if name in machine.systematic:
        return machine.systematic[name]
    sensors = SensorTolerance()
    return {"R_s_ohm": sensors.impedance, "psi_f_wb": sensors.flux}[name] * float(getattr(machine.machine, name))


def keep(run: RunDirectory, observations: Trace, known: Known) -> None:
    """Store what a replay needs."""
    run.save(f"traces/{OBSERVATIONS}.npz", trace_npz(observations))
    run.save(KNOWN, dump_known(known))


def dump_known(known: Known) -> str:
    """Return what was known as JSON."""
    facts = asdict(known)
    if known.curve is not None:
        facts["curve"] = {"i_phase_a": known.curve.i_phase_a.tolist(), "u_error_v": known.curve.u_error_v.tolist()}
    return json.dumps(facts, indent=1) + "\n"


def load_known(path: Path) -> Known:
    """Read what :func:`dump_known` wrote; raises ``ConfigError`` when it is damaged."""
    text = read_text(path)
    try:
        facts: dict[str, Any] = json.loads(text)
        curve = facts.pop("curve")
        if curve is not None:
            curve = InverterCurve(np.array(curve["i_phase_a"]), np.array(curve["u_error_v"]), 0.0)
        (L_std_d, L_std_q), (share, share_std) = facts.pop("L_std"), facts.pop("error_share")
        numbers = {name: float(value) for name, value in facts.items()}
        return Known(**numbers, curve=curve, L_std=(L_std_d, L_std_q), error_share=(share, share_std))
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ConfigError(
            f"cannot be read: {error}", where=str(path), hint="track again; or take the file from a copy of the run"
        ) from error


def track_stage(found: Tracked, wanted: Sequence[str], machine: MachineFile) -> Stage:
    """Return the record of a track: the values at its end."""
    track_ = found.track
    values = [
        {
            "name": name, "value": float(track_.value[name][-1]), "std": float(track_.std[name][-1]),
            "systematic": found.systematic[name], "unit": {"R_s_ohm": "ohm", "psi_f_wb": "Wb"}[name],
            "n": len(track_.t_s), "T_c": found.sensor_c if math.isfinite(found.sensor_c) else None,
            "method": "unscented Kalman filter", "source": "pmsmtool",
        }
        for name in wanted
    ]  # fmt: skip
    text = f"{len(track_.t_s)} observations over {track_.t_s[-1] - track_.t_s[0]:.3g} s, innovations {track_.nis:.2g}"
    files = {f"traces/{OBSERVATIONS}.npz": "", KNOWN: ""}
    return Stage("track", "pass", 0.0, values=values, fallbacks=track_.notes, files=files, summary=text)
