# SPDX-License-Identifier: MIT
"""Experiments with a current vector at a fixed electrical angle: noise, phase check, DC levels.

Set-points only: what is measured goes back as traces, nothing is estimated here. Where a person reads the bench
supply meanwhile, they give the copper loss of a resting rotor.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Drive
from pmsmtool.drive.standard_drive import StandardDrive
from pmsmtool.experiments.rotation import TURN_S, come_to_rest, lead_onto_vector, turn_vector
from pmsmtool.experiments.signals import readable, table
from pmsmtool.trace import Trace

LEVELS = (0.0, 0.5, 1.0, 0.25, 0.75, 1.0, 0.5, 0.0)
"""Currents, of the largest one: up and down, so that what warms up meanwhile shows as scatter."""
SETTLE_S = 0.5
"""Time from a command to its reading."""
ReadSupply = Callable[[float], tuple[float, float]]
"""Given the current that flows (A peak), returns voltage (V) and current (A) of the supply."""


def hold_supply_levels(
    drive: StandardDrive, envelope: Envelope, i_a: float, read: ReadSupply, say: Callable[[str], None]
) -> Trace:
    """Return the readings, one row per level; the drive is off on return.

    Raises StopNotConfirmed, Interrupted, BusError, DriveFault, LimitExceeded: as the guard ends the experiment.

    Parameters
    ----------
    i_a : float
        Largest length of the vector (A peak).
    read : ReadSupply
        Asks the person, or a simulated supply.

    Returns
    -------
    Trace
        ``i_command_a``, ``supply_v``, ``supply_i_a``.
    """
    rows: list[dict[str, float]] = []
    times: list[float] = []
    elapsed_s, led = 0.0, False
    with guarded(drive, envelope, say=say) as guard:
        guard.enable()
        say(f"R: the power of the bench supply, read {len(LEVELS)} times up to {i_a:.3g} A")
        for share in LEVELS:
            if share and not led:
                lead_onto_vector(guard, share * i_a, 0.0)
                led = True
            guard.command_current(share * i_a, 0.0, fixed_angle_rad=0.0)
            guard.wait(SETTLE_S)
            elapsed_s += SETTLE_S
            volts, amps = read(share * i_a)
            rows.append({"i_command_a": share * i_a, "supply_v": volts, "supply_i_a": amps})
            times.append(elapsed_s)
        guard.command_current(0.0, 0.0, fixed_angle_rad=0.0)
    return table(rows, times)


NOISE_SAMPLES = 1024
"""The noise is known to 1.6 % of itself; the bus takes 0.3 s for them."""
PHASE_ANGLES_RAD = (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)
DC_ANGLE_RAD = math.pi / 2.0
"""One phase idle (docs/identification.md, 3.1)."""
NEAR_ANGLES_RAD = (7.0 * math.pi / 6.0, 5.0 * math.pi / 6.0, DC_ANGLE_RAD)
"""Vectors along the three pairs of phases that end on the first level's: a rotor that has half as far to go swings half
as long, and no turn follows."""
PAIR_STEP_RAD = math.pi / 3.0
"""Angle from pair to pair of phases."""

MEANS = ("u_d_v", "i_d_a", "u_q_v", "i_q_a", "T_winding_c", "U_dc_v")
"""What is averaged over a whole window at each level; with angle and flags the eight that a drive averages at once."""

LEVEL_WINDOW = 1600
"""Control periods averaged at each level (docs/identification.md, 3.1)."""
RIPPLE_S = 0.05
"""Half a window is a multiple of it: whole periods of what rectified mains leave on the link (100, 120, 300, 360 Hz),
which the dead time makes a voltage error. At 3.6 % of ripple a window of 20.2 periods was 6 mV of 3 V off."""
REST_RAD = 5e-4
"""Motion of the shaft (mechanical) between two looks that still counts as rest."""
TRIES = 6
"""Windows taken at one level until the shaft did not move in one; the last stands as it is."""
DRIFTED = 5e-4
"""Change of the voltage between the halves of a window, relative, that asks for another window."""
LOW_SHARE = 0.1
"""Levels up to this share of the largest are low ones: R is fitted from 0.28 on, the flux run begins at 0.15."""
CREPT = 1e-3
"""The same of the current, of the largest level, where the voltage's limit is ``DRIFTED``: a rotor that leaves a vector
slowly turns the voltage into both."""
LOOK_S, WINDOW_LOOK_S = 0.03, 0.02
"""Time between two looks at a shaft, and before the window of a level, which shows besides whether it moves: after
shorter ones a load of 50 times the inertia looked at rest where it turned back, and the pairs of phases of a reluctance
machine disagreed by 1.3 % of R."""
ARRIVED = 0.015
"""Distance of the mean current vector from its set-point, relative, that counts as arrived. With 0.02 and more a slow
current loop was still on its way in the windows of one of 16 drives, which then held all levels."""
REST_LIMIT_S = 3.0
"""A rotor that has not come to rest by then stays as it is; the estimator sees it in the halves of the window."""
NEAR_SHARE = 0.002
"""The same distance of a small level, of the largest: noise and offsets of the converter."""


@dataclass(frozen=True, slots=True)
class LevelPlan:
    """DC levels along one vector."""

    levels_a: Sequence[float]
    """Signed currents in the order they are held (A peak)."""
    turn_a: float
    """Current that turns the rotor to the vector before the first level and at every change of sign (A peak)."""
    start_rad: float = 0.0
    """Electrical angle of the vector that was held last: the rotor is near it."""
    settle_s: float = 0.06
    """Time between the set-point and the window (s)."""
    window_periods: int = LEVEL_WINDOW
    """Control periods averaged per level, about, split into two halves: each a whole multiple of ``RIPPLE_S``."""
    angle_rad: float = DC_ANGLE_RAD
    """Electrical angle of the vector in the stator frame."""
    drift: float = DRIFTED
    """Change of the voltage between the halves of a window, relative, that asks for another window; of the largest
    voltage so far on a low level of a quick plan: its current is the slowest, and it serves the inverter curve."""
    turn_s: float | None = TURN_S
    """Time of a turn of the vector, of the waits alone (s); None: as long as the rotor swings."""
    quick: bool = False
    """Whether every change of sign turns the vector on instead of back, so that the rests show the pole pairs; a rotor
    that stands where it stood before the current changed is at rest then without a second look, and a swing braked;
    and windows are as short as asked where the link is steady."""


def half_window(window_periods: int, period_s: float) -> int:
    """Return the control periods of half a window: about half of so many, and a whole multiple of ``RIPPLE_S``."""
    return round(max(1, round(0.5 * window_periods * period_s / RIPPLE_S)) * RIPPLE_S / period_s)


LINK_ROWS, LINK_S = 60, 0.03
"""Rows and time of a look at the link: three periods of 100 Hz."""
LINK_STEADY = 5e-4
"""Ripple of the link (peak, relative) below which a window may end within a period of it: its mean is a tenth of that
off, of the error that a dead time makes."""
STEADY_HALF_S = 0.02
"""Shortest half of a window on a steady link: three time constants of the current's loop."""


def steady_half(drive: Drive, window_periods: int) -> int | None:
    """Return the control periods of half a window on a DC link without ripple; None where it ripples.

    Noise is no ripple: it differs from row to row.
    """
    decimation = max(1, round(LINK_S / (LINK_ROWS * drive.period_s)))
    link = drive.record(("U_dc_v",), LINK_ROWS, decimation=decimation)["U_dc_v"]
    slow = float(np.var(link)) - 0.5 * float(np.mean(np.diff(link) ** 2))
    if math.sqrt(max(0.0, 2.0 * slow)) > LINK_STEADY * float(np.mean(link)):
        return None
    return round(max(0.5 * window_periods, STEADY_HALF_S / drive.period_s))


ARRIVAL_LIMIT_S = 1.0
"""A small current that has not come by then never comes: a phase is open, and the controller only winds up."""
SWING_LIMIT_S = 20.0
"""Longest wait for a rotor that swings on a small current: 2.9 kg m2 of a motor for 75 rpm swing at 0.5 Hz, and what
they induce kept the current of a healthy machine 11 % from its set-point."""


def calm_sequence(magnitudes: Sequence[float], low: Sequence[float] = ()) -> tuple[float, ...]:
    """Return an order of levels (A) for a free rotor: half of plus, minus, the other half, each up and down again.

    The sign changes twice instead of at every level, so that the rotor has to be turned over twice only. Both signs
    have the same mean time, and so have low and high levels: a drift stays orthogonal to the slope. Every magnitude is
    held once with each sign: how much the levels scatter decides less than what the shape of the inverter's error
    leaves open (54 drives: p90 of R 0.19 % as with twice as many). ``low`` are held at the first change of sign: they
    serve the inverter curve only.
    """
    up, low = sorted(magnitudes), sorted(low)
    turn = (*reversed(low), *(-level for level in low))
    minus = [-level for level in _there_and_back(up)]
    return (*_there_and_back(up[::2]), *turn, *minus, *_there_and_back(up[1::2]))


def falling_sequence(magnitudes: Sequence[float], low: Sequence[float] = ()) -> tuple[float, ...]:
    """Return an order of levels (A) on which a free rotor rests soon: all of plus, then of minus, falling.

    The rotor is turned over once, and on levels that fall friction holds it where it stands. A drift is even in the
    sign then, and stays orthogonal to the slope. The first ones of each sign rise, two below the largest: a step to it
    takes a weak supply to its under-voltage, and a limit shows below. ``low`` are held, too.
    """
    down = sorted((*magnitudes, *low), reverse=True)
    rise = down[4:0:-2]
    plus = (*rise, *(level for level in down if level not in rise))
    return (*plus, *(-level for level in plus))


def _there_and_back(up: Sequence[float]) -> tuple[float, ...]:
    return (*up[::2], *reversed(up[1::2]))


def record_zero_current(drive: Drive, samples: int = NOISE_SAMPLES) -> Trace:
    """Record both axis currents and the link of a drive that is off, in a fixed frame."""
    return readable(drive.record(("i_d_a", "i_q_a", "theta_m_rad", "U_dc_v", "flags"), samples))


PERIODS = 512
"""Of the means of one vector, in two halves."""
PHASE_HALF_S, PHASE_REST_S = 0.008, 0.05
"""Longest half of the window of a small vector (s): a current that a swinging rotor moves stays no longer. And the time
over which a rotor at rest does not move: one that turns back looks at rest in a shorter one."""


PHASE_ARRIVED = 0.045
"""As ``ARRIVED``, of either half of their window: the phases' currents may differ by 10 %. With 0.03 the current of a
heavy rotor's swing was waited for, for up to 1.5 s."""
INDUCED = 0.1
"""Voltage across a small vector, of the one along it, up to which a turning rotor induces little: what it adds to u/i
is less still, and u/i may differ by 30 %."""


def hold_phase_vectors(drive: Drive, i_a: float, angles_rad: Sequence[float] = PHASE_ANGLES_RAD) -> Trace:
    """Hold a small vector along each phase's axis and return one row of means for each.

    The drive is enabled on entry and holds zero current on return. It is off between two vectors: what its controller
    has wound up against an open phase must not meet the other two. Along :data:`NEAR_ANGLES_RAD` the rotor swings from
    one to the next, and the rows show vector and encoder, too. Currents are waited for, not the rotor's rest: a rotor
    that is still on its way leaves them as they are where it induces little.
    """
    names = ("i_a_a", "i_b_a", "i_c_a", "u_d_v", "u_q_v", "i_d_a", "i_q_a", "theta_m_rad")
    rows: list[dict[str, float]] = []
    times = []
    elapsed = 0.0
    near, last = angles_rad == NEAR_ANGLES_RAD, angles_rad[0]
    half = min(PERIODS // 2, round(PHASE_HALF_S / drive.period_s)) if near else PERIODS // 2
    for angle in angles_rad:
        if rows:
            drive.disable()
            drive.enable()
        begun, since, stays_a = elapsed, elapsed, complex(math.inf)
        seen: deque[float] = deque(maxlen=max(2, math.ceil(PHASE_REST_S / (2 * half * drive.period_s))))
        if rows and near:
            elapsed += turn_vector(drive, i_a, last, angle, None)
        last = angle
        drive.command_current(i_a, 0.0, fixed_angle_rad=angle)
        while True:
            first, second, _ = drive.halves(names, half)
            elapsed += 2 * half * drive.period_s
            halves = first, second
            arrived = all(math.hypot(part["i_d_a"] - i_a, part["i_q_a"]) <= PHASE_ARRIVED * i_a for part in halves)
            induced = any(abs(part["u_q_v"]) > INDUCED * abs(part["u_d_v"]) for part in halves)
            seen.append(second["theta_m_rad"])
            angles = first["theta_m_rad"], *seen
            rests = len(seen) == seen.maxlen and max(angles) - min(angles) < REST_RAD
            if arrived and (rests or not induced):
                break
            if not abs((i_dq_a := complex(second["i_d_a"], second["i_q_a"])) - stays_a) <= PHASE_ARRIVED * i_a:
                stays_a, since = (
                    i_dq_a,
                    elapsed,
                )  # a small swing, too, induces a current: only one that stays never comes
            if (rests and elapsed - since >= ARRIVAL_LIMIT_S) or elapsed - begun > SWING_LIMIT_S:
                break
        times.append(elapsed)
        row = {name: 0.5 * (first[name] + second[name]) for name in names if name != "theta_m_rad"}
        shown = {"theta_imposed_rad": angle, "theta_M_rad": second["theta_m_rad"]}
        rows.append({**row, "moved": float(not (arrived or rests)), **(shown if near else {})})
    drive.command_current(0.0, 0.0, fixed_angle_rad=angle)
    return table(rows, times, i_command_a=i_a, angles_rad=list(angles_rad))


PAIR_SHARES = (0.15, 0.30)
"""Currents of the three pairs of phases, of the largest: more is no stable position for a reluctance machine."""


def pair_currents(levels_a: Sequence[float], largest_a: float) -> tuple[float, float]:
    """Return the two currents of the pairs (A): levels near :data:`PAIR_SHARES` of the largest, if there are two.

    There the inverter's error is measured, not interpolated. Between two levels in the knee of a bridge of 560 V and
    0.4 A a chord took 13 ohm too much from slopes of 45 ohm, and three phases of 8 ohm were refused as not alike.
    """
    small, large = (share * largest_a for share in PAIR_SHARES)
    held = sorted(level for level in levels_a if 0.0 < level <= large)
    if len(held) < 2:
        return small, large
    return min(held[:-1], key=lambda level: abs(level - small)), held[-1]


PAIR_ARRIVED = 0.005
"""Distance of either half of a window from the set-point, relative, that asks for another window: beside a large dead
time the controller of the parameter set is slow, and 2 % below its set-point it made 12 % of a slope."""


def hold_pairs(
    drive: Drive,
    currents_a: tuple[float, float],
    turn_a: float,
    start_rad: float,
    turn_s: float | None = TURN_S,
    *,
    quick: bool = False,
    half: int | None = None,
) -> Trace:
    """Hold two currents through each pair of phases, the third phase idle (``meta["idle"]``); return a row for each.

    The windows are whole periods of a link's ripple, and how far their halves differ is kept, too: of 15 ms on a ripple
    of 3.6 % the slopes of equal phases were 1.8 % apart.

    Parameters
    ----------
    drive : Drive
        Enabled; it holds zero current on return.
    currents_a : (float, float)
        The smaller and the larger one (A peak).
    turn_a, start_rad : float
        Current that turns the rotor from pair to pair (A peak), and the vector that was held last (rad electrical).
    turn_s : float or None
        Time of a turn (s); None: as long as the rotor swings.
    quick : bool
        Whether the rows also have the angles of vector and encoder, and the vector goes on by 60 degrees from pair to
        pair.
    half : int or None
        Control periods of half a window; None: whole periods of a link's ripple.
    """
    names = ("i_a_a", "i_b_a", "i_c_a", "u_d_v", "i_d_a", "i_q_a", "theta_m_rad", "T_winding_c")
    half = half or half_window(PERIODS, drive.period_s)
    rows: list[dict[str, float]] = []
    times: list[float] = []
    elapsed = 0.0
    angle = start_rad
    whole = 2.0 * math.pi * round((start_rad - DC_ANGLE_RAD) / (2.0 * math.pi))
    targets = [whole + DC_ANGLE_RAD + further for further in PHASE_ANGLES_RAD]
    if quick:
        targets = [start_rad + k * PAIR_STEP_RAD for k in range(3)]
    for target in targets:
        if target != angle:
            elapsed += turn_vector(drive, turn_a, angle, target, turn_s)
            angle = target
        stood = math.inf
        for current in sorted(currents_a, reverse=quick):  # on the larger a swing is short, and friction holds it then
            drive.command_current(current, 0.0, fixed_angle_rad=angle)
            for n in range(TRIES):
                elapsed += settle(drive, current, stood_rad=stood)
                first, second, samples = drive.halves(names, half)
                moved = abs(second["theta_m_rad"] - first["theta_m_rad"]) >= REST_RAD
                missed = max(abs(part["i_d_a"] - current) for part in (first, second))
                stood = second["theta_m_rad"] if quick else math.inf
                if not moved and missed <= PAIR_ARRIVED * current:
                    break
                if n > 1 and moved:
                    elapsed += brake(drive, currents_a[1], current, angle)
                    turn_s = SWINGING_TURN_S
            times[len(rows) :] = [elapsed]
            row = {name: 0.5 * (first[name] + second[name]) for name in names if name != "theta_m_rad"}
            row["u_d_change_v"], row["i_d_change_a"] = (second[n] - first[n] for n in ("u_d_v", "i_d_a"))
            shown = {"theta_imposed_rad": angle, "theta_M_rad": second["theta_m_rad"]} if quick else {}
            rows.append({**row, "moved": float(moved), **shown})
            elapsed += 2 * half * drive.period_s
    drive.command_current(0.0, 0.0, fixed_angle_rad=angle)
    idle = ["acb"[round((target - DC_ANGLE_RAD) / PAIR_STEP_RAD) % 3] for target in targets for _ in currents_a]
    return table(rows, times, samples=samples, idle=idle)


def turn_and_look(drive: Drive, i_a: float, start_rad: float, end_rad: float, turn_s: float | None = TURN_S) -> Trace:
    """Turn a current vector slowly and return where the encoder stood before and after."""
    drive.command_current(i_a, 0.0, fixed_angle_rad=start_rad)
    settle(drive, i_a)
    periods = max(1, round(0.01 / drive.period_s))
    before = drive.average(("theta_m_rad",), periods)
    seconds = turn_vector(drive, i_a, start_rad, end_rad, turn_s)
    settle(drive, i_a)
    after = drive.average(("theta_m_rad",), periods)
    rows = [
        {"theta_imposed_rad": angle, "theta_M_rad": row["theta_m_rad"]}
        for angle, row in ((start_rad, before), (end_rad, after))
    ]
    return table(rows, [0.0, seconds], i_command_a=i_a)


def settle(
    drive: Drive, i_d_a: float, *, look_s: float = LOOK_S, near_a: float = 0.0, stood_rad: float = math.inf
) -> float:
    """Wait until the current has arrived and the shaft stands still, or a limit is over; return the time (s).

    ``stood_rad`` is where the shaft stood before the current changed: there it is at rest at the first look.
    A flag ends it: what is limited or at full scale does not settle, it winds up.
    """
    periods = max(1, round(0.25 * look_s / drive.period_s))
    waited = 0.0
    last = stood_rad
    while waited < REST_LIMIT_S:
        drive.wait(look_s)
        waited += look_s
        now = drive.average(("theta_m_rad", "i_d_a", "i_q_a", "flags"), periods)
        arrived = math.hypot(now["i_d_a"] - i_d_a, now["i_q_a"]) <= max(ARRIVED * abs(i_d_a), near_a)
        at_rest = abs(now["theta_m_rad"] - last) < REST_RAD
        if (at_rest and arrived) or (now["flags"] > 0.0 and not arrived):
            break
        last = now["theta_m_rad"]
    return waited


SWINGING_TURN_S = 3.0
"""Time of a turn once a swing was braked: in 0.4 s a load of 36 times the inertia was left behind, and slipped."""


def brake(drive: Drive, i_a: float, then_a: float, angle_rad: float) -> float:
    """Bring a rotor that swings to rest on a larger current, on which it swings faster; return the time (s).

    35 times the rotor's inertia swung through six windows of every level: 460 s without one value.
    """
    drive.command_current(i_a, 0.0, fixed_angle_rad=angle_rad)
    waited = come_to_rest(drive, i_a, angle_rad)
    drive.command_current(then_a, 0.0, fixed_angle_rad=angle_rad)
    return waited


def hold_levels(drive: Drive, plan: LevelPlan) -> Trace:
    """Hold DC levels and return one row per level: means of the window, of its halves, and the temperature.

    At each change of sign the rotor is turned by half an electrical turn; every window waits for it to come to rest.
    Values are along the plan's vector. The drive is enabled on entry and holds zero current on return.
    """
    names = (*MEANS, "theta_m_rad", "flags")
    half = half_window(plan.window_periods, drive.period_s)
    largest = max(map(abs, plan.levels_a))
    rows: list[dict[str, float]] = []
    times: list[float] = []
    elapsed = 0.0
    angle, stood, turn_s, looked = plan.start_rad, math.inf, plan.turn_s, not plan.quick
    highest_v = 0.0
    for level in plan.levels_a:
        sign = math.copysign(1.0, level)
        target = plan.angle_rad if sign > 0.0 else plan.angle_rad + math.pi
        if plan.quick:
            target += 2.0 * math.pi * max(0, math.ceil((angle - target) / (2.0 * math.pi) - 0.25))
        if angle != target:
            elapsed += turn_vector(drive, plan.turn_a, angle, target, turn_s)
            angle, stood = target, math.inf
        # minus is the vector turned by half a turn, not a negative current: the controller does not notice
        drive.command_current(abs(level), 0.0, fixed_angle_rad=angle)
        drive.wait(plan.settle_s)
        elapsed += plan.settle_s
        for k in range(TRIES):
            elapsed += settle(drive, abs(level), look_s=WINDOW_LOOK_S, near_a=NEAR_SHARE * largest, stood_rad=stood)
            if not looked and abs(level) == largest:  # under which a supply gives way
                half, looked = steady_half(drive, plan.window_periods) or half, True
            first, second, samples = drive.halves(names, half)
            times[len(rows) :] = [elapsed]
            elapsed += 2 * half * drive.period_s
            # a rotor that creeps out of an unstable position looks at rest just before it jumps
            turned = abs(second["theta_m_rad"] - first["theta_m_rad"])
            drifted = abs(second["u_d_v"] - first["u_d_v"])
            crept = abs(second["i_d_a"] - first["i_d_a"])
            highest_v = max(highest_v, abs(first["u_d_v"]))
            of_v = highest_v if plan.quick and abs(level) <= LOW_SHARE * largest else abs(first["u_d_v"])
            still = drifted <= plan.drift * of_v and crept <= CREPT * (plan.drift / DRIFTED) * largest
            moved = turned >= REST_RAD or not still
            if plan.quick:
                stood = second["theta_m_rad"]
            if not moved:
                break
            if k > 1 and turned >= REST_RAD:
                elapsed += brake(drive, largest, abs(level), angle)
                turn_s = SWINGING_TURN_S
        row = {name: 0.5 * (first[name] + second[name]) for name in MEANS}
        for name, unit in (("u_d", "v"), ("i_d", "a")):
            row[f"{name}_first_{unit}"] = sign * first[f"{name}_{unit}"]
            row[f"{name}_second_{unit}"] = sign * second[f"{name}_{unit}"]
            for axis in (f"{name}_{unit}", f"{name[0]}_q_{unit}"):
                row[axis] *= sign
        row["moved"] = float(moved)
        row["theta_M_rad"] = second["theta_m_rad"]
        if plan.quick:
            row["theta_imposed_rad"] = angle
        row["flagged"] = float(first["flags"] + second["flags"] > 0.0)  # a mean of flag words: any bit counts
        rows.append(row)
        if row["flagged"]:
            break  # the estimator refuses it; nothing larger is held
    drive.command_current(0.0, 0.0, fixed_angle_rad=angle)
    return table(rows, times, samples=samples, fixed_angle_rad=plan.angle_rad, i_command_a=list(plan.levels_a))
