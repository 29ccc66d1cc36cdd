# SPDX-License-Identifier: MIT
"""More current, and more speed, is asked for than the drive's own limit allows: a limit that does not act is none."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from pmsmtool.drive.port import Drive
from pmsmtool.errors import SafetyRefusal
from pmsmtool.experiments.mechanics_run import FIRST_S, ShaftAnswer
from pmsmtool.experiments.speed_run import COAST_BAND, LOOK_S, QUICK_LOOK_S, RAMP_MOST_S, reach
from pmsmtool.experiments.standstill import ARRIVAL_LIMIT_S

LimitCurrent = Callable[[float], float | None]
"""Sets the drive's own limit (A peak), at most to the envelope's; returns what it keeps, None where it takes none."""
ASKED, OVER = 0.15, 1.5
"""Current that is asked for, of the rated one, and how many times the limit it is."""
MOST = 1.1
"""Current over the limit up to which the limit acts; measured 0.99 to 1.00 on the simulated drives."""
LEAST = 0.5
"""Current, of the limit, below which it was not reached and nothing was shown."""
WINDOW_S = 0.03
NEAR, STEADY = 0.9, 0.02
"""Current, of the limit, and its change from window to window, at which it stands; the gains are slow ones as yet."""
WAY_RAD = 0.06
"""Angle of a push that shows a limit: ten increments of an encoder with 1024."""
TORQUE_OVER = 2.0
"""As ``OVER``, where the current is told from the way of the shaft."""
LEAST_NET = 0.3
"""Of a current, what is taken to accelerate at least: friction is known roughly."""


@dataclass(frozen=True, slots=True)
class LimitShown:
    """Currents (A peak) or speeds of one trial: asked for, kept by the limit, seen, the most with which it acts."""

    asked: float
    kept: float
    seen: float
    most: float
    quantity: str = "current"
    unit: str = "A"

    @property
    def acts(self) -> bool:
        """Whether no more was seen than the limit allows."""
        return self.seen <= self.most

    def __str__(self) -> str:
        asked, kept, seen = (f"{value:.3g} {self.unit}" for value in (self.asked, self.kept, self.seen))
        shown = f"asked for {asked}, limit {kept}, the drive gave at most {seen}"
        if not self.acts:
            return f"the drive does not keep its own {self.quantity} limit: {shown}"
        return f"{self.quantity} limit {'proven' if self.proven else 'not proven'}: {shown}"

    @property
    def proven(self) -> bool:
        """Whether the limit was reached, and not more than that."""
        return self.acts and self.seen >= LEAST * self.kept


def not_shown(quantity: str = "current") -> str:
    """Return what is said of a limit that could not be tried."""
    return f"{quantity} limit not proven: the drive has none that can be lowered; every command is bounded here"


def unproven(shown: LimitShown | None, quantity: str = "current") -> str:
    """Return what a report says of a limit that was not proven, empty where it was."""
    if shown is None:
        return not_shown(quantity)
    return "" if shown.proven else f"{shown}; every command is bounded here, and this program looks"


def show_current_limit(
    drive: Drive, limit_current: LimitCurrent, I_nom_apk: float, i_max_apk: float, angle_rad: float
) -> LimitShown | None:
    """Ask for more than the limit, along a vector that the rotor lies on already; None where there is no limit.

    Parameters
    ----------
    drive : Drive
        Enabled; enabled at zero current on return.
    I_nom_apk, i_max_apk : float
        Rated current, and what may be asked for (A peak).
    angle_rad : float
        Electrical angle of the vector in the stator frame.
    """
    with _limited(drive, limit_current, min(ASKED * I_nom_apk, i_max_apk) / OVER) as kept:
        if kept is None:
            return None
        drive.command_current(OVER * kept, 0.0, fixed_angle_rad=angle_rad)
        return LimitShown(OVER * kept, kept, _settled(drive, kept), MOST * kept)


def show_torque_limit(
    drive: Drive, limit_current: LimitCurrent, answer: ShaftAnswer, most_a: float
) -> LimitShown | None:
    """Push with more torque current than the limit, and tell from the shaft what flowed; None as above.

    The same push without the limit is what it is compared with.

    Parameters
    ----------
    drive : Drive
        Enabled, at rest, in torque mode; so on return.
    most_a : float
        Largest torque current that may be asked for (A peak).
    """
    asked = min(most_a, max(ASKED * most_a, 2.0 * TORQUE_OVER * answer.friction_a))
    net = max(asked - answer.friction_a, LEAST_NET * asked)
    seconds = max(FIRST_S, math.sqrt(2.0 * WAY_RAD / (answer.per_ampere * net)))
    free = _way_of_push(drive, asked, seconds)
    with _limited(drive, limit_current, asked / TORQUE_OVER) as kept:
        if kept is None or not free:
            return None
        limited = _way_of_push(drive, asked, seconds)
    idle = asked - net  # what friction takes, with and without the limit
    return LimitShown(asked, kept, idle + net * limited / free, 0.5 * (asked + max(kept, idle)))


def require_limit(shown: LimitShown | None) -> None:
    """Refuse a drive whose commands are not all bounded here and that does not keep its limit.

    Raises SafetyRefusal: the limit does not act.
    """
    if shown is not None and not shown.acts:
        raise SafetyRefusal(
            str(shown),
            likely=f"the limit acts in other modes only, or the {shown.quantity} is limited by another object than "
            + ("0x6080" if shown.quantity == "speed" else "0x6073"),
            hint=f"ask the maker which object limits the {shown.quantity}; nothing more is moved without it",
        )


@contextmanager
def _limited(drive: Drive, limit_current: LimitCurrent, wanted_a: float) -> Iterator[float | None]:
    """Lower the limit while the drive is off and enable it; afterwards the envelope's limit holds again."""
    drive.disable()
    try:
        kept = limit_current(wanted_a)
        drive.enable()
        yield kept
        drive.disable()
    finally:
        limit_current(math.inf)
    drive.enable()


def _way_of_push(drive: Drive, current_a: float, seconds: float) -> float:
    """Push forth and back and return the angle (rad) that the way forth adds to how the shaft moved before."""
    angles = []
    for current in (0.0, current_a, -current_a):
        angles.append(drive.live("theta_m_rad"))
        drive.command_current(0.0, current)
        drive.wait(seconds)
    drive.command_current(0.0, 0.0)
    drive.wait(2.0 * seconds)
    before, start, end = angles
    return (end - start) - (start - before)


def _settled(drive: Drive, kept_a: float) -> float:
    """Return the current (A peak) once it stands at or below the limit, else its mean over the second half of the wait.

    A shaft that slips from one cog to the next swings for a while, and its back-EMF moves the current of slow gains by
    a third about the limit; a limit that does not act leaves the current above it all the time.
    """
    periods = max(1, round(WINDOW_S / drive.period_s))
    seen = [0.0]
    for _ in range(round(ARRIVAL_LIMIT_S / WINDOW_S)):
        means = drive.average(("i_d_a", "i_q_a"), periods)
        seen.append(math.hypot(means["i_d_a"], means["i_q_a"]))
        if NEAR * kept_a <= seen[-1] <= MOST * kept_a and abs(seen[-1] - seen[-2]) <= STEADY * kept_a:
            return seen[-1]
    return statistics.fmean(seen[len(seen) // 2 :])


LimitSpeed = Callable[[float], float | None]
"""Sets the drive's own limit (rad/s), at most to the envelope's; returns what it keeps, None where it takes none."""
SHARE = 0.10
"""The limit for the trial, of the largest speed of the run."""
REACH_S, REST_S = 2.0, 1.0
"""Longest time until the speed stands, and until the shaft rests again (s)."""
SEEN_S = 0.2
"""Shortest window in which the speed is looked at (s), and at least one turn."""
QUICK_SHARE, QUICK_SEEN_S, QUICK_TURNS, QUICK_BAND = 0.20, 0.10, 1.0 / 3.0, 0.08
"""The same three with an accuracy, where the run has half of the speed; and the relative distance from the limit at
which it begins, within ``MOST``."""


def show_speed_limit(
    drive: Drive, limit_speed: LimitSpeed, largest_rad_s: float, pole_pairs: int, *, quick: bool = False
) -> LimitShown | None:
    """Ask for one and a half times a lowered limit and see what the shaft does; None where there is no limit.

    Parameters
    ----------
    drive : Drive
        Off, with a speed controller that holds the machine; off and at rest on return. A shaft that still turns is
        stopped first: one of 26 rotors had a tenth of its speed left from pushes of 18 s.
    limit_speed : callable
        As :data:`LimitSpeed`.
    largest_rad_s : float
        Largest mechanical speed of the run.
    pole_pairs : int
        Of the machine.
    quick : bool
        Whether a third of a turn at more speed is enough to look at, by shorter looks; the shaft then coasts on return.
    """
    look_s = QUICK_LOOK_S if quick else LOOK_S
    share, seen_s, turns = (QUICK_SHARE, QUICK_SEEN_S, QUICK_TURNS) if quick else (SHARE, SEEN_S, 1.0)
    kept = limit_speed(share * largest_rad_s)
    if kept is None:
        return None
    try:
        drive.enable()
        band = (QUICK_BAND if quick else COAST_BAND) * kept * pole_pairs
        if abs(drive.live("omega_e_rad_s")) > kept * pole_pairs:
            drive.command_speed(0.0)
            reach(drive, 0.0, limit_s=RAMP_MOST_S, band_rad_s=band, look_s=look_s)
        asked = min(OVER * kept, largest_rad_s)
        drive.command_speed(asked)
        reach(drive, kept * pole_pairs, limit_s=REACH_S, band_rad_s=band, look_s=look_s)
        periods = math.ceil(max(seen_s, turns * 2.0 * math.pi / kept) / drive.period_s)
        seen = abs(drive.average(("omega_e_rad_s",), periods)["omega_e_rad_s"]) / pole_pairs
        drive.command_speed(0.0)
        if not quick:
            reach(drive, 0.0, limit_s=REST_S, band_rad_s=band)
        drive.disable()
    finally:
        limit_speed(math.inf)
    return LimitShown(asked, kept, seen, MOST * kept, "speed", "rad/s")
