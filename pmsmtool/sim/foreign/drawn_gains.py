# SPDX-License-Identifier: MIT
"""Gains of a maker's drive as a seed draws them: what one count is worth, the form of the integral part, peak or rms.

The objects are the family's own and keep whole counts within the file's limits; what they mean is drawn, and nothing
that measures may import it. The speed filter and the sampling of the speed loop are drawn with them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from pmsmtool.sim.foreign.behind import Behind, SetUp
from pmsmtool.sim.foreign.families import Law
from pmsmtool.sim.foreign.file_rows import MakersObjects
from pmsmtool.sim.foreign.trace import MARKS as TRACE_MARKS
from pmsmtool.sim.node.factory import SET_UP_BANDWIDTH

Form = Literal["parallel", "rate", "time"]
Address = tuple[int, int]
SPEED_OBJECTS: tuple[tuple[Address, Address], ...] = (
    ((0x30A2, 1), (0x30A2, 2)),
    ((0x3210, 3), (0x3210, 4)),
    ((0x2331, 1), (0x2331, 2)),
    ((0x2381, 1), (0x2381, 2)),
    ((0x60F9, 1), (0x60F9, 2)),
)
"""Proportional and integral part of the speed loop: EPOS4, Nanotec, Faulhaber, ZeroErr; EPOS2, Copley and CiA 402."""
POSITION_OBJECTS: tuple[tuple[Address, Address | None], ...] = (
    ((0x3210, 1), (0x3210, 11)),
    ((0x2382, 1), None),
    ((0x60FB, 1), (0x60FB, 2)),
    ((0x2332, 1), None),
)
"""Position gain and feed-forward of the speed: Nanotec, ZeroErr, Copley, Faulhaber; a controller of the position has
neither."""
DERIVATIVE_OBJECT: Address = (0x2332, 2)
"""Derivative part beside the position gain of a Faulhaber. That it acts on the following error, and adds to the
reference of the speed as the gain does, is assumed: the EDS names it, and no more (rauc-lab/being MCLM3002P-CO.eds)."""
ACCELERATION_OBJECT: Address = (0x60FB, 3)
"""Acceleration that a Copley adds to the reference of its speed (CME 2 user guide, 11.7: position loop gains)."""
CURRENT_OBJECTS: tuple[Address, Address] = ((0x60F6, 1), (0x60F6, 2))
"""Proportional and integral part of the current loops, of drives whose trace shows them at loop rate: Copley."""
CURRENT_INTEGRAL_RATE = (0.5, 1.5)
"""Integral rate of a current loop, over R / L."""
SOURCE = "drawn by a seed"
BANDWIDTH_RAD_S = (25.0, 140.0)
INTEGRAL_RATE = (0.08, 0.35)
"""K_p / J, and K_i / K_p as a share of it: from a calm loop to a brisk one with 60 degrees of margin."""
POSITION_RATE = (0.15, 0.3)
"""Position gain over the bandwidth of the speed loop."""
FORWARD = (0.0, 0.5, 1.0)
"""Shares of the speed that are fed forward, where the drive has an object for it, and of J / K_p of the acceleration.
"""
DERIVATIVE = (0.0, 0.2, 0.5)
"""Shares of the speed of the error that the derivative part adds."""
FILTER_HZ = (120.0, 1000.0)
DECIMATION = (4, 20)
CURRENT_BANDWIDTH = (0.08, 0.3)
"""Bandwidth of the current loop (rad/s) times control period: a maker's tool leaves a tenth to a third."""
RMS = math.sqrt(0.5)
CURRENTS: Mapping[Address, float] = {
    (0x6075, 0): RMS, (0x2031, 0): RMS, (0x203B, 1): RMS, (0x2039, 1): RMS, (0x2039, 2): RMS,
    (0x3001, 1): 1.0, (0x3001, 2): 1.0, (0x30D1, 1): 1.0, (0x30D1, 2): 1.0, (0x30D0, 0): 1.0,
    (0x2333, 1): 1.0, (0x2333, 2): 1.0,
}  # fmt: skip
"""Currents that families keep by an assumed convention: what one ampere peak counts there."""
EPOS2_CURRENTS: tuple[Address, ...] = ((0x6410, 1), (0x6410, 2), (0x6078, 0), (0x2027, 0), (0x2030, 0), (0x2031, 0))
FAULHABER_CURRENT = (0x6078, 0)
COUNTS = (250, 20_000)
SMALL_COUNTS = (30, 200)
"""Counts a gain holds at first; where the file allows no more than a byte."""


@dataclass(frozen=True, slots=True)
class DrawnGains:
    """What a seed drew; the truth of a benchmark."""

    gain: Address
    integral: Address
    """Objects of the speed loop. (index, sub)."""
    counts: tuple[int, int]
    """What both hold at first."""
    K_p_nms_per_rad: float
    """One count of the gain (N m s/rad)."""
    integral_scale: float
    """One count of the integral part: N m/rad (parallel), 1/s (rate) or s (time)."""
    form: Form
    """Of the integral part."""
    rms: bool
    """Whether the drive's currents are rms where no source says so."""
    filter_hz: float
    decimation: int
    """Of the speed loop."""
    current_bandwidth: float
    """Of the current loop, times the control period."""
    position: Address | None = None
    forward: Address | None = None
    """Objects of the position gain and of the feed-forward of the speed. (index, sub) or None."""
    position_counts: int = 0
    forward_counts: int = 0
    """What they hold at first."""
    K_v_per_s: float = 0.0
    forward_share: float = 0.0
    """One count of either."""
    acceleration_counts: int = 0
    acceleration_ff_s: float = 0.0
    """Of the object of the acceleration: what it holds at first, and one count (s); 0: none."""
    derivative_counts: int = 0
    derivative_share: float = 0.0
    """Of the object of the derivative part: what it holds at first, and one count (speed over that of the error)."""
    current: DrawnGains | None = None
    """Of the current loops, where the drive has objects of them and a trace: V/A, and V/(A s), 1/s or s."""

    def K_i_nm_per_rad(self, gain: float, integral: float) -> float:
        """Return the integral gain that counts of both objects mean."""
        if self.form == "parallel":
            return self.integral_scale * integral
        K_p = self.K_p_nms_per_rad * gain
        rate = self.integral_scale * integral
        if self.form == "time":
            rate = 1.0 / rate if rate else 0.0
        return K_p * rate

    def laws(self, laws: Mapping[Address, Law]) -> Iterator[Law]:
        """Yield the laws of both gains, and those of the currents as drawn."""

        def set_speed_gains(behind: Behind, K_p: float, K_i: float) -> None:
            behind.set_speed_gains(K_p, K_i)  # refuses what it cannot take
            behind.position_gains.K_p, behind.position_gains.K_i = K_p, K_i

        yield from self._loop(set_speed_gains)
        if self.current is not None:
            yield from self.current._loop(Behind.set_gains)
        if self.position is not None:
            yield Law(*self.position, SOURCE, set_up=self.position_counts, act=self._act_on_position)
        if self.forward is not None:
            yield Law(*self.forward, SOURCE, set_up=self.forward_counts, act=self._act_on_forward)
        if self.acceleration_ff_s:
            counts = self.acceleration_counts
            yield Law(*ACCELERATION_OBJECT, SOURCE, set_up=counts, act=self._act_on_acceleration)
        if self.derivative_share:
            yield Law(*DERIVATIVE_OBJECT, SOURCE, set_up=self.derivative_counts, act=self._act_on_derivative)
        kind = RMS if self.rms else 1.0
        own = dict.fromkeys(EPOS2_CURRENTS, 1.0) if (0x2027, 0) in laws else {}
        if (0x2333, 1) in laws:
            own[FAULHABER_CURRENT] = 1.0
        for address, stated in {**CURRENTS, **own}.items():
            if address in laws:
                yield _scaled(laws[address], kind / stated)

    def _loop(self, take: Callable[[Behind, float, float], None]) -> Iterator[Law]:
        """Yield the laws of one loop's gains; ``take`` gets both in SI."""
        held = list(map(float, self.counts))

        def taking(position: int) -> Callable[[Behind, float], None]:
            def act(behind: Behind, counts: float) -> None:
                new = [*held[:position], counts, *held[position + 1 :]]
                take(behind, self.K_p_nms_per_rad * new[0], self.K_i_nm_per_rad(*new))
                held[:] = new

            return act

        for position, address in enumerate((self.gain, self.integral)):
            yield Law(*address, SOURCE, set_up=self.counts[position], act=taking(position))

    def _act_on_position(self, behind: Behind, counts: float) -> None:
        behind.position_gains.K_v = self.K_v_per_s * counts

    def _act_on_forward(self, behind: Behind, counts: float) -> None:
        behind.velocity_ff = self.forward_share * counts

    def _act_on_acceleration(self, behind: Behind, counts: float) -> None:
        behind.acceleration_ff_s = self.acceleration_ff_s * counts

    def _act_on_derivative(self, behind: Behind, counts: float) -> None:
        behind.derivative_share = self.derivative_share * counts


def _scaled(law: Law, factor: float) -> Law:
    """Return a law whose counts are larger by a factor."""
    show, act = law.show, law.act
    return replace(
        law,
        source=SOURCE,
        set_up=None if law.set_up is None else law.set_up * factor,
        show=None if show is None else lambda behind: factor * show(behind),
        act=None if act is None else lambda behind, counts: act(behind, counts / factor),
    )


def draw_gains(seed: int, objects: MakersObjects, motor: SetUp) -> DrawnGains | None:
    """Return the gains of a seed; None where the file has no gains of a speed loop that this program knows."""
    found = next((pair for pair in SPEED_OBJECTS if objects.has(*pair)), None)
    if found is None:
        return None
    chance = random.Random(f"gains {seed} {objects.name}")
    bandwidth = _between(chance, *BANDWIDTH_RAD_S)
    share = _between(chance, *INTEGRAL_RATE)
    K_p = bandwidth * motor.J_kgm2
    form: Form = chance.choice(("parallel", "rate", "time"))
    counts = tuple(round(_between(chance, *_room(objects, address))) for address in found)
    rate = share * bandwidth
    kept = {"parallel": K_p * rate, "rate": rate, "time": 1.0 / rate}[form]
    drawn = DrawnGains(
        *found, (counts[0], counts[1]), K_p / counts[0], kept / counts[1], form, chance.random() < 0.5,
        _between(chance, *FILTER_HZ), chance.randint(*DECIMATION), _between(chance, *CURRENT_BANDWIDTH),
    )  # fmt: skip
    return _with_current(_with_position(drawn, bandwidth, chance, objects), chance, objects, motor)


def _with_current(drawn: DrawnGains, chance: random.Random, objects: MakersObjects, motor: SetUp) -> DrawnGains:
    """Return the draw with gains of the current loops, where the file has a trace that shows what they do."""
    if not objects.has(*CURRENT_OBJECTS, *TRACE_MARKS):
        return drawn
    K_p = motor.K_p_v_per_a * drawn.current_bandwidth / SET_UP_BANDWIDTH
    rate = motor.R_s_ohm / motor.L_q_h * _between(chance, *CURRENT_INTEGRAL_RATE)
    form: Form = chance.choice(("parallel", "rate", "time"))
    gain, integral = (round(_between(chance, *_room(objects, address))) for address in CURRENT_OBJECTS)
    kept = {"parallel": K_p * rate, "rate": rate, "time": 1.0 / rate}[form]
    current = replace(
        drawn, gain=CURRENT_OBJECTS[0], integral=CURRENT_OBJECTS[1], counts=(gain, integral),
        K_p_nms_per_rad=K_p / gain, integral_scale=kept / integral, form=form,
    )  # fmt: skip
    return replace(drawn, current=current)


def _with_position(drawn: DrawnGains, bandwidth: float, chance: random.Random, objects: MakersObjects) -> DrawnGains:
    """Return the draw with a position gain, where the file has an object of one on a speed controller."""
    place = next((pair for pair in POSITION_OBJECTS if objects.has(pair[0])), None)
    if place is None or objects.has((0x2027, 0)):  # the 0x60FB of an EPOS2 is one controller of the position
        return drawn
    position, forward = place
    counts = round(_between(chance, *_room(objects, position)))
    K_v = bandwidth * _between(chance, *POSITION_RATE) / counts
    share = chance.choice(FORWARD)
    drawn = replace(drawn, position=position, position_counts=counts, K_v_per_s=K_v)
    if objects.has(DERIVATIVE_OBJECT):
        own = random.Random(f"derivative {drawn.counts} {counts}")
        full = round(_between(own, *_room(objects, DERIVATIVE_OBJECT)))
        held = max(1, round(own.choice(DERIVATIVE) * full))
        drawn = replace(drawn, derivative_counts=held, derivative_share=1.0 / full)
    if forward is None or not objects.has(forward):
        return drawn
    full = round(_between(chance, *_room(objects, forward)))
    drawn = replace(
        drawn, forward=forward,
        forward_counts=round(share * full), forward_share=1.0 / full,
    )  # fmt: skip
    if not objects.has(ACCELERATION_OBJECT):
        return drawn
    own = random.Random(f"acceleration {drawn.counts} {counts}")  # what was drawn before this object stays
    full = round(_between(own, *_room(objects, ACCELERATION_OBJECT)))
    return replace(
        drawn, acceleration_counts=round(own.choice(FORWARD) * full), acceleration_ff_s=1.0 / (bandwidth * full)
    )


def _room(objects: MakersObjects, address: Address) -> tuple[int, int]:
    row = objects.rows[address]
    return SMALL_COUNTS if row.high is not None and row.high < COUNTS[1] else COUNTS


def _between(chance: random.Random, low: float, high: float) -> float:
    return math.exp(chance.uniform(math.log(low), math.log(high)))
