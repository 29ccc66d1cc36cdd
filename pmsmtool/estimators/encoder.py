# SPDX-License-Identifier: MIT
"""Pole pairs, direction and coarse offset of the encoder from a slowly rotated vector (docs/identification.md, 3.6).

The stator vector is turned forward and back through at least one mechanical turn and the rotor follows. The imposed
electrical angle over the measured mechanical angle is the number of pole pairs, its sign the direction; the mean of
direction p theta_M - theta_imposed over both runs is the offset, because the lag of friction has opposite signs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.estimators.angle_harmonics import ENCODER_ORDERS, Harmonic
from pmsmtool.machine.parameters import MAX_POLE_PAIRS, Estimate
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace

STAGE = "encoder"
RESTS = "rests on current vectors"
"""Method of :func:`estimate_by_rests`."""

INTEGER_LIMIT = 0.1
"""Largest distance of the count from an integer (docs/identification.md, 3.6)."""
LINEARITY_LIMIT_RAD = math.radians(30.0)
"""Largest deviation of p theta_M from the imposed angle (electrical): beyond it the rotor slips or sticks."""
JUMP_LIMIT_RAD = math.radians(150.0)
"""The same of a rotor that jumps from one cogging position to the next, or swings, where nothing better is had: with
deviations of 30 to 70 deg the mean of both directions was 0.0 to 2.4 deg off on five machines with 3 to 10 % of cogging
(a load of 190 times the rotor swung by 124 deg: its pole pairs, psi and L came out all the same)."""
COUNTS_SHARE = 0.25
"""Part of the imposed angle that friction leaves a rotor; less is none."""
PER_TURN_LEAST_RAD = 2e-3
PER_TURN_ORDERS = 8
"""Highest order per turn that shows how much of the following error is no encoder's."""
PER_TURN_ROWS = 2
"""Rows of a turn per number that is fitted; one with fewer shows no error once or twice per turn."""
PER_TURN_SURE = 4.0
"""Error of the encoder once or twice per turn (mechanical) from which on it is told, and how much more of it both
directions have in common than they differ by: what a swinging rotor or friction shows differs. Of 22 random drives
without such an error none shows one; with little more than two pole pairs a rotor swings by more than most have."""
MINIMUM_TURNS = 0.98
"""Mechanical turns the vector must have gone through in each direction."""
REST_SHARE, HOLDING_SHARE = 0.25, 0.7
"""Currents, of the largest, from which on a rest counts for pole pairs, and for the offset: friction and cogging hold a
rotor the farther off its vector the smaller it is."""
REST_LIMIT_RAD = math.radians(20.0)
"""Largest deviation of a rest."""
OTHER_WORSE = 3.0
"""How much farther the rests must be from any other number of pole pairs."""


@dataclass(frozen=True, slots=True)
class EncoderResult:
    """Pole pairs, direction and coarse offset."""

    pole_pairs: Estimate
    """Integer value; ``std`` is the distance of the two runs from it."""
    direction: int
    """+1 when the encoder counts with the electrical angle, -1 against it."""
    offset: Estimate
    """Offset in theta_e = direction p theta_M - offset (rad electrical), within (-pi, pi]."""
    lag_rad: float
    """Half the difference between forward and backward run: what friction holds back (rad electrical)."""
    per_turn: tuple[Harmonic, ...] = ()
    """What the rotation shows of the encoder's error once and twice per turn (rad, mechanical), by the phase order."""

    @property
    def per_turn_rad(self) -> tuple[float, ...]:
        """Amplitudes of that (rad); 0 where it is not clear."""
        limits = [max(PER_TURN_LEAST_RAD, PER_TURN_SURE * h.std) for h in self.per_turn]
        return tuple(h.amplitude * (h.amplitude > least) for h, least in zip(self.per_turn, limits, strict=True))


def check_encoder_counts(turned: Trace) -> None:
    """Refuse an encoder whose reading did not change while the vector turned.

    Raises IdentificationError: ``E_ENCODER``.

    Parameters
    ----------
    turned : Trace
        Two rows, before and after: ``theta_imposed_rad`` (electrical), ``theta_M_rad`` (mechanical).
    """
    imposed, measured = (abs(float(np.ptp(turned[name]))) for name in ("theta_imposed_rad", "theta_M_rad"))
    least = COUNTS_SHARE * imposed / MAX_POLE_PAIRS
    if measured < least:
        raise refuse(
            "E_ENCODER",
            f"the vector turned by {math.degrees(imposed):.4g} deg (electrical) and the encoder by "
            f"{math.degrees(measured):.2g} deg (mechanical), {math.degrees(least):.2g} at least are due",
            stage=STAGE,
        )


def estimate_encoder(forward: Trace, backward: Trace, limit_rad: float = LINEARITY_LIMIT_RAD) -> EncoderResult:
    """Pole pairs, direction and offset.

    Raises IdentificationError: ``E_POLE_PAIRS`` when the count is not an integer, ``E_ROTOR_MOVED`` when the rotor
    slips, ``E_EXCITATION``.

    Parameters
    ----------
    forward, backward : Trace
        ``theta_imposed_rad`` (electrical, unwrapped) and ``theta_M_rad`` (mechanical, unwrapped).
    limit_rad : float
        Largest deviation of the rotor from the imposed angle (electrical).
    """
    slopes = [_slope(trace) for trace in (forward, backward)]
    mean = 0.5 * (slopes[0] + slopes[1])
    count = round(abs(mean))
    distance = max(abs(abs(slope) - count) for slope in slopes)
    if count < 1 or distance > INTEGER_LIMIT or slopes[0] * slopes[1] <= 0.0:
        raise refuse(
            "E_POLE_PAIRS",
            f"electrical over mechanical angle is {slopes[0]:.3f} forward and {slopes[1]:.3f} backward, "
            f"limit {INTEGER_LIMIT:g} from an integer",
            stage=STAGE,
        )
    direction = int(math.copysign(1.0, mean))
    offsets = []
    for trace in (forward, backward):
        turns = abs(float(np.ptp(trace["theta_M_rad"]))) / (2.0 * math.pi)
        if turns < MINIMUM_TURNS:
            raise refuse("E_EXCITATION", f"the rotor turned {turns:.2f} times, {MINIMUM_TURNS:g} needed", stage=STAGE)
        deviation = direction * count * trace["theta_M_rad"] - trace["theta_imposed_rad"]
        centre = float(np.angle(np.mean(np.exp(1j * deviation))))
        worst = float(np.max(np.abs(wrapped(deviation - centre))))
        if worst > limit_rad:
            raise refuse(
                "E_ROTOR_MOVED",
                f"the rotor leaves the imposed angle by {math.degrees(worst):.3g} deg (electrical), "
                f"limit {math.degrees(limit_rad):g} deg",
                stage=STAGE,
                likely="cogging or a load stronger than the holding torque",
                hint="raise the current (--i-max) or free the shaft",
            )
        offsets.append((centre, float(np.std(wrapped(deviation - centre)))))
    lag = 0.5 * float(wrapped(np.array([offsets[0][0] - offsets[1][0]]))[0])
    middle, rows = float(wrapped(np.array([offsets[1][0] + lag]))[0]), len(forward) + len(backward)
    std = math.hypot(0.5 * math.hypot(offsets[0][1], offsets[1][1]), 0.25 * abs(lag))
    pole_pairs = Estimate(float(count), distance, 0.0, "1", n=rows, method="slow rotation")
    offset = Estimate(middle, std, 0.0, "rad", n=rows, method="slow rotation, mean of both directions (coarse)")
    return EncoderResult(pole_pairs, direction, offset, lag, _per_turn(forward, backward, direction, count))


def estimate_by_rests(levels: Trace, pairs: Trace) -> EncoderResult:
    """Pole pairs, direction and offset from where the rotor rested while the vector was led on from angle to angle.

    Raises IdentificationError: ``E_POLE_PAIRS``: another number of pole pairs would explain the rests, too, or none.

    Parameters
    ----------
    levels, pairs : Trace
        ``theta_imposed_rad`` (electrical, unwrapped), ``theta_M_rad`` (mechanical, unwrapped), ``i_d_a`` and ``moved``
        of every rest. The first vector is reached backward, the others forward.
    """
    imposed, theta, current, moved = (
        np.concatenate([levels[name], pairs[name]]) for name in ("theta_imposed_rad", "theta_M_rad", "i_d_a", "moved")
    )
    share = np.abs(current) / np.max(np.abs(current))
    counts = (share >= REST_SHARE) & (moved == 0.0)
    found = []
    for slope in (sign * count for count in range(1, MAX_POLE_PAIRS + 1) for sign in (1, -1)):
        off = slope * theta[counts] - imposed[counts]
        found.append((0.5 * float(np.ptp(off)), slope))
    (worst, slope), (other, beside) = sorted(found)[:2] if np.any(counts) else [(math.inf, 0), (math.inf, 0)]
    if worst > REST_LIMIT_RAD or other < OTHER_WORSE * worst:
        raise refuse(
            "E_POLE_PAIRS",
            f"the rests are up to {math.degrees(worst):.2g} deg (electrical) off their vectors with {abs(slope)} pole "
            f"pairs, up to {math.degrees(other):.2g} deg with {abs(beside)}",
            stage=STAGE,
        )
    off = slope * theta - imposed
    held = counts & (share >= HOLDING_SHARE)
    first = imposed == imposed[0]
    ways = [off[held & way] for way in (first, ~first)]
    if not all(map(len, ways)):
        raise refuse("E_POLE_PAIRS", "the rotor moved at the larger levels", stage=STAGE)
    back, forth = (float(np.mean(way)) for way in ways)
    std = math.hypot(0.25 * abs(back - forth), float(np.std(off[counts])))
    return EncoderResult(
        Estimate(float(abs(slope)), worst / float(np.ptp(theta[counts])), 0.0, "1", n=int(counts.sum()), method=RESTS),
        direction=int(math.copysign(1.0, slope)),
        offset=Estimate(
            float(wrapped(np.array([0.5 * (back + forth)]))[0]), std, 0.0, "rad", n=int(held.sum()), method=RESTS
        ),
        lag_rad=0.5 * (forth - back),
    )


def _per_turn(forward: Trace, backward: Trace, direction: int, pole_pairs: int) -> tuple[Harmonic, ...]:
    """Return what both directions show of the encoder's error once and twice per turn (rad mechanical).

    A rotor that sticks and slips behind the vector leaves something of every order: what does not stand out of the
    others is not the encoder's. Of multiples of the pole pairs nothing is known: offsets of the current sensors have
    them.
    """
    p = pole_pairs
    orders = [*ENCODER_ORDERS, *(k for k in range(3, PER_TURN_ORDERS + 1) if p == 1 or k % p)]
    if min(len(forward), len(backward)) < PER_TURN_ROWS * (1 + 2 * len(orders)):
        return ()
    found = []
    for trace in (forward, backward):
        theta = direction * trace["theta_M_rad"]
        columns = [np.ones_like(theta), *(wave(k * theta) for k in orders for wave in (np.cos, np.sin))]
        off = theta - trace["theta_imposed_rad"] / p
        fit = np.linalg.lstsq(np.stack(columns, axis=1), off, rcond=None)[0]
        found.append(fit[1::2] + 1j * fit[2::2])
    common, differs = (found[0] + found[1]) / 2.0, np.abs(found[0] - found[1]) / 2.0
    noise = np.maximum(differs, np.median(np.abs(common[len(ENCODER_ORDERS) :])))
    return tuple(
        Harmonic(order, float(of.real), float(of.imag), float(std) if order % p else math.inf)
        for order, of, std in zip(ENCODER_ORDERS, common, noise, strict=False)
    )


def _slope(trace: Trace) -> float:
    """Imposed electrical angle per measured mechanical angle.

    The measured one is regressed on the imposed one: of a heavy rotor that swings behind its vector by 1.5 rad, the
    other way round made 3.90 pole pairs of 4.
    """
    imposed, measured = trace["theta_imposed_rad"], trace["theta_M_rad"]
    centred = measured - np.mean(measured)
    power = float(centred @ centred)
    if power < (0.01) ** 2 * len(centred):
        raise refuse(
            "E_POLE_PAIRS",
            "the rotor did not follow the rotating vector",
            stage=STAGE,
            likely="locked shaft, too small a current, or an encoder that does not count",
        )
    turned = imposed - np.mean(imposed)
    along = float(centred @ turned)
    return float(turned @ turned) / along if along else math.inf


def wrapped(angle: Array) -> Array:
    """Return angles (rad) within half a turn of zero."""
    return np.asarray(np.angle(np.exp(1j * angle)))
