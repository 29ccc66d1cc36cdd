# SPDX-License-Identifier: MIT
"""The flux linkage's part of an identification: what turns the shaft, from the first push to coasting with current."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.design.loops.current_loop import imc
from pmsmtool.drive.motion_objects import few_counts
from pmsmtool.drive.port import Drive
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.resistance import ResistanceResult
from pmsmtool.experiments import speed_run
from pmsmtool.experiments.mechanics_run import FIRST_S, FIRST_SHARE
from pmsmtool.experiments.speed_run import SpeedPlan
from pmsmtool.identification.emf_harmonics import TRACE as EMF_TRACE
from pmsmtool.machine.torque import torque_per_ampere
from pmsmtool.measurement.effort import ALL_SPEEDS, SpeedEffort
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.mechanics import numbered
from pmsmtool.refusals import refuse
from pmsmtool.trace import Trace
from pmsmtool.units import rpm_from_rad_s

EMF_SHARE = 0.8
"""Largest speed of the flux run: back-emf of this share of the largest voltage."""
RUN_BANDWIDTH_RAD_S = 2.0 * math.pi * 120.0
"""Current bandwidth of the runs that turn the shaft, at most a fifteenth of the sampling rate; the flux run may have
more."""
PUSH_SHARE = 0.5
PUSH_SPEED_SHARE = 0.12
PUSH_TAIL = 16
"""Last part of a push whose means count: one of so many."""
ERROR_ANGLES = 48
"""Angles of a turn over which the inverter's error of a push is averaged. A light shaft gets a current below the
curve's knee; the whole plateau taken from its voltage left no flux linkage, and psi_f was refused."""
PUSH_END_SHARE, SLOW_PUSH_SHARE = 0.9, 0.5
"""Speed at which the drive ends a push by itself, of the speed limit; the speed of one that would get there."""
PUSH_REACHED = 0.4
"""Part of its speed that a push must get to: beside a dead time of 8 R I the current came in the last eighth of it, and
a flux linkage of half its value, told at 1 % of the speed limit, led the run into the voltage limit."""
SECOND_PUSH, FAR = (1.5, 0.6), 0.6
"""Current of the push that tells friction, of the first one that the shaft answered: less where that one went far, of
what the pushes aim at."""
SECOND_TRIES, APART = 4, 0.2
"""How often such a push is tried, and the least difference of what flowed, of the first one's. A light shaft that
leaves its cogging drives the current back: three times as fast by 1 % more of it, J was 20 000 times too small."""
PUSH_TRIES, PUSH_FLOWED = 6, 0.5
"""Pushes in either direction, each of twice the time of the one before, or, where on average that
share of a current flowed that may be larger, of twice the current: a light shaft stayed in its cogging, at any time."""
GROWTH, LITTLE_SHARE, GROWN_SHARE, PUSHES_MOST = (2.0, 1.5), 0.1, 0.55, 13
"""By what the first current grows until the shaft answers, below and above a share of the test current, up to which it
does, and how often. Twice a current that friction of 37 % of the rated torque held brought a shaft to its speed limit.
"""
PUSH_MOST_S = 20.0
"""Longest of them: a load of 26 rotors, 102 s from its rated speed, answers within 18 s, friction of 6 % included."""
NO_MAGNET_RATIO = 1.2
"""L_d over L_q from which on a rotor that followed a vector, and no q current turns, has no magnets: a vector pulls the
axis of the larger inductance onto itself. Machines with magnets have 0.2 to 1."""
SPEED_LOOP_RAD_S = 25.0
RUN_I_D_SHARE, RUN_I_D_MOST = 0.45, 0.8
"""Largest d current of the flux run, of the test current: a third of it is still beyond the inverter's knee."""
RUN_I_D_RIPPLES = 2.0
"""The same in amplitudes of the ripple, whose part of the inverter's error falls with the d current: three drives whose
ripple is 0.23 to 0.4 of the test current had psi_f -0.50, -0.40 and 0.52 % off with 0.45 of it."""
SATURATED = 1.5
"""Largest ratio of the chord of psi_d over the run's i_d to the rough L_d, which is that of a saturated bias."""
RUN_I_Q_SPEED_SHARE = 0.15
RUN_I_Q_LATE_S = 0.025
"""A q current of the flux run may change the speed by this share of the largest until its window is over and the bus
has answered, this late. Without the time in which currents settle, which a large dead time makes three times as long,
one of 1005 drives was braked to a ninth of its speed, by half in one window (seed 70189)."""
REACTANCE_SHARE = 0.25
"""Voltage that the accelerating current may need at the largest speed, of the largest voltage."""
RAMP_SHARES, RAMP_S = (0.5, 0.8), 15.0
"""Accelerating current of the flux run, of the test current, and that of a heavy shaft, which needs longer than so many
seconds to its largest speed. Two of 40 times the rotor's inertia took 30 to 60 s, longer than anything waited: they did
not come to rest before their inertia was measured, and a third used up the run's 600 s."""
QUICK_RAMP_SHARE, TORQUE_OVER = 0.65, 1.6
"""Accelerating current where an accuracy is enough, and the speed controller's largest torque, of that of the ramp:
together the test current. With 0.8 an elastic shaft took it past the envelope (seed 733104)."""
COUNT_SHARE = 0.3
"""Current that a count of the encoder may cause in the flux run, of the test current (1). 1024 counts at 24 and 45 pole
pairs caused 0.6 and 2.8 of it, and the run ended at its current limit."""
SLOW_RUN_RAD_S = 2.0 * math.pi / 0.05
"""Speed below which the flux run is not slowed down: a turn there is as long as a window."""
REST_SHARE, QUICK_REST_SHARE = 0.02, 0.05
"""Speed that counts as standstill, of the largest of the flux run; where the pulses wait for it once more."""


def within_counts(
    limits: Limits, omega_rad_s: float, psi_wb: float, pole_pairs: int, R_ohm: float, L_h: float, period_s: float
) -> tuple[float, float]:
    """Return largest mechanical speed and least current bandwidth (rad/s) beside the steps of a coarse encoder.

    An angle that is half a count old turns the voltage against the back-EMF: v = pi p/N psi p omega. Near a whole
    number of counts per control period that drifts slowly, and only the loop keeps its current down, v/(R + alpha L);
    of n < 1 counts per period the drifting part is n v.
    """
    alpha = min(RUN_BANDWIDTH_RAD_S, 1.0 / (15.0 * period_s))
    per_rad_s = math.pi * pole_pairs**2 * psi_wb / limits.counts_per_turn
    per_period_s = limits.counts_per_turn * period_s / (2.0 * math.pi)
    i_most = COUNT_SHARE * limits.I_test_apk
    needed = (per_rad_s * omega_rad_s * min(1.0, per_period_s * omega_rad_s) / i_most - R_ohm) / L_h
    if needed <= alpha:
        return omega_rad_s, alpha
    alpha = min(needed, 1.0 / (speed_run.LOOP_PERIODS * period_s))
    most_rad_s = i_most * (R_ohm + alpha * L_h) / per_rad_s
    return min(omega_rad_s, max(most_rad_s, math.sqrt(most_rad_s / per_period_s))), alpha


def q_current_s(settle_s: float) -> float:
    """Return how long a q current of the flux run accelerates the shaft (s)."""
    return settle_s + speed_run.Q_WINDOW_S + RUN_I_Q_LATE_S


def ramp_of(
    limits: Limits, omega_rad_s: float, i_most_a: float, torque_per_a: float, J_kgm2: float, *, quick: bool = False
) -> tuple[float, float]:
    """Return accelerating current (A) and largest mechanical speed (rad/s) of the flux run.

    A heavy shaft gets more current, and turns no faster than that brings it to within :data:`RAMP_S`.

    Parameters
    ----------
    limits : Limits
        What may be used.
    omega_rad_s, i_most_a : float
        Largest speed, and the current that the voltage leaves there.
    torque_per_a, J_kgm2 : float
        Torque per q current (N m/A), and inertia.
    quick : bool
        Whether a shaft that is not heavy gets more current, too.
    """
    per_ampere = torque_per_a / J_kgm2
    heavy = omega_rad_s > RAMP_S * per_ampere * RAMP_SHARES[0] * limits.I_test_apk
    share = QUICK_RAMP_SHARE if quick and not heavy else RAMP_SHARES[heavy]
    i_run = min(share * limits.I_test_apk, i_most_a)
    i_run, omega_rad_s = limits.within_supply(i_run, omega_rad_s, torque_per_a)
    return i_run, min(omega_rad_s, RAMP_S * per_ampere * i_run)


def run_d_current(limits: Limits, L_h: tuple[float, float], period_s: float) -> float:
    """Return the largest d current of the flux run (A), from rough inductances (H)."""
    ripple_a = math.sqrt(3.0) * limits.V_max_v * period_s / (8.0 * max(L_h))
    wanted = max(RUN_I_D_SHARE * limits.I_test_apk, RUN_I_D_RIPPLES * ripple_a)
    return min(wanted, RUN_I_D_MOST * limits.I_test_apk)


@dataclass(frozen=True, slots=True)
class SpeedStage:
    """The pushes and the flux run on one drive: how much is collected, and the fields of ``measure.Measurement``."""

    drive: Drive
    limits: Limits
    keep: Callable[[str, Trace], None]
    say: Callable[[str], None]
    effort: SpeedEffort = ALL_SPEEDS
    show_limit: Callable[[float, int], None] = lambda largest_rad_s, pole_pairs: None

    def measure(
        self,
        resistance: ResistanceResult,
        encoder: EncoderResult,
        L: tuple[float, float],
        enough: Callable[[], bool] = lambda: True,
    ) -> SpeedPlan:
        """Push the shaft, then coast with current through the speeds, under control by what was found so far.

        Returns what was held at which speeds. Where what was kept is not ``enough``, the coasting is repeated with all
        of the effort.
        """
        pole_pairs = round(encoder.pole_pairs.value)
        alpha = min(RUN_BANDWIDTH_RAD_S, 1.0 / (15.0 * self.drive.period_s))
        d, q = (imc(resistance.R_measured.value, inductance, alpha) for inductance in L)
        self.drive.disable()
        self.drive.write(
            {
                "motor.L_d_h": L[0],
                "motor.L_q_h": L[1],
                "motor.L_d_app_h": L[0],
                "motor.L_q_app_h": L[1],
                "current.K_p_d_v_per_a": d.K_p,
                "current.K_i_d_v_per_as": d.K_i,
                "current.K_p_q_v_per_a": q.K_p,
                "current.K_i_q_v_per_as": q.K_i,
            }
        )
        self.drive.enable()
        psi, J = self._pushes(resistance, pole_pairs, L)
        plan = self._speeds(psi, J, pole_pairs, L, resistance.V_dead_v)
        if self.effort == ALL_SPEEDS or enough():
            return plan
        self.say("  the accuracy asked for is not reached: all speeds")
        return replace(self, effort=ALL_SPEEDS)._speeds(psi, J, pole_pairs, L, resistance.V_dead_v)

    def record_harmonics(self, plan: SpeedPlan) -> None:
        """Record voltages and currents over turns at the speeds of the flux run, whose gains the drive holds."""
        self.say(
            f"harmonics of the back-EMF: records at {len(speed_run.EMF_SHARES)} speeds up to "
            f"{rpm_from_rad_s(plan.omega_max_rad_s):.0f} rpm, both directions, i_d of +-{plan.i_d_a:.3g} A"
        )
        delay = {"delay_periods": self.drive.read("inverter.delay_periods")}
        keep_part = numbered(self.drive, EMF_TRACE, self.keep)
        pole_pairs = round(self.drive.read("motor.pole_pairs"))
        speed_run.record_turns(
            self.drive, plan, pole_pairs, lambda trace: keep_part(replace(trace, meta={**trace.meta, **delay}))
        )
        speed_run.reach(self.drive, 0.0, limit_s=1.0, band_rad_s=REST_SHARE * plan.omega_max_rad_s * pole_pairs)

    def _pushes(self, resistance: ResistanceResult, pole_pairs: int, L: tuple[float, float]) -> tuple[float, float]:
        """Push the rotor there and back; return flux linkage (Wb) and inertia (kg m2), good for a speed controller."""
        limits, samples = self.limits, self.effort.push_samples
        self.say("flux and inertia, first estimate: short torque pulses both ways")
        target = PUSH_SPEED_SHARE * limits.omega_max_rad_s
        rate = self._acceleration_per_ampere(target, pole_pairs, L)
        current = PUSH_SHARE * limits.I_test_apk
        target = min(target, rate * current * RAMP_S)  # a heavy shaft gets little further in the flux run, too
        decimation = max(1, round(target / (rate * current) / (samples * self.drive.period_s)))
        reached = rate * current * samples * decimation * self.drive.period_s
        if reached > PUSH_END_SHARE * limits.omega_max_rad_s:  # within the shortest record
            current *= SLOW_PUSH_SHARE * limits.omega_max_rad_s / reached
            reached = SLOW_PUSH_SHARE * limits.omega_max_rad_s
        tail = slice(-(samples // PUSH_TAIL), None)
        for _ in range(PUSH_TRIES):
            pushes = [self._push(sign * current, samples, decimation, pole_pairs) for sign in (1.0, -1.0)]
            fastest = max(pushes, key=lambda trace: float(abs(trace["omega_e_rad_s"][tail].mean())))
            omega = float(fastest["omega_e_rad_s"][tail].mean())
            if abs(omega) >= PUSH_REACHED * reached * pole_pairs:
                break
            flowed = abs(float(fastest["i_q_a"].mean()))
            if flowed > PUSH_FLOWED * current and current < PUSH_SHARE * limits.I_test_apk:
                current = min(2.0 * current, PUSH_SHARE * limits.I_test_apk)
            else:
                decimation *= 2
        for k, push in enumerate(pushes):
            self.keep(f"push_{k}", push)
        gained, shown = (float(one[tail].mean()) for one in self._gained(fastest))
        omega += rate * pole_pairs * (gained - shown)
        i_q = float(fastest["i_q_a"][tail].mean())
        around = np.linspace(0.0, 2.0 * math.pi, ERROR_ANGLES, endpoint=False)
        error = float(np.mean(resistance.curve.error_dq_v(np.zeros_like(around), np.full_like(around, i_q), around)[1]))
        psi = (float(fastest["u_q_v"][tail].mean()) - resistance.R_measured.value * i_q - error) / omega
        if not psi > 0.0:
            raise refuse(
                "E_EXCITATION",
                f"the voltage at {omega:.3g} rad/s shows no flux linkage ({psi:.3g} Wb)",
                stage="speed run",
                likely="friction or cogging held the shaft, or the dead time the current of the torque pulses",
                hint="allow more current by --i-max, or a higher --speed-max",
            )
        return psi, torque_per_ampere(pole_pairs, psi) / rate

    def _acceleration_per_ampere(self, target: float, pole_pairs: int, L: tuple[float, float]) -> float:
        """Return the acceleration per ampere beyond friction (rad/s2/A), from pushes that grow until the shaft answers.

        A second push, of another current, tells what friction took of both. Raises IdentificationError:
        ``E_EXCITATION``, or ``E_NO_MAGNET`` by the inductances ``L``: no push moves the shaft.
        """
        current, seconds = FIRST_SHARE * self.limits.I_test_apk, FIRST_S
        for _ in range(PUSHES_MOST):
            change, gained = self._there_and_back(current, seconds, pole_pairs)
            if change > self.effort.answer_share * target:
                times = SECOND_PUSH[0 if change < FAR * target else 1]
                for _ in range(SECOND_TRIES):
                    second = min(times * current, self.limits.I_test_apk)
                    other, gained_then = self._there_and_back(second, seconds, pole_pairs)
                    if abs(gained_then - gained) > APART * gained:  # friction takes some of it, or nothing
                        return max((other - change) / (gained_then - gained), change / gained)
                    times = max(1.0, times) * SECOND_PUSH[0]
                return change / gained
            if current < GROWN_SHARE * self.limits.I_test_apk:
                current *= GROWTH[current > LITTLE_SHARE * self.limits.I_test_apk]
            elif seconds < PUSH_MOST_S:
                seconds = min(PUSH_MOST_S, seconds * min(4.0, 0.5 * target / max(change, 1e-3 * target)))
            else:
                break
        if L[0] > NO_MAGNET_RATIO * L[1]:
            raise refuse(
                "E_NO_MAGNET",
                f"{current:.3g} A of q current do not turn the rotor that followed a vector; "
                f"L_d is {L[0] / L[1]:.2g} times L_q",
                stage="speed run",
            )
        raise refuse(
            "E_EXCITATION",
            "the shaft does not move under a torque pulse",
            stage="speed run",
            likely="a locked shaft, a brake that is closed, or an encoder that does not count",
        )

    def _there_and_back(self, i_q_a: float, seconds: float, pole_pairs: int) -> tuple[float, float]:
        """Push and pull; return the speed (rad/s) that the push added, and the integral of its current (A s).

        The current is the one that flowed: a slow loop, or a dead time, lets it rise late.
        """
        samples = self.effort.answer_samples
        decimation = max(1, round(seconds / (samples * self.drive.period_s)))
        push, _ = (
            self._push(sign * i_q_a, samples, decimation, pole_pairs, speed_run.SHORT_PUSH_SIGNALS)
            for sign in (1.0, -1.0)
        )
        return abs(_change(push["omega_e_rad_s"]) / pole_pairs), abs(_change(self._gained(push)[1]))

    def _gained(self, push: Trace) -> tuple[Array, Array]:
        """Return the integral of a push's q current (A s), and what the drive's speed estimate shows of it.

        The estimate is a double pole, which lags behind a light shaft by as much as its push takes.
        """
        gained = np.cumsum(push["i_q_a"]) * push.period_s
        follow = -math.expm1(-self.drive.read("encoder.pll_bandwidth_rad_s") * push.period_s)
        shown, first, second = np.empty_like(gained), 0.0, 0.0
        for k, value in enumerate(gained):
            first += follow * (value - first)
            second += follow * (first - second)
            shown[k] = second
        return gained, shown

    def _push(
        self, i_q_a: float, samples: int, decimation: int, pole_pairs: int,
        signals: Sequence[str] = speed_run.PUSH_SIGNALS,
    ) -> Trace:  # fmt: skip
        omega_e = PUSH_END_SHARE * pole_pairs * self.limits.omega_max_rad_s
        return speed_run.push_and_record(self.drive, i_q_a, samples, decimation, omega_e, signals)

    def _speeds(self, psi: float, J: float, pole_pairs: int, L: tuple[float, float], V_dead_v: float) -> SpeedPlan:
        limits = self.limits
        run_i_d = run_d_current(limits, L, self.drive.period_s)
        flux = psi + SATURATED * L[0] * run_i_d
        largest = min(limits.omega_max_rad_s / 1.1, EMF_SHARE * limits.V_max_v / (flux * pole_pairs))
        # a slower run takes less time to its speeds, and more for the turns of its windows
        largest = min(largest, max(self.effort.speed_share * largest, SLOW_RUN_RAD_S))
        # the accelerating current must leave voltage for itself: omega_e L_q i_q stands beside the back-emf
        i_most = REACTANCE_SHARE * limits.V_max_v / (largest * pole_pairs * max(L))
        R = self.drive.read("motor.R_s_ohm")
        free, period_s = largest, self.drive.period_s
        largest, alpha = within_counts(limits, free, psi, pole_pairs, R, min(L), period_s)
        if largest < free:
            why = few_counts(limits.counts_per_turn, pole_pairs) or "the steps of the encoder disturb the current"
            self.say(f"  {why}: at most {rpm_from_rad_s(largest):.0f} rpm instead of {rpm_from_rad_s(free):.0f}")
        quick = self.effort.quick
        i_run, largest = ramp_of(limits, largest, i_most, torque_per_ampere(pole_pairs, psi), J, quick=quick)
        per_ampere = torque_per_ampere(pole_pairs, psi) / J
        # a current that is slow because the inverter's error is steep would not be steady in its window
        loop = speed_run.steady_loop(R, L, V_dead_v, min(map(min, self.effort.d_shares)) * run_i_d, period_s, alpha)
        i_q = min(0.5 * i_run, RUN_I_Q_SPEED_SHARE * largest / (q_current_s(loop.settle_s) * per_ampere))
        self._off_and_write(
            {
                "current.K_p_d_v_per_a": loop.K_p_v_per_a[0],
                "current.K_p_q_v_per_a": loop.K_p_v_per_a[1],
                "current.K_i_d_v_per_as": loop.K_i_v_per_as[0],
                "current.K_i_q_v_per_as": loop.K_i_v_per_as[1],
                "motor.psi_f_wb": psi,
                "motor.J_kgm2": J,
                "current.options": 7.0,
                "speed.K_p_nms_per_rad": 2.0 * SPEED_LOOP_RAD_S * J,
                "speed.K_i_nm_per_rad": SPEED_LOOP_RAD_S**2 * J,
                "speed.tau_max_nm": J * per_ampere * min(TORQUE_OVER * i_run, self.limits.I_test_apk),
                "speed.acceleration_rpm_per_s": rpm_from_rad_s(per_ampere * i_run),
            }
        )
        self.show_limit(largest, pole_pairs)
        self.drive.enable()
        fastest_rpm = rpm_from_rad_s(largest)
        self.say(f"psi_f and fine offset: coasting from up to {fastest_rpm:.0f} rpm, i_d up to {run_i_d:.3g} A")
        plan = SpeedPlan(
            largest,
            run_i_d,
            i_q,
            settle_s=loop.settle_s,
            first_s=2.0 * loop.settle_s,
            window_s=self.effort.window_s,
            longest_s=self.effort.longest_s,
            per_ampere_rad_s2=per_ampere,
            acceleration_rad_s2=per_ampere * i_run,
            shares=self.effort.shares,
            d_shares=self.effort.d_shares,
            q_at=self.effort.q_at,
            quick=quick,
        )
        rows = speed_run.coast_through(self.drive, plan, pole_pairs)
        look_s, rest = (speed_run.QUICK_LOOK_S, QUICK_REST_SHARE) if quick else (speed_run.LOOK_S, REST_SHARE)
        speed_run.reach(self.drive, 0.0, limit_s=1.0, band_rad_s=rest * largest * pole_pairs, look_s=look_s)
        lag_s = 2.0 / self.drive.read("encoder.pll_bandwidth_rad_s")  # its poles are a double one
        facts = {"pole_pairs": pole_pairs, "U_dc_v": math.sqrt(3.0) * limits.V_max_v, "speed_lag_s": lag_s}
        facts["delay_periods"] = self.drive.read("inverter.delay_periods")
        self.keep("speeds", speed_run.speeds_trace(rows, facts))
        return plan

    def _off_and_write(self, values: Mapping[str, float]) -> None:
        self.drive.disable()
        self.drive.write(values)


def _change(values: Array) -> float:
    """Return by how much a push changed a value, without the scatter of a sample."""
    return float(values[-16:].mean() - values[:16].mean())
