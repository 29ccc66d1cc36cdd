# SPDX-License-Identifier: MIT
"""What one count of a gain is worth, from loops measured with the gains as they are and with each changed.

The form of the integral part is the one under which the changes of counts explain the changes of K_i: hypotheses are
compared by their likelihood. A form, a scale or a convention that the data do not decide stays unknown.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from pmsmtool.identification.asked_current import AskedLoop
from pmsmtool.identification.speed_loop_response import SpeedLoop

NORMAL_95 = 1.96
WIDEST, WIDEST_STATED = 0.12, 0.25
"""Half widths (95 %, relative) of a scale beyond which it stays unknown: 12 % of a gain is 1 dB. The larger one counts
with what the scale rests on. A design rests on the same inertia, so that its error is in both, and the loop has none of
it; a data sheet's 10 % of inertia alone take 11 of 12 %, and no gain was decided on catalogue motors."""
MODEL_DOUBT = (0.02, 0.03)
"""What the loop's model leaves of K_p and of K_i (standard deviation, relative): unknown filters, dead time, friction.
Measured on random drives whose EMF takes little: 0 to 3 % and 0 to 2 % (docs/learned-gains.md)."""
SMALL_CURRENT = 0.006
"""Standard deviation of a gain (relative) times current over rated current: below some percent of the rated current the
inverter's dead time holds the current back. Measured at 7 % of it: K_p -20 %."""
HELD_BACK = 0.3
"""By how much both gains come out too small, over the share of the current that torque pulses show not to flow at once;
half of that is its doubt. Measured on 16 drives: 0.1 to 0.5."""
CURRENT_BANDWIDTH, BANDWIDTH_DOUBT = 0.12, 0.7
"""What a maker's current loop has (rad/s) over its switching frequency (Hz), about: 0.05 to 0.3; the standard deviation
of the EMF's share that follows from it (relative)."""
CHANGE_DOUBT = (0.03, 0.05, 0.04)
"""What it leaves of a ratio of two K_p, K_i or K_i / K_p of one drive (standard deviation, relative)."""
SPREAD_DOUBT = 0.5
"""Of what a scale differs between the drive's own and changed gains (standard deviation, relative)."""
LEFT_DOUBT = 0.5
"""Of what steps of half the size say otherwise: friction and dead time are a larger share of them (standard deviation,
relative)."""
FITS = 14.2
"""Largest chi-square of a hypothesis that explains three ratios (3 degrees of freedom, 3 sigma)."""
APART = 16.0
"""Smallest chi-square by which the second-best hypothesis must be worse: 1 in 3000."""
EXCLUDED = 3.5
"""Standard deviations from which a convention is excluded: 1 in 2000."""
UNMOVED = 0.2
"""Share of a change of the integral's counts that K_p may seem to follow: friction and dead time let it seem so."""
NOT_SAME = 3.0
"""Standard deviations by which a ratio may miss what it should be."""
BLOCK = 3.0 * math.sqrt(3.0) / math.pi / 1.5
CONVENTIONS = {"peak": 1.0, "block": BLOCK, "rms": math.sqrt(2.0)}
"""Torque per ampere of block commutation and of a sine's rms value, over that of its peak value."""
EXPONENTS = {
    "value": (0.0, 1.0),
    "rate": (1.0, 1.0),
    "time": (1.0, -1.0),
    "time of its own": (0.0, -1.0),
    "no effect": (0.0, 0.0),
    "no effect but the gain's": (1.0, 0.0),
}
"""How K_i follows the counts of the gain and of the integral part: parallel, and three series forms.

The integral part leaves K_p alone, so that its effect is seen in K_i / K_p, which a fit knows better than K_i."""
BETTER = 0.95
"""Misfit of the current with the lag before the torque, over the one with it in the feedback, from which on it may lie
there: 0.55 to 0.87 of three drives with current loops of 400 rad/s, 1.01 to 1.12 of four with 700 to 2200."""
NO_DOUBT = (0.0, 0.0, 0.0)
CURRENT_WIDEST = 0.03
"""As :data:`WIDEST`, of a current loop."""
CURRENT_MODEL_DOUBT, CURRENT_CHANGE_DOUBT = (0.005, 0.005), (0.015, 0.02, 0.015)
"""As :data:`MODEL_DOUBT` and :data:`CHANGE_DOUBT`, of a current loop: counts of currents and voltage, dead time; see
docs/learned-gains.md for what was measured."""
CURRENT_UNITS = {"gain": "V/A", "value": "V/(A s)", "rate": "1/s", "time": "s"}
UNITS = {"gain": "N m s/rad", "value": "N m/rad", "rate": "1/s", "time": "s"}


@dataclass(frozen=True, slots=True)
class Basis:
    """What scales rest on: inertia or inductance, and what the model of the loop leaves (relative)."""

    value: float
    std: float
    """SI value, and its standard deviation."""
    widest: float = WIDEST
    """Half width (95 %) of what is measured of a scale, beyond which it stays unknown."""
    model: tuple[float, float] = MODEL_DOUBT
    change: tuple[float, float, float] = CHANGE_DOUBT
    """Standard deviations of K_p and K_i, and of a ratio of two K_p, K_i or K_i / K_p."""
    units: Mapping[str, str] = field(default_factory=lambda: UNITS)
    """Of one count, by form; ``gain`` is K_p."""

    def half_width(self, std: float) -> float:
        """Return the 95 % half width of a scale that is measured with a standard deviation (relative)."""
        return NORMAL_95 * math.hypot(std, self.std)

    def too_wide(self, std: float) -> bool:
        """Whether such a scale stays unknown: what a design makes of the same inertia does not count in full."""
        return NORMAL_95 * std > self.widest or self.half_width(std) > WIDEST_STATED


def current_basis(L_h: float, L_std: float) -> Basis:
    """Return what the gains of a current loop rest on."""
    return Basis(L_h, L_std, CURRENT_WIDEST, CURRENT_MODEL_DOUBT, CURRENT_CHANGE_DOUBT, CURRENT_UNITS)


@dataclass(frozen=True, slots=True)
class Rotor:
    """What the scales of gains rest on."""

    J_kgm2: float
    J_std: float
    """Inertia of all that turns, and its standard deviation (relative)."""
    time_constant_s: float
    """J R / (K_T K_E): without feed-forward of the EMF a current loop of bandwidth w lags an acceleration as if the
    inertia were larger by 1 / (w tau)."""
    f_s_hz: float
    """Switching frequency, which bounds the bandwidth."""

    @property
    def basis(self) -> Basis:
        """What scales rest on."""
        return Basis(self.J_kgm2, self.J_std)

    @property
    def lagging(self) -> float:
        """By how much the inertia seems larger, for the current lags the EMF (relative)."""
        return 1.0 / (CURRENT_BANDWIDTH * self.f_s_hz * self.time_constant_s)


@dataclass(frozen=True, slots=True)
class Observation:
    """One measured loop, and what was so meanwhile."""

    gain: float
    integral: float
    """Counts that both gains held."""
    loop: SpeedLoop
    """What was measured."""
    current_share: float = 1.0
    """Largest current over the rated one."""
    model_std: tuple[float, float, float] = NO_DOUBT
    """Standard deviation of K_p, K_i and K_i / K_p (relative) by the EMF's share and by where the loop's lag lies."""
    asked: AskedLoop | None = None
    """What the current that the loop asked for says, where the drive shows it."""
    at_once: float | None = None
    """Share of the current that flows at once, where torque pulses showed it."""

    @property
    def loops(self) -> tuple[SpeedLoop, ...]:
        """What was measured, in either way; the better one last."""
        return (self.loop,) if self.asked is None else (self.loop, self.asked.loop)

    def by_asked(self) -> Observation:
        """Return what the current that was asked for says: nothing that current loop and dead time do is in it."""
        if self.asked is None:
            return self
        return replace(self, loop=self.asked.loop, model_std=self.asked.std, at_once=1.0)

    @property
    def held_back(self) -> float:
        """By how much the gains of the response are too small (relative), as far as torque pulses showed it."""
        return 0.0 if self.at_once is None else HELD_BACK * (1.0 - self.at_once)

    @property
    def std(self) -> float:
        """Standard deviation of what a small current leaves of a gain (relative)."""
        return SMALL_CURRENT / self.current_share if self.at_once is None else 0.5 * self.held_back


@dataclass(frozen=True, slots=True)
class Learned:
    """What was found of one gain."""

    name: str
    """Catalogue name."""
    scale: float | None
    """SI value of one count in the unit of the form; None: unknown."""
    half_width: float
    """Of the scale, relative, 95 %; also where it stays unknown."""
    form: str | None
    """``value``, ``rate`` or ``time``, as a drive map names it; None: unknown."""
    unit: str
    """Of one count; empty where the form is unknown."""
    why: str = ""
    """Why it stays unknown; empty where it does not."""
    chi_squares: dict[str, float] = field(default_factory=dict)
    """Of every hypothesis about the form."""


@dataclass(frozen=True, slots=True)
class Convention:
    """What an ampere that the drive shows is: ``peak``, ``rms`` or ``block``; None: unknown."""

    kind: str | None
    torque_per_ampere: float
    expected_peak: float
    std_log: float
    why: str = ""


K_P, K_I, RATE = 0, 1, 2


def _logs(loop: SpeedLoop) -> tuple[float, float, float]:
    K_p, K_i = math.log(loop.K_p_per_J), math.log(loop.K_i_per_J)
    return K_p, K_i, K_i - K_p


def emf_doubt(one: SpeedLoop, other: SpeedLoop, most: float) -> tuple[float, float, float]:
    """Return half of what two loops differ in K_p, K_i and K_i / K_p (relative), at most ``most``.

    That is what the EMF's share may be off. The loops answer one record with both ends of the share; a fit that ends
    elsewhere must not say more.
    """
    K_p, K_i, rate = (min(most, 0.5 * abs(a - b)) for a, b in zip(_logs(one), _logs(other), strict=True))
    return K_p, K_i, rate


def lag_doubt(loop: SpeedLoop, forward: SpeedLoop) -> tuple[float, float, float]:
    """Return half of what K_p, K_i and K_i / K_p differ by (relative) where the lag lies before the torque.

    Nothing where the loop with the lag in its feedback explains the current as well: there the current loop is fast.
    """
    if forward.misfit > BETTER * loop.misfit:
        return NO_DOUBT
    K_p, K_i, rate = (0.5 * abs(a - b) for a, b in zip(_logs(loop), _logs(forward), strict=True))
    return K_p, K_i, rate


def _log(observation: Observation, which: int) -> float:
    return _logs(observation.loop)[which] + (0.0 if which == RATE else observation.held_back)


def _change(after: Observation, base: Sequence[Observation], which: int, basis: Basis) -> tuple[float, float]:
    """Return the change of a gain's logarithm, and its standard deviation."""
    return _log(after, which) - _log(base[0], which), basis.change[which]


def _of_all(logs: Sequence[float], half_size: float) -> tuple[float, float]:
    """Return the mean of logarithms, and its standard deviation with what steps of half the size differ from them."""
    mean, spread = _mean(logs)
    return mean, math.hypot(SPREAD_DOUBT * spread, LEFT_DOUBT * (mean - half_size))


def _mean(logs: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation of single values."""
    mean = sum(logs) / len(logs)
    return mean, math.sqrt(sum((x - mean) ** 2 for x in logs) / max(1, len(logs) - 1))


def gain_scale(base: Sequence[Observation], gain_changed: Observation | None, basis: Basis, name: str) -> Learned:
    """Return what one count of the proportional gain is worth.

    Parameters
    ----------
    base : sequence of Observation
        With the drive's own gains: with steps of full size, and of half of it.
    gain_changed : Observation or None
        With other counts of the gain alone; None: it could not be changed.
    basis : Basis
        Inertia or inductance.
    """
    if gain_changed is None:
        return Learned(name, None, math.inf, None, "", "the gain was not changed")
    change, std = _change(gain_changed, base, K_P, basis)
    asked = math.log(gain_changed.gain / base[0].gain)
    if abs(asked) < EXCLUDED * std:
        return Learned(name, None, math.inf, None, "", f"a change by {100 * std:.0f} % would not be seen")
    if abs(change - asked) > NOT_SAME * std:
        why = f"the response follows the counts with the exponent {change / asked:.2f}, not 1"
        return Learned(name, None, math.inf, None, "", why)
    logs = [_log(o, K_P) - math.log(o.gain) for o in (base[0], gain_changed, base[1])]
    mean, std = _of_all(logs[:-1], logs[-1])
    std = math.hypot(std, basis.model[0], base[0].std, base[0].model_std[K_P])
    scale, half, unit = basis.value * math.exp(mean), basis.half_width(std), basis.units["gain"]
    if basis.too_wide(std):
        return Learned(name, None, half, "value", unit, f"its interval of {100 * half:.2g} % is too wide")
    return Learned(name, scale, half, "value", unit)


def integral_scale(
    base: Sequence[Observation],
    gain_changed: Observation | None,
    integral_changed: Sequence[Observation],
    basis: Basis,
    name: str,
) -> Learned:
    """Return form and scale of the integral part; parameters as of :func:`gain_scale`."""
    if gain_changed is None or not integral_changed:
        return Learned(name, None, math.inf, None, "", "it was not changed")
    by_gain, std_gain = _change(gain_changed, base, K_I, basis)
    ratio_gain = math.log(gain_changed.gain / base[0].gain)
    by_integral = [
        (*_change(after, base, RATE, basis), math.log(after.integral / base[0].integral)) for after in integral_changed
    ]
    chi_squares = {
        form: ((by_gain - of_gain * ratio_gain) / std_gain) ** 2
        + sum(((change - of_integral * ratio) / std) ** 2 for change, std, ratio in by_integral)
        for form, (of_gain, of_integral) in EXPONENTS.items()
    }
    best, second = sorted(chi_squares, key=lambda form: chi_squares[form])[:2]

    def unknown(why: str, form: str | None = None, half: float = math.inf) -> Learned:
        return Learned(name, None, half, form, basis.units.get(form or "", ""), why, chi_squares)

    for after in integral_changed:
        moved, std = _change(after, base, K_P, basis)
        if abs(moved) > max(NOT_SAME * std, UNMOVED * abs(math.log(after.integral / base[0].integral))):
            return unknown(f"its change moved K_p by {100 * moved:.0f} %")
    if chi_squares[best] > FITS:
        return unknown("no form explains how the response follows both gains")
    if chi_squares[second] - chi_squares[best] < APART:
        return unknown(f"the forms {best!r} and {second!r} cannot be separated")
    if best not in basis.units:
        return unknown(f"its form is {best!r}, which a drive map cannot describe")
    relative = best != "value"
    observed = (base[0], gain_changed, integral_changed[0], base[1])  # the smallest K_i is known least
    logs = []
    for o in observed:
        kept = _log(o, RATE if relative else K_I)
        logs.append((-kept if best == "time" else kept) - math.log(o.integral))
    mean, std = _of_all(logs[:-1], logs[-1])
    model_std = base[0].model_std[RATE if relative else K_I]
    std, rests = math.hypot(std, basis.model[1], base[0].std, model_std), replace(basis, std=0.0) if relative else basis
    half = rests.half_width(std)
    if rests.too_wide(std):
        return unknown(f"its interval of {100 * half:.2g} % is too wide", best, half)
    scale = math.exp(mean) if relative else basis.value * math.exp(mean)
    return Learned(name, scale, half, best, basis.units[best], "", chi_squares)


def convention(
    observed: Sequence[Observation], rotor: Rotor, torque_per_apk: float, psi_std: float, shown_per_ampere: float
) -> Convention:
    """Return whether the drive's amperes are peak, rms or block, from the acceleration that one of them gives.

    Parameters
    ----------
    torque_per_apk, psi_std : float
        Torque per ampere peak (N m/A), and the standard deviation of the flux linkage (relative).
    shown_per_ampere : float
        By what the shown current was multiplied already (sqrt 2 where it was read as rms).
    """
    logs = [math.log(rotor.J_kgm2 / abs(o.loop.amps_per_rad_s2) * shown_per_ampere) for o in observed]
    mean, spread = _mean(logs)
    std = math.hypot(rotor.J_std, psi_std, spread, MODEL_DOUBT[0])
    found = mean - math.log(torque_per_apk)
    misses = {kind: abs(found - math.log(ratio)) / std for kind, ratio in CONVENTIONS.items()}
    best, second = sorted(misses, key=lambda kind: misses[kind])[:2]
    facts = math.exp(mean), torque_per_apk, std
    if any(o.loop.at_bound for o in observed):
        return Convention(None, *facts, "the fit of the response ended at a bound")
    if misses[best] > NOT_SAME:
        return Convention(None, *facts, f"torque per shown ampere is {math.exp(found):.2f} of the peak one")
    if misses[second] < EXCLUDED:
        return Convention(None, *facts, f"{best} and {second} cannot be separated")
    return Convention(best, *facts)
