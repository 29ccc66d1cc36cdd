# SPDX-License-Identifier: MIT
"""``map learn``, its third part: change a gain of the current loops, and see how they follow what the speed loop asks.

The drive stays in its own velocity mode: its speed loop keeps the speed also where this program dies, which no torque
mode does. The speed rises on a ramp through zero, so that the current keeps its sign; small steps of the reference on
it are steps of the asked current. The drive's recorder takes asked and flowing current at the loop's rate.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import GuardedDrive
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.drive.recorders.choice import recorder_of
from pmsmtool.drive.recorders.commanded import CommandedRecorder
from pmsmtool.drive.speed_loop_drive import SpeedLoopDrive
from pmsmtool.drive_maps.recorder_map import UNSCALED
from pmsmtool.errors import (
    BusError,
    IdentificationError,
    LimitExceeded,
    NotAvailable,
    SafetyRefusal,
    SdoAbort,
)
from pmsmtool.identification.current_loop_response import CurrentLoop, CurrentSteps, Winding, fit_current_loop
from pmsmtool.identification.learned_gains import Learned, Observation, current_basis, gain_scale, integral_scale
from pmsmtool.identification.speed_loop_response import SpeedLoop, phase_margin_rad
from pmsmtool.measurement.changed_gains import (
    DOWN,
    GainObject,
    Put,
    changing,
    gain_object,
    named_addresses,
    refuse_unsafe,
    while_changed,
)
from pmsmtool.measurement.learn_gains import (
    INTEGRAL_DOWN,
    LEAST_MARGIN_DOWN_RAD,
    LEAST_MARGIN_RAD,
    SETTLE_S,
    TRIP,
    high_share,
    trip_share,
)

CURRENT_GAIN, CURRENT_INTEGRAL = "current.K_p_q_v_per_a", "current.K_i_q_v_per_as"
CURRENTS = ("i_q_ref_a", "i_q_a")
OUTPUTS = (UNSCALED, "u_q_v")
"""Output of the q current loop, whatever it counts."""
SLOWEST_S = 1.0 / 4000.0
"""Longest time between two samples: slower ones do not show a current loop."""
TICK_S = 0.003
"""Time between two references of the speed: some time constants of a current loop."""
LEVELS = (0.15, 0.425, 0.7, 0.425)
"""Currents that are asked for, a tick each, of what the drive may carry: they keep their sign, so that no dead time is
in a step."""
STEP = LEVELS[1] - LEVELS[0]
LEAD_TICKS = 14
"""Ticks of even current before the recorder is started: the speed loop settles."""
START_TICKS = 7
"""Ticks that starting the recorder takes at most."""
VOLTAGE_SHARE = 0.8
"""What a step may take of the voltage that EMF and resistance leave. A step that reaches the limit lacks some voltage
for a few periods: K_p came out 4.5 % too small."""
LEAST = 0.1
"""Smallest size of the steps that voltage leaves: less shows nothing."""
RECORDS = 10
"""Records of one setting; of steps of half the size twice as many, as what the output is counted in is as large."""
UNEVEN = 0.1
"""By how much the records of one setting differ in size, so that what counts round off differs, too."""
SETTINGS = math.sqrt(2.0)
"""A scale is the mean of two settings or three: so much smaller than of one is what single records leave of it."""
FASTER = 4.0
"""Bandwidth of the current loop, over that of the speed loop, below which no gain is lowered."""
PLANT_PERIODS = 0.5
"""What the plant's own period adds to a loop's delay."""


def current_gain_objects(node: DriveNode, asked: Mapping[str, tuple[int, int] | None]) -> dict[str, GainObject]:
    """Return both gains of the current loops, where one is asked for and the recorder shows what they do; else none.

    ``asked`` has their objects by name, None where the map's is meant.
    """
    names = (CURRENT_GAIN, CURRENT_INTEGRAL)
    if not set(names) & set(asked) or recorder_of_currents(node) is None:
        return {}
    told = [asked.get(name) or next(iter(named_addresses(node.map, name)), None) for name in names]
    places = [place for place in told if place is not None and node.has(*place)]
    if len(places) < len(names):
        return {}
    try:
        return {name: gain_object(node, name, *place) for name, place in zip(names, places, strict=True)}
    except NotAvailable:
        return {}


def recorder_of_currents(node: DriveNode) -> CommandedRecorder | None:
    """Return the drive's recorder, where it takes asked and flowing current at the loop's rate; else None."""
    if node.map.staging:
        return None
    try:
        recorder = recorder_of(node, 0.0)
    except NotAvailable:
        return None
    if not isinstance(recorder, CommandedRecorder) or recorder.period_s > SLOWEST_S:
        return None
    return recorder if len(recorded_signals(recorder)) > len(CURRENTS) else None


def recorded_signals(recorder: CommandedRecorder) -> tuple[str, ...]:
    """Return asked and flowing current and the loop's output, as far as the recorder takes them."""
    known = recorder.signals
    return (*(name for name in CURRENTS if name in known), *[name for name in OUTPUTS if name in known][:1])


@dataclass(frozen=True, slots=True)
class LearnedCurrentLoop:
    """Loops with the drive's own gains, with steps of half the size, and with each gain changed (None: not changed)."""

    base: tuple[Observation, Observation]
    gain_changed: Observation | None
    integral_changed: tuple[Observation, ...]
    notes: tuple[str, ...]


def learn_current_gains(
    drive: SpeedLoopDrive,
    found: Mapping[str, GainObject],
    envelope: Envelope,
    speed_loop: SpeedLoop,
    winding: Winding,
    say: Callable[[str], None],
) -> tuple[dict[str, Learned], LimitExceeded | None]:
    """Return what one count of each current gain is worth, or why that stays unknown; the drive is as before.

    What was learned of other gains stays where this is refused: that is the reason then. A limit of the motion that
    stopped the shaft is returned beside it, for the caller to raise. Nothing where ``found`` has no such gain.

    Raises DriveTimeout, DriveFault: the drive no longer does as it is told: the voltage is off and the gains are back.
    """
    if CURRENT_GAIN not in found:
        return {}, None
    try:
        measured = learn_current_loop(
            drive, found[CURRENT_GAIN], found[CURRENT_INTEGRAL], envelope, speed_loop, winding, say
        )
    except (IdentificationError, NotAvailable, SafetyRefusal) as error:
        why = error.what.partition("\n")[0] + (f" (likely: {error.likely})" if error.likely else "")
        unknown = {name: Learned(name, None, math.inf, None, "", why) for name in (CURRENT_GAIN, CURRENT_INTEGRAL)}
        return unknown, error if isinstance(error, LimitExceeded) else None
    for note in measured.notes:
        say(note)
    basis = current_basis(winding.L_h, winding.L_std)
    base, changed = measured.base, measured.gain_changed
    return {
        CURRENT_GAIN: gain_scale(base, changed, basis, CURRENT_GAIN),
        CURRENT_INTEGRAL: integral_scale(base, changed, measured.integral_changed, basis, CURRENT_INTEGRAL),
    }, None


def learn_current_loop(
    drive: SpeedLoopDrive,
    gain: GainObject,
    integral: GainObject,
    envelope: Envelope,
    speed_loop: SpeedLoop,
    winding: Winding,
    say: Callable[[str], None],
) -> LearnedCurrentLoop:
    """Measure the current loop with the drive's own gains and with each changed; the drive is as before on return.

    ``drive`` knows the unit of its speed, and ``speed_loop`` what it does with it. Raises as ``learn_speed_loop``.
    """
    refuse_unsafe(drive.node, envelope)
    recorder = recorder_of_currents(drive.node)
    assert recorder is not None
    with changing(drive, (gain, integral), envelope, say) as (guard, put):
        drive.send_samples()
        with contextlib.ExitStack() as last:
            last.callback(drive.end_samples)
            drive.fastest_rad_s = envelope.speed_max_rad_s * trip_share(drive.node)
            last.callback(_halt, recorder)
            last.callback(guard.quick_stop)
            guard.enable()
            return _CurrentLearner(guard, drive, recorder, put, speed_loop, winding, say).run(gain, integral)


def _halt(recorder: CommandedRecorder) -> None:
    """Stop the recorder: its settings cannot be brought back while it runs."""
    with contextlib.suppress(SdoAbort, BusError):  # the bus may be what has failed
        recorder.halt()


class _CurrentLearner:
    """One run; the guard has the drive, which is enabled."""

    def __init__(
        self,
        guard: GuardedDrive,
        drive: SpeedLoopDrive,
        recorder: CommandedRecorder,
        put: Put,
        speed_loop: SpeedLoop,
        winding: Winding,
        say: Callable[[str], None],
    ) -> None:
        self.guard, self.drive, self.recorder, self.put, self.say = guard, drive, recorder, put, say
        self.speed_loop, self.winding = speed_loop, winding
        self.notes: list[str] = []
        self.size = 1.0
        self.signals = recorded_signals(recorder)
        self.rows = recorder.room(self.signals)
        self.period_s = recorder.period_s

    def run(self, gain: GainObject, integral: GainObject) -> LearnedCurrentLoop:
        """Measure everything."""
        counts = {CURRENT_GAIN: gain.counts, CURRENT_INTEGRAL: integral.counts}
        own, loop = self._observe("with the drive's own gains", 1.0, counts)
        self.size = self._within_voltage(loop)
        if self.size < 1.0:
            own, loop = self._observe(f"with {self.size:.2f} of the steps, for the voltage's limit", 1.0, counts)
        self.drive.oscillation.limit_a = TRIP * max(self.drive.oscillation.largest_a, self.drive.current_count_a)
        half, _ = self._observe("with steps of half the size", 0.5, counts, loop)
        gain_changed = self._changed(gain, DOWN, loop, (DOWN, DOWN), counts)
        integral_changed = self._changed(integral, INTEGRAL_DOWN, loop, (1.0, 1.0 / INTEGRAL_DOWN), counts)
        found = () if integral_changed is None else (integral_changed,)
        return LearnedCurrentLoop((own, half), gain_changed, found, tuple(self.notes))

    def _largest_a(self) -> float:
        """Return the current of which the levels are shares."""
        return min(self.guard.envelope.i_max_apk, self.drive.current_limit_apk, self.drive.rated_apk)

    def _within_voltage(self, loop: CurrentLoop) -> float:
        """Return the size of the steps at which the loop does not reach its voltage limit, and no less than LEAST."""
        winding, largest = self.winding, self._largest_a()
        emf = winding.emf_vs_per_rad * max(map(abs, self._reference(1.0)))
        left = VOLTAGE_SHARE * (winding.U_max_v - emf - winding.R_ohm * max(LEVELS) * largest)
        return min(1.0, max(LEAST, left / (loop.K_p_per_L * winding.L_h * STEP * largest)))

    def _reference(self, size: float) -> list[float]:
        """Return the speeds (rad/s) that ask for the levels, a tick each, on a shaft that follows them freely."""
        loop, ticks = self.speed_loop, LEAD_TICKS + START_TICKS + math.ceil(self.rows * self.period_s / TICK_S)
        per_ampere = size * self._largest_a() / abs(loop.amps_per_rad_s2)
        top = high_share(self.drive.node) * self.guard.envelope.speed_max_rad_s
        speeds, free = [], 0.0
        for k in range(ticks):
            asked = per_ampere * LEVELS[(max(k, LEAD_TICKS) - LEAD_TICKS + 1) % len(LEVELS)]
            speeds.append(free + asked / loop.K_p_per_J)
            free += asked * TICK_S
        share = min(1.0, 2.0 * top / max(speeds))
        return [share * (speed - 0.5 * max(speeds)) for speed in speeds]

    def _record(self, size: float) -> CurrentSteps:
        """Record the current while the speed rises through zero, in steps of the asked current."""
        guard, drive = self.guard, self.drive
        speeds = self._reference(size * self.size)
        guard.command_speed(-max(speeds))
        guard.wait(SETTLE_S)
        drive.starts_s = LEAD_TICKS * TICK_S
        drive.starts = lambda: self.recorder.arm(self.signals, self.rows, 1, 0, at_excitation=False)
        hold = round(TICK_S / drive.period_s)
        excitation = Excitation(Shape.BUFFER, Injection.SPEED, 0.0, hold_periods=hold, buffer=speeds)
        guard.record(("theta_m_rad", "i_q_a"), hold * len(speeds), excitation=excitation)
        guard.quick_stop()
        trace = self.recorder.fetch(self.signals, 1)
        guard.enable()
        return CurrentSteps(self.period_s, *(trace[name] for name in self.signals))

    def _observe(
        self, what: str, size: float, counts: dict[str, float], first: CurrentLoop | None = None
    ) -> tuple[Observation, CurrentLoop]:
        count = round(RECORDS / size)
        records = [self._record(size * (1.0 - UNEVEN * k / count)) for k in range(count)]
        self.guard.quick_stop()  # a fit takes longer than the drive waits for a heartbeat
        found = fit_current_loop(records, self.winding, first)
        lag_s = (found.delay + PLANT_PERIODS) * self.period_s
        loop = SpeedLoop(found.K_p_per_L, found.K_p_per_L * found.rate_per_s, lag_s, 0.0, 0.0, found.misfit)
        self.say(
            f"{what}: K_p/L {found.K_p_per_L:.4g} 1/s, K_i/K_p {found.rate_per_s:.4g} 1/s, delay "
            f"{found.delay:g} periods, left of the current {100 * found.misfit:.2g} %, of the output "
            f"{100 * found.output_misfit:.2g} %"
        )
        self.guard.enable()
        of_gain, of_integral, of_rate = (std / SETTINGS for std in found.std)
        std = of_gain, of_integral, of_rate
        seen = Observation(counts[CURRENT_GAIN], counts[CURRENT_INTEGRAL], loop, 1.0, std, None, 1.0)
        return seen, found

    def _changed(
        self, gain: GainObject, ratio: float, own: CurrentLoop, worst: tuple[float, float], counts: dict[str, float]
    ) -> Observation | None:
        """Change one gain while the voltage is off, measure, and bring it back; None where it must not be changed."""
        lag_s = (own.delay + PLANT_PERIODS) * self.period_s
        margin = min(
            phase_margin_rad(own.K_p_per_L * p, own.K_p_per_L * own.rate_per_s * i, lag_s)
            for p in (1.0, worst[0])
            for i in worst
        )
        least = LEAST_MARGIN_RAD if max(worst) > 1.0 else LEAST_MARGIN_DOWN_RAD
        if margin < least or own.K_p_per_L * min(worst) < FASTER * self.speed_loop.K_p_per_J:
            self.notes.append(
                f"{gain.name}: not changed, for the predicted phase margin is {math.degrees(margin):.0f} deg, or the "
                "current loop would be little faster than the speed loop"
            )
            return None
        return while_changed(
            gain, ratio, self.guard, self.put, self.notes,
            lambda what, new: self._observe(what, 1.0, {**counts, gain.name: new}, own)[0],
        )  # fmt: skip
