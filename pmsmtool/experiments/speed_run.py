# SPDX-License-Identifier: MIT
"""Windows at steady currents while the shaft coasts: means for the flux linkage and the fine encoder offset.

The speed controller brings the shaft to a speed; then a current vector is held in the rotor frame and the shaft coasts.
Without i_q the inverter's error has hardly a q part, whatever friction and inertia are.

Records of voltage and current over whole turns of a coasting shaft, for the harmonics of the back-EMF.

At every speed the d current is held with both signs: the inverter's error changes its sign with the current, and the
back-EMF does not. Speeds in both directions tell from it what does not grow with the speed, or looks like a delay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from pmsmtool.drive.port import Drive, Excitation, Injection, Shape
from pmsmtool.estimators.flux.linkage_rows import fastest_pair
from pmsmtool.experiments.signals import readable, table
from pmsmtool.trace import Trace

SHARES = (0.40, 0.55, 0.70, 0.85)
"""Of the largest speed of the run, both directions."""
D_SHARES = ((1.0,), (1.0,), (1.0 / 3.0, 2.0 / 3.0, 1.0), (1.0 / 3.0, 2.0 / 3.0, 1.0))
"""d currents at each speed, of the largest; the low ones tell how the d axis saturates."""
Q_AT = (1, 2)
"""Speeds at which q currents are held, too."""
MEANS = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "omega_e_rad_s", "T_magnet_c", "T_winding_c", "flags")

LOOK_S, QUICK_LOOK_S, LOOKS = 0.05, 0.025, 2
"""Time of a look at the speed (s), and in how many of them one after the other it has arrived."""
SLOWEST, QUICK_SLOWEST = 0.82, 0.7
"""Part of the set speed below which a coasting shaft is brought back to it; of a run with an accuracy."""
COAST_BAND, QUICK_COAST_BAND = 0.03, 0.1
COAST_LIMIT_S = 3.0
"""Relative distances and time for a shaft that is left to coast at once: its windows measure where it is. An overshoot
that friction takes back slowly cost up to 8 s per speed with the narrow band. The time of the ramp comes on top: a
reversal that took longer than the limit gave windows of the wrong direction."""
RAMP_DOUBT = 1.5
"""Time of a ramp, of what the rough inertia says; friction takes part of the torque."""
RAMP_MOST_S = 35.0
COAST_LOSS = 0.15
"""Part of its speed that a shaft may lose in one window; one that would lose more keeps the q current that held its
speed. Ten profiles and random drives lose 0.004 to 0.1, jercic-2017 0.2."""
LEAD_MOST = 0.1
"""Largest q current beside a d current that keeps the speed, of that: an angle of the encoder 6 degrees beside."""
HOLD_S, HELD_S = 0.05, 0.25
"""Shortest windows for that current, whole electrical turns: to see whether one is due, and to measure it. A speed loop
of 25 rad/s whose current the inverter's error slows rings with that period: 50 ms of it gave 1.2 A in place of 0.2."""
SETTLE_S, SETTLE_MOST_S = 0.025, 0.1
"""Shortest and longest time between a current's command and its window (s)."""
WINDOW_S, LONGEST_S = 0.06, 0.2
"""Shortest window of the d currents, and longest turn of the shaft that one takes (s)."""
Q_WINDOW_S = 0.03
"""Shortest window of a q current, which accelerates the shaft."""
LOOP_PERIODS = 6.0
"""Shortest time constant of the run's current loop, in periods: a voltage acts one and a half of them late."""
NEAR = 0.005
"""Relative distance from the set speed that counts as reached."""
REACH_LIMIT_S = 8.0
"""A speed that is not reached by then is measured as it is; the estimator sees it in the halves of the window."""


@dataclass(frozen=True, slots=True)
class SpeedPlan:
    """Speeds to reach, and currents to hold there."""

    omega_max_rad_s: float
    """Largest mechanical speed (rad/s)."""
    i_d_a: float
    """Largest d current, held with both signs (A peak)."""
    i_q_a: float
    """q current, held with both signs (A peak)."""
    settle_s: float = SETTLE_S
    """Time between a current's command and its window (s)."""
    first_s: float = 0.05
    """The same after the speed controller (s)."""
    window_s: float = WINDOW_S
    longest_s: float = LONGEST_S
    """Shortest window, rounded up to whole mechanical turns; where one turn is longer than the longest, whole
    electrical turns must do (s)."""
    q_window_s: float = Q_WINDOW_S
    """Shortest window of a q current, which accelerates the shaft: whole electrical turns (s)."""
    per_ampere_rad_s2: float = 0.0
    acceleration_rad_s2: float = math.inf
    """Rough mechanical acceleration per q current (rad/s2/A), and the one of the speed controller (rad/s2)."""
    shares: tuple[float, ...] = SHARES
    d_shares: tuple[tuple[float, ...], ...] = D_SHARES
    q_at: tuple[int, ...] = Q_AT
    """As :data:`SHARES`, :data:`D_SHARES` and :data:`Q_AT`."""
    quick: bool = False
    """Whether a shaft that coasts well enough at its first speed is left to coast at the others as soon as it is seen
    there, without a look at what would hold it."""

    @property
    def slowest(self) -> float:
        """Part of the set speed below which a coasting shaft is brought back to it."""
        return QUICK_SLOWEST if self.quick else SLOWEST

    def stations(self) -> list[tuple[float, list[tuple[float, float]]]]:
        """Return the mechanical speeds in the order they are reached, and the vectors that are held at each."""
        found = []
        for k, sense in enumerate((1.0, -1.0)):
            for n, share in enumerate(self.shares):
                vectors = []
                for m, part in enumerate(self.d_shares[n]):
                    # the shaft slows down: which sign comes first takes turns
                    first = 1.0 if (k + n + m) % 2 else -1.0
                    vectors += [(first * part * self.i_d_a, 0.0), (-first * part * self.i_d_a, 0.0)]
                if n in self.q_at:
                    # one sign first both ways: where it accelerates, the two leave the speed where it was. Not in both:
                    # with both at one speed the half width of psi_f was 6.7 % instead of 0.2 % (seed 70189)
                    vectors += [(0.0, self.i_q_a), (0.0, -self.i_q_a)]
                found.append((sense * share / self.shares[-1] * self.omega_max_rad_s, vectors))
        return found


@dataclass(frozen=True, slots=True)
class SteadyLoop:
    """Current loop of the run."""

    K_p_v_per_a: tuple[float, float]
    K_i_v_per_as: tuple[float, float]
    """Gains of the d and the q axis."""
    settle_s: float
    """Time from a change of sign of i_d to steady currents (s)."""


def steady_loop(
    R_ohm: float, L_h: tuple[float, float], V_dead_v: float, i_least_a: float, period_s: float, alpha_rad_s: float
) -> SteadyLoop:
    """Return a loop that is steady soon after i_d changed its sign, whatever the inverter's error takes.

    On a turning machine the error is 4/pi V_dead along the current, a resistance r = 4/pi V_dead/i_d for what is across
    it. With K_p = alpha L and K_i = alpha^2 L/4 the integrator turns the error's sign in 2 r/K_i, then i_q comes to
    rest with (K_p + r)/K_i; four of those are waited for: 16/alpha + 24 r/(alpha^2 L). The bandwidth follows from it.
    At 120 Hz, i_d of drives whose error takes more than 3 R I hung at zero for up to 70 ms.

    Parameters
    ----------
    R_ohm : float
        Loop resistance (ohm).
    L_h : (float, float)
        Rough inductances (H).
    V_dead_v : float
        Plateau of the inverter's error (V).
    i_least_a : float
        Smallest d current of the run (A).
    period_s : float
        Control period (s).
    alpha_rad_s : float
        Least bandwidth (rad/s).
    """
    r = 4.0 / math.pi * max(0.0, V_dead_v) / (i_least_a * min(L_h))
    needed = (8.0 + math.sqrt(64.0 + 24.0 * r * SETTLE_S)) / SETTLE_S
    alpha = max(alpha_rad_s, min(needed, 1.0 / (LOOP_PERIODS * period_s)))
    return SteadyLoop(
        (alpha * L_h[0], alpha * L_h[1]),
        (max(alpha * R_ohm, 0.25 * alpha**2 * L_h[0]), max(alpha * R_ohm, 0.25 * alpha**2 * L_h[1])),
        min(SETTLE_MOST_S, max(SETTLE_S, 16.0 / alpha + 24.0 * r / alpha**2)),
    )


Rows = list[dict[str, float]]


def coast_through(drive: Drive, plan: SpeedPlan, pole_pairs: int) -> Rows:
    """Hold the vectors at every speed and return one row of means for each.

    The d current of an old angle makes torque: what a pair of both signs shows of it is taken out of the pairs after
    it, where the shaft is light. One of 5 ms to its rated speed, whose angle was 20 us old, ran 28 % too fast.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    rows: Rows = []
    before, held, lead = 0.0, math.inf, 0.0
    for speed, vectors in plan.stations():
        omega_e = speed * pole_pairs
        controlled, lead = False, lead * (speed * before > 0.0)
        for k, (i_d, i_q) in enumerate(vectors):
            if not controlled or abs(rows[-1]["omega_second_rad_s"]) < plan.slowest * abs(omega_e):
                held = reach_and_hold(drive, plan, speed, before, pole_pairs, coasts=plan.quick and held == 0.0)
                controlled, settle_s, before = True, plan.first_s, speed
            drive.command_current(i_d, i_q + held + lead * i_d)
            drive.wait(settle_s)
            settle_s = plan.settle_s
            rows.append(_window(drive, _half_window(drive, plan, speed, pole_pairs, i_q != 0.0)))
            if (held or lead) and i_d and k % 2:
                first, second = ((r["omega_second_rad_s"] - r["omega_first_rad_s"]) / r["half_s"] for r in rows[-2:])
                lead += (first - second) / (2.0 * i_d * plan.per_ampere_rad_s2 * pole_pairs)
                lead = min(max(lead, -LEAD_MOST), LEAD_MOST)
    drive.command_speed(0.0)
    return rows


def reach_and_hold(
    drive: Drive, plan: SpeedPlan, speed: float, before: float, pole_pairs: int, *, coasts: bool = False
) -> float:
    """Bring the shaft to a mechanical speed (rad/s) from the one ``before``; return the q current that keeps it (A).

    0 where the shaft coasts through a window well enough without, which is not looked for where it ``coasts``.
    """
    drive.command_speed(speed)
    omega_e = speed * pole_pairs
    ramp_s = min(RAMP_MOST_S, RAMP_DOUBT * abs(speed - before) / plan.acceleration_rad_s2)
    look_s, band = QUICK_LOOK_S if plan.quick else LOOK_S, (QUICK_COAST_BAND if coasts else COAST_BAND) * abs(omega_e)
    limit_s = COAST_LIMIT_S + ramp_s
    reach(drive, omega_e, limit_s=limit_s, band_rad_s=band, look_s=look_s, looks=1 if coasts else LOOKS)
    return 0.0 if coasts else _holding(drive, plan, speed, pole_pairs)


def _holding(drive: Drive, plan: SpeedPlan, speed: float, pole_pairs: int) -> float:
    """Return the q current that keeps the speed (A); 0 where the shaft coasts through a window well enough without."""
    turn_s = 2.0 * math.pi / abs(speed * pole_pairs)
    window_s = plan.settle_s + 2.0 * drive.period_s * _half_window(drive, plan, speed, pole_pairs, False)
    i_q = 0.0
    for least_s in (HOLD_S, HELD_S):
        periods = round(max(1, math.ceil(least_s / turn_s)) * turn_s / drive.period_s)
        i_q = drive.average(("i_q_a",), periods)["i_q_a"]
        if plan.per_ampere_rad_s2 * abs(i_q) * window_s <= COAST_LOSS * abs(speed):
            return 0.0
    return i_q


def repeat_fastest_pair(drive: Drive, speeds: Trace, pole_pairs: int) -> Rows:
    """Hold the vectors of :func:`fastest_pair` once more, with the q current that kept the speed; return their rows.

    Without that current a shaft of a tenth of the usual inertia stopped, and its magnet had "changed by 200 %". The
    drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    rows: Rows = []
    omega_e = float(speeds["omega_first_rad_s"][fastest_pair(speeds)[0]])
    for k in fastest_pair(speeds):
        if not rows or abs(rows[-1]["omega_second_rad_s"]) < SLOWEST * abs(omega_e):
            drive.command_speed(omega_e / pole_pairs)
            reach(drive, omega_e, limit_s=COAST_LIMIT_S + RAMP_MOST_S, band_rad_s=COAST_BAND * abs(omega_e))
        drive.command_current(float(speeds["i_d_a"][k]), float(speeds["i_q_a"][k]))
        drive.wait(SETTLE_MOST_S)
        rows.append(_window(drive, round(float(speeds["half_s"][k]) / drive.period_s)))
    drive.command_speed(0.0)
    return rows


def _window(drive: Drive, half: int) -> dict[str, float]:
    """Return the means over two halves of a window, one after the other."""
    first, second, _ = drive.halves(MEANS, half)
    row = {name: 0.5 * (first[name] + second[name]) for name in MEANS if name != "flags"}
    for name in ("i_d", "i_q"):
        row[f"{name}_first_a"], row[f"{name}_second_a"] = first[f"{name}_a"], second[f"{name}_a"]
    row["omega_first_rad_s"], row["omega_second_rad_s"] = first["omega_e_rad_s"], second["omega_e_rad_s"]
    row["half_s"] = half * drive.period_s
    row["flagged"] = float(first["flags"] + second["flags"] > 0.0)  # a mean of flag words: any bit counts
    return row


def speeds_trace(rows: Rows, facts: Mapping[str, float]) -> Trace:
    """Return the rows as one trace with facts about the run; its time base counts them."""
    return table(rows, [float(k) for k in range(len(rows))], **facts)


def reach(
    drive: Drive,
    omega_e_rad_s: float,
    *,
    limit_s: float = REACH_LIMIT_S,
    band_rad_s: float = 0.0,
    look_s: float = LOOK_S,
    looks: int = LOOKS,
) -> float:
    """Wait until the speed has arrived within a band, seen so often, or the limit is over; return the time (s)."""
    periods = max(1, round(0.5 * look_s / drive.period_s))
    waited = 0.0
    seen = 0
    while waited < limit_s and seen < looks:
        drive.wait(0.5 * look_s)
        omega = drive.average(("omega_e_rad_s",), periods)["omega_e_rad_s"]
        waited += look_s
        seen = seen + 1 if abs(omega - omega_e_rad_s) <= max(band_rad_s, NEAR * abs(omega_e_rad_s)) else 0
    return waited


def _half_window(drive: Drive, plan: SpeedPlan, speed: float, pole_pairs: int, accelerates: bool) -> int:
    """Periods of half a window: in all whole turns, so that what repeats per turn averages out."""
    turn_s, least_s = 2.0 * math.pi / abs(speed), plan.window_s
    if accelerates or turn_s > plan.longest_s:
        turn_s, least_s = turn_s / pole_pairs, plan.q_window_s if accelerates else 0.5 * plan.longest_s
    turns = max(1, math.ceil(least_s / turn_s))
    return max(64, round(0.5 * turns * turn_s / drive.period_s))


PUSH_SIGNALS = ("i_d_a", "i_q_a", "u_d_v", "u_q_v", "omega_e_rad_s", "theta_m_rad", "flags")
SHORT_PUSH_SIGNALS = ("i_q_a", "omega_e_rad_s")
"""Of a push that only looks for the shaft's answer: 256 rows of all signals take 0.15 s of the bus, of these 0.04 s."""


def push_and_record(
    drive: Drive,
    i_q_a: float,
    samples: int,
    decimation: int,
    abort_speed_rad_s: float,
    signals: Sequence[str] = PUSH_SIGNALS,
) -> Trace:
    """Apply a q current for the length of a record; returns the signals of the acceleration.

    The drive ends the push by itself at the abort speed (electrical rad/s).
    """
    excitation = Excitation(
        shape=Shape.STEP,
        point=Injection.I_Q,
        amplitude=i_q_a,
        duration_s=samples * decimation * drive.period_s,
        abort_speed_rad_s=abort_speed_rad_s,
    )
    drive.command_current(0.0, 0.0)  # the frame follows the rotor again, whatever was held before
    return readable(drive.record(signals, samples, decimation=decimation, excitation=excitation), i_command_a=i_q_a)


EMF_SHARES = (0.45, 0.7, 1.0)
"""Of the largest speed of the flux run, both directions."""
EMF_SIGNALS = ("u_d_v", "u_q_v", "i_d_a", "i_q_a", "theta_m_rad", "flags")
EMF_ROWS = 1000
"""Most rows of a record, which the bus takes some 0.4 s for."""
ROWS_PER_TURN = 50
"""Least rows of an electrical turn: four of the 13th harmonic's period."""
TURNS_LEAST = 4
"""Least electrical turns of a record; of a machine with more pole pairs one turn of the shaft, over which the errors of
an encoder that is off centre average out."""


def record_turns(drive: Drive, plan: SpeedPlan, pole_pairs: int, keep: Callable[[Trace], None]) -> None:
    """Record at every speed and with both signs of the d current; each trace is handed over as soon as it is there.

    The drive is enabled on entry with a speed controller that holds the machine; it is asked for standstill on return.
    """
    before = 0.0
    for sense in (1.0, -1.0):
        for share in EMF_SHARES:
            speed = sense * share * plan.omega_max_rad_s
            for sign in (1.0, -1.0):
                held = reach_and_hold(drive, plan, speed, before, pole_pairs)
                before = speed
                drive.command_current(sign * plan.i_d_a, held)
                drive.wait(plan.first_s)
                samples, decimation = rows_of(2.0 * math.pi / abs(speed * pole_pairs) / drive.period_s, pole_pairs)
                keep(readable(drive.record(EMF_SIGNALS, samples, decimation=decimation)))
    drive.command_speed(0.0)


def rows_of(turn_periods: float, pole_pairs: int) -> tuple[int, int]:
    """Return samples and decimation of a record; an electrical turn is so many control periods long."""
    turns = max(TURNS_LEAST, pole_pairs)
    decimation = math.ceil(turns * turn_periods / EMF_ROWS)
    if turn_periods < ROWS_PER_TURN * decimation:
        decimation = max(1, int(turn_periods / ROWS_PER_TURN))
        turns = max(1, int(EMF_ROWS * decimation / turn_periods))
    return min(EMF_ROWS, math.ceil(turns * turn_periods / decimation)), decimation
