# SPDX-License-Identifier: MIT
"""The frequency response of an identification, from the traces of its random torque, and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS, SURE
from pmsmtool.estimators.estimate import SensorTolerance
from pmsmtool.estimators.shaft.frequency_response import (
    INFORMATION_GAIN,
    FrequencyResponse,
    estimate_frequency_response,
)
from pmsmtool.estimators.shaft.mechanics import NO_HARMONICS, Torque
from pmsmtool.estimators.shaft.response_lines import STAGE
from pmsmtool.identification.mechanics import in_frame, torque_doubt, torque_of
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.npz_file import npz_bytes
from pmsmtool.refusals import refuse
from pmsmtool.run_directory import RunDirectory
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.identification.evaluate import Evaluation

TRACE = "frf_"
"""Followed by the number of a record."""
RESPONSE_FILE = "frequency_response.npz"
SHOWN, RIGID, NOTHING = "shaft_response", "rigid", "nothing"
"""Condition of a machine file that says what the response shows of the shaft, and two of its values."""
NOISE_DOUBT = 0.3
"""Relative standard deviation of the torque's scale, of the share of the noise in the power of the current: noise of
the input makes a response too small."""
COGGING_DOUBT = 0.2
"""Least relative deviation of the cogging that coasting showed: where small currents damped it, by 12 to 14 %, its line
gave J 12 % too small, and a rigid shaft counted as one with play."""
SAMPLE_DOUBT = 0.5
"""The same, of the displacement of the samples by a dead time, of the current's deviation. With both, errors of the
inertia of seven random drives up to 1.2 % were up to 1.1 standard deviations; without them up to 3.2."""


def frequency_response_of(
    traces: Mapping[str, Trace],
    result: Evaluation,
    tolerance: SensorTolerance | None = None,
    dead_time_s: float = 0.0,
) -> FrequencyResponse | None:
    """Return the response; None without the run, or without a flux linkage.

    ``dead_time_s`` is that of a leg; it displaces the samples of the current.

    Raises IdentificationError: as the estimator refuses.
    """
    parts = _records(traces)
    if not parts or result.flux is None or result.encoder is None or result.offset is None:
        return None
    asked_a = float(parts[0].meta["excitation"]["amplitude"])
    seen_a = min(float(np.std(part["i_q_a"])) for part in parts)
    if seen_a > asked_a:
        raise refuse(
            "E_EXCITATION",
            f"the current scatters by {seen_a:.2g} A beside a random sequence of {asked_a:.2g} A: the response of "
            "torque and motion is then not that of the shaft",
            stage=STAGE,
            likely="a light shaft with cogging, whose back-EMF moves the current, or a small motor for this drive",
        )
    pole_pairs = round(result.encoder.pole_pairs.value)
    known = result.mechanics
    cogging = NO_HARMONICS if known is None else known.harmonics
    unsure = max((h.std / h.amplitude for h in cogging.acceleration_rad_s2), default=0.0)
    return estimate_frequency_response(
        _framed(parts, result.offset.value),
        torque_of(result, pole_pairs),
        direction=int(parts[0].meta["direction"]),
        scale_std=_doubt(parts[0], result, dead_time_s),
        noise_nm=torque_per_ampere(pole_pairs, result.flux.psi_measured.value) * result.noise.sigma_a,
        over_angle=partial(cogging.torque_nm, J_kgm2=0.0 if known is None else known.J.value),
        angle_std=max(COGGING_DOUBT, unsure),
        tolerance=tolerance,
    )


def _records(traces: Mapping[str, Trace]) -> list[Trace]:
    return [traces[f"{TRACE}{k}"] for k in range(sum(name.startswith(TRACE) for name in traces))]


def _framed(parts: Sequence[Trace], offset_rad: float) -> list[Trace]:
    """Return records in the frame of the d axis."""
    return [in_frame(part, offset_rad - float(part.meta["offset_rad"])) for part in parts]


def encoder_errors_of(traces: Mapping[str, Trace], result: Evaluation) -> dict[int, float]:
    """Return what :func:`encoder_errors` finds in the records of a run; nothing without them, or a flux linkage."""
    parts = _records(traces)
    if not parts or result.flux is None or result.encoder is None or result.offset is None:
        return {}
    torque = torque_of(result, round(result.encoder.pole_pairs.value))
    return encoder_errors(_framed(parts, result.offset.value), torque, int(parts[0].meta["direction"]))


def encoder_errors(parts: Sequence[Trace], torque: Torque, direction: int) -> dict[int, float]:
    """Return what the position errs by once and twice per turn (rad), where all records show it alike.

    Coasting tells it better, but a heavy shaft with friction stops before a turn. Friction over the angle looks the
    same. Beside a random torque each record is what that moves a rigid shaft by, a speed and its change.

    Parameters
    ----------
    parts : sequence of Trace
        ``i_d_a i_q_a theta_M_rad`` in the frame of the d axis.
    torque : callable
        Torque (N m) of arrays of i_d, i_q (A).
    direction : int
        Sign of the encoder's count along the phase order.
    """
    each = []
    for part in parts:
        theta = direction * part["theta_M_rad"]
        x = np.linspace(-1.0, 1.0, len(theta))
        moved = np.cumsum(np.cumsum(torque(part["i_d_a"], part["i_q_a"])))
        Q, _ = np.linalg.qr(np.stack([np.ones_like(x), x, x * x, moved / np.max(np.abs(moved))], axis=1))
        waves = np.stack([of(n * theta) for n in ENCODER_ORDERS for of in (np.cos, np.sin)], axis=1)
        each.append(np.linalg.lstsq(waves - Q @ (Q.T @ waves), theta - Q @ (Q.T @ theta), rcond=None)[0])
    if len(each) < 2 or min(float(np.ptp(part["theta_M_rad"])) for part in parts) < 2.0 * math.pi:
        return {}
    mean = np.mean(each, axis=0).reshape(-1, 2)
    std = np.std(each, axis=0, ddof=1).reshape(-1, 2) / math.sqrt(len(each))
    sizes, deviations = np.hypot(*mean.T).tolist(), np.hypot(*std.T).tolist()
    rows = zip(ENCODER_ORDERS, sizes, deviations, strict=True)
    return {order: size for order, size, deviation in rows if size > SURE * deviation}


def small_signal_doubt(sigma_a: float, displaced_a: float, deviation_a: float) -> float:
    """Return what a small current's noise, and what a dead time displaces its samples by, may do to the torque's scale.

    ``sigma_a``, ``displaced_a``, ``deviation_a``: noise of a sample, displacement of the samples, and deviation of the
    current itself (A).
    """
    return math.hypot(NOISE_DOUBT * (sigma_a / deviation_a) ** 2, SAMPLE_DOUBT * displaced_a / deviation_a)


def _doubt(record: Trace, result: Evaluation, dead_time_s: float) -> float:
    """Relative standard deviation of the scale of the torque that shakes the shaft."""
    assert result.flux is not None and result.encoder is not None
    doubt = torque_doubt(result.flux, mapped=result.flux_map is not None)
    deviation = float(np.std(record["i_q_a"]))
    if result.inductance is None or deviation == 0.0:
        return doubt
    turned = float(np.ptp(record["theta_M_rad"])) / (float(record.t_s[-1]) - float(record.t_s[0]))
    emf = round(result.encoder.pole_pairs.value) * turned * result.flux.psi_measured.value
    displaced = 0.5 * dead_time_s * emf / result.inductance.L_q.value
    return math.hypot(doubt, small_signal_doubt(result.noise.sigma_a, displaced, deviation))


def shown_of(result: FrequencyResponse | None) -> str:
    """Return what a response shows of the shaft: ``rigid``, ``elastic`` or ``nothing``."""
    if result is None or result.inertia is None:
        return NOTHING
    return "elastic" if result.information_gain > INFORMATION_GAIN else RIGID


def save_response(run: RunDirectory, result: FrequencyResponse | None) -> dict[str, str]:
    """Write the table of the response into the run; returns its name as a stage lists it."""
    if result is None:
        return {}
    run.save(RESPONSE_FILE, npz_bytes(result.arrays()))
    return {RESPONSE_FILE: ""}


def response_summary(result: FrequencyResponse | None, refused: IdentificationError | None = None) -> str:
    """Return what a person reads of the response behind the other values, or why it was refused."""
    if result is None:
        return "" if refused is None else f"; frequency response refused: {refused.what}"
    return f"; frequency response: {result.reason.partition(':')[0]}"


def response_note(result: FrequencyResponse | None) -> str:
    """Return why no resonance is claimed, and which one would have been seen; empty where there is one."""
    return "" if result is None or result.found else f"frequency response: {result.reason}"
