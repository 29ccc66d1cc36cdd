# SPDX-License-Identifier: MIT
"""Harmonics of the magnets' flux linkage, and so of the back-EMF, from records of a coasting shaft with d current.

The flux linkage of a phase holds psi_m cos(m theta - phase), m = 5, 7, 11, 13; its back-EMF is m psi_m/psi_f of the
fundamental. In the rotor's frame m = n - 1 and n + 1 turn backward and forward at n = 6, 12:

    u_d = R i_d + d/dt (L_d i_d + h_d) - w (L_q i_q + h_q),      u_q = R i_q + d/dt (L_q i_q + h_q) + w (psi_d + h_d)

so (u - R i - ...)/w is the same at every speed. The inverter's error holds n, too. It is taken off by its measured
curve, sample by sample. What that leaves changes its sign with the current and does not grow with the speed, and is
regressed on beside h; so is what is even in the speed, a delay above all. A torque over the angle moves w itself, which
the encoder shows.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pmsmtool.arrays import Array, Complex
from pmsmtool.estimators.estimate import SensorTolerance, coverage_factor
from pmsmtool.estimators.injection.sampling_instant import Sampling
from pmsmtool.estimators.inverter_error import InverterCurve, Modulation, rippled_error_dq_v
from pmsmtool.identification.mechanics import in_frame
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

if TYPE_CHECKING:
    from pmsmtool.identification.evaluate import Evaluation


TRACE = "turns_"
"""Followed by the number of a record."""
STAGE = "harmonics"
ORDERS = (6, 12)
"""Orders of the rotor's frame."""
HIGHEST_FITTED = 14
"""Orders up to this are fitted along, per electrical turn."""
DEGREE = 3
"""Of the polynomial of time beside them: the shaft coasts."""
TURNS_LEAST = 2.5
"""Electrical turns of a record from which on its harmonics are told from one another."""
RECORDS_LEAST = 8
"""Records without limited samples: as many as are fitted to the six columns, and two."""
FOUND = 4.0
"""Amplitude, in standard deviations, from which on a harmonic is there."""
ALWAYS = (5, 7)
"""Harmonics that are reported where they are not found, too: their interval says how small they are."""


@dataclass(frozen=True, slots=True)
class EmfHarmonic:
    """One harmonic of a phase's flux linkage: ``flux`` is its amplitude (Wb) times exp(j phase), in the cosine's sense.

    ``std`` is the standard deviation of each part with ``dof`` degrees of freedom, ``systematic`` that of the
    amplitude by the tolerances of sensors and inductances (95 %).
    """

    order: int
    flux: complex
    std: float
    systematic: float
    dof: int

    @property
    def amplitude(self) -> float:
        """Amplitude (Wb); what the deviation alone would show is taken off, so that none is 0."""
        return math.sqrt(max(0.0, abs(self.flux) ** 2 - 2.0 * self.std**2))

    @property
    def found(self) -> bool:
        """Whether it is there."""
        return abs(self.flux) > FOUND * self.std


@dataclass(frozen=True, slots=True)
class EmfHarmonics:
    """Harmonics at the temperature of the run, the flux linkage there (Wb)."""

    harmonics: tuple[EmfHarmonic, ...]
    psi_wb: float
    T_c: float

    def estimates(self) -> dict[str, Estimate]:
        """Return amplitude (Wb) and phase (rad) of every harmonic by its name."""
        found: dict[str, Estimate] = {}
        for h in self.harmonics:
            if not (h.found or h.order in ALWAYS):
                continue
            share = 100.0 * h.order * h.amplitude / self.psi_wb
            limit = 100.0 * h.order * coverage_factor(h.dof) * h.std / self.psi_wb
            method = (
                f"{h.order}th of the back-EMF: {share:.2f} +- {limit:.2f} % of its fundamental, records in coasting"
            )
            amplitude = Estimate(h.amplitude, h.std, h.systematic, "Wb", T_c=self.T_c, method=method, dof=float(h.dof))
            found[f"psi_{h.order}_wb"] = amplitude
            if h.found:
                found[f"psi_{h.order}_rad"] = replace(
                    amplitude, value=cmath.phase(h.flux), std=h.std / h.amplitude, systematic=0.0, unit="rad"
                )
        return found


@dataclass(frozen=True, slots=True)
class Circuit:
    """What the records are reduced by: R (ohm), L_d and L_q (H), psi_f (Wb), delay of the voltage, and of samples."""

    R_ohm: float
    L_h: tuple[float, float]
    psi_wb: float
    period_s: float
    delay_periods: float
    sampling: Sampling


def harmonics_of(
    traces: Mapping[str, Trace],
    result: Evaluation,
    tolerance: SensorTolerance,
    period_s: float,
    modulation: Modulation | None = None,
) -> EmfHarmonics | None:
    """Return the harmonics; None without the run, or without what it is reduced by.

    Raises IdentificationError: ``E_CLIPPED``; ``E_EXCITATION``: too few turns or speeds.

    Parameters
    ----------
    traces : mapping of str to Trace
        ``turns_<k>`` of the run: ``u_d_v u_q_v i_d_a i_q_a theta_M_rad flagged``.
    result : Evaluation
        What the runs before it say.
    tolerance : SensorTolerance
        Declared sensor tolerances.
    period_s : float
        Control period (s).
    modulation : Modulation or None
        What the ripple at the switching edges makes of the inverter's error; None: nothing.
    """
    records = [traces[f"{TRACE}{k}"] for k in range(sum(name.startswith(TRACE) for name in traces))]
    resistance, found, flux = result.resistance, result.inductance, result.flux
    if not records or None in (resistance, found, flux, result.encoder, result.offset):
        return None
    assert resistance and found and flux and result.encoder and result.offset
    limited = sum(bool(np.any(record["flagged"] > 0.0)) for record in records)
    records = [record for record in records if not np.any(record["flagged"] > 0.0)]
    if len(records) < RECORDS_LEAST:
        raise refuse("E_CLIPPED", f"voltage or current limited in {limited} records, {len(records)} left", stage=STAGE)
    behind = result.offset.value - float(records[0].meta["offset_rad"])
    counts = result.encoder.direction * round(result.encoder.pole_pairs.value)
    theta = [counts * record["theta_M_rad"] - result.offset.value for record in records]
    _check(theta)
    rows = [
        _Row(in_frame(record, behind), angle, abs(counts), resistance.curve, modulation)
        for record, angle in zip(records, theta, strict=True)
    ]
    circuit = Circuit(
        resistance.R_measured.value,
        (found.L_d.value, found.L_q.value),
        flux.psi_measured.value,
        period_s,
        float(records[0].meta["delay_periods"]),
        found.sampling or Sampling(),
    )
    other = [replace(circuit, L_h=(L_d, L_q)) for L_d, L_q in _corners(found.L_d, found.L_q)]
    harmonics = []
    for order in ORDERS:
        fitted = _fit(rows, order, circuit)
        doubts = [_fit(rows, order, changed) for changed in other]
        for k, sense in enumerate((-1, 1)):
            value, std, dof = fitted[k]
            by_L = math.hypot(*(abs(doubt[k][0] - value) for doubt in doubts))
            harmonics.append(EmfHarmonic(order + sense, value, math.hypot(std, by_L), tolerance.flux * abs(value), dof))
    return EmfHarmonics(tuple(harmonics), circuit.psi_wb, flux.psi_measured.T_c)


def _corners(L_d: Estimate, L_q: Estimate) -> tuple[tuple[float, float], tuple[float, float]]:
    """Inductances with one of them a standard deviation larger."""
    return (L_d.value + L_d.std, L_q.value), (L_d.value, L_q.value + L_q.std)


def _check(theta: Sequence[Array]) -> None:
    turns = min(float(abs(angle[-1] - angle[0])) for angle in theta) / (2.0 * math.pi)
    ways = [float(angle[-1] - angle[0]) for angle in theta]
    if turns < TURNS_LEAST or max(ways) < 0.0 or min(ways) > 0.0:
        raise refuse(
            "E_EXCITATION",
            f"a record went through {turns:.2g} electrical turns, {TURNS_LEAST:g} in both directions are needed",
            stage=STAGE,
            likely="a shaft that stops before a record is over",
            hint="allow more speed (--speed-max), or take away what brakes the shaft",
        )


class _Row:
    """One record: mean speed and d current, and by order the phasors of what varies over the rotor's angle.

    These are of command, current, error of the inverter, each d and q, and of the angle itself. A signal is the real
    part of phasor exp(j order theta).
    """

    def __init__(
        self, record: Trace, theta: Array, pole_pairs: int, curve: InverterCurve, modulation: Modulation | None
    ) -> None:
        t = record.t_s - record.t_s[0]
        self.w = float(np.polyfit(t, theta, 1)[0])
        self.i_d = float(np.mean(record["i_d_a"]))
        slow = [1.0 / pole_pairs, 2.0 / pole_pairs] if pole_pairs > 2 else []
        orders = [*range(1, HIGHEST_FITTED + 1), *slow]
        x = 2.0 * t / t[-1] - 1.0
        columns = [np.vander(x, DEGREE + 1), *(wave(np.outer(theta, orders)) for wave in (np.cos, np.sin))]
        u, i = (record["u_d_v"], record["u_q_v"]), (record["i_d_a"], record["i_q_a"])
        bare = curve.error_dq_v(*i, theta)
        error = bare if modulation is None else rippled_error_dq_v(curve, i, u, theta, modulation)
        signals = np.stack([*u, *i, *error, theta], axis=1)
        found = np.linalg.lstsq(np.concatenate(columns, axis=1), signals, rcond=None)[0][DEGREE + 1 :]
        phasors: Complex = found[: len(orders)] - 1j * found[len(orders) :]
        self.of = {order: phasors[order - 1] for order in ORDERS}

    def flux(self, n: int, circuit: Circuit) -> tuple[complex, complex]:
        """Return the magnets' flux that turns backward and forward at order n, times exp of its phase (Wb)."""
        w, T_s = self.w, circuit.period_s
        u_d, u_q, i_d, i_q, error_d, error_q, ripple = (complex(value) for value in self.of[n])
        late = circuit.sampling.instant_s - circuit.sampling.lag_s
        u = [_turned(u_d, u_q, k * n, -k * n * circuit.delay_periods * w * T_s, w * T_s) for k in (1, -1)]
        i = [_turned(i_d, i_q, k * n, -(1 + k * n) * w * late, 0.0) for k in (1, -1)]
        u_d, u_q = _axes(u[0], u[1])
        i_d, i_q = _axes(i[0], i[1])
        L_d, L_q = circuit.L_h
        s = 1j * n
        e_d = (u_d - error_d - circuit.R_ohm * i_d) / w - s * L_d * i_d + L_q * i_q
        e_q = (u_q - error_q - circuit.R_ohm * i_q) / w - s * L_q * i_q - L_d * i_d
        e_q -= (circuit.psi_wb + L_d * self.i_d) * s * ripple
        # s h_d - h_q = e_d, s h_q + h_d = e_q
        h_d, h_q = (s * e_d + e_q) / (1.0 + s * s), (s * e_q - e_d) / (1.0 + s * s)
        forward, backward = 0.5 * (h_d + 1j * h_q), 0.5 * (h_d - 1j * h_q).conjugate()
        return backward, forward.conjugate()


def _turned(d: complex, q: complex, order: int, angle: float, held: float) -> complex:
    """Return the vector that turns at an order (of either sign), turned by an angle; held over ``held`` rad each."""
    vector = 0.5 * (d + 1j * q) if order > 0 else 0.5 * (d - 1j * q).conjugate()
    return vector * cmath.exp(1j * angle) * float(np.sinc(0.5 * (1 + order) * held / math.pi))


def _axes(forward: complex, backward: complex) -> tuple[complex, complex]:
    """Return the phasors of the axes of two vectors that turn against each other."""
    return forward + backward.conjugate(), -1j * (forward - backward.conjugate())


def _fit(
    rows: Sequence[_Row], order: int, circuit: Circuit
) -> tuple[tuple[complex, float, int], tuple[complex, float, int]]:
    """Return flux, standard deviation and degrees of freedom of the harmonics below and above an order."""
    w = np.array([row.w for row in rows]) / max(abs(row.w) for row in rows)
    s = np.sign([row.i_d for row in rows])
    # 1/w^2: the currents' harmonics by the dead time, which falls with 1/w, pass through its error once more
    matrix = np.stack([np.ones_like(w), w, s, s / w, s * np.sign(w), 1.0 / w**2], axis=1)
    values = np.array([row.flux(order, circuit) for row in rows])
    fit, _, rank, _ = np.linalg.lstsq(matrix, values, rcond=None)
    dof = len(rows) - int(rank)
    if dof < 1 or rank < matrix.shape[1]:
        what = f"{len(rows)} records do not separate the dead time from the back-EMF"
        raise refuse("E_EXCITATION", what, stage=STAGE)
    share = float(np.linalg.inv(matrix.T @ matrix)[0, 0])
    power = np.sum(np.abs(values - matrix @ fit) ** 2, axis=0) / (2.0 * dof)
    stds = np.sqrt(share * power)
    backward, forward = ((complex(fit[0, k]), float(stds[k]), 2 * dof) for k in (0, 1))
    return backward, forward
