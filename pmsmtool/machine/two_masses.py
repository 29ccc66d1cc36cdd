# SPDX-License-Identifier: MIT
"""The shaft that speed and position loops turn: one mass, or a load behind an elastic shaft, as a sampled system.

The two masses are those of ``identify frf``: the load swings alone at the antiresonance f_a (stiffness k = J_L w_a^2),
both against each other at the resonance f_r, and J_M / J = (f_a / f_r)^2.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from pmsmtool.arrays import Array
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile

DAMPING = 0.01
"""Damping of a resonance whose machine file says none: the lower end of 0.5 to 5 % (steel shaft to jaw coupling)."""


RESONANCE_DOUBT, COVERAGE, ZETA_FACTOR = 0.02, 2.0, 2.0
"""Least relative half width of resonance and antiresonance, else so many of their standard deviations, and factor
either way of the damping (found within 0.03 % and 14 %, ``tests/measurement/test_frequency_response``; a shaft has more
than two masses)."""


SWING = "shaft_swings_hz"
"""Condition of a machine file: where torque pulses swing a shaft of which no linear response is known (play)."""
SWING_RATIOS, SWING_DAMPING, SWING_FACTOR = (1.0, 10.0), 0.03, 1.5
"""Load over motor and damping that the speed loop must then bear, within this factor of the frequency either way: most
of the ranges of an elastic shaft (0.2 to 20, 0.5 to 5 %). Pulses of a gear of 184 Hz with 1.1 degrees of play swing at
140 and 153 Hz."""


UNSEEN = "shaft_unseen_above_hz"
"""Condition of a machine file: up to where (Hz) a response shows no second mass of a shaft that is not rigid.
What swings above is not known, and the speed loop bears it anywhere from there on."""
LOAD_RATIO = "shaft_load_ratio"
"""Condition of a machine file: load over motor of such a shaft, where a response shows it, within SWING_FACTOR. A play
of 0.1 degrees at 272 Hz showed 53 +- 2 Hz, no resonance to claim, and the loop of a rigid shaft swung by 22 %."""
SLOWEST_UNSEEN_HZ, FASTEST_UNSEEN_HZ, UNSEEN_TRIED = 20.0, 800.0, 9
"""The same without a response, up to where couplings and gears swing (50 to 800 Hz), and frequencies between."""


INERTIA, REFUSED = "shaft_inertia", "refused"
"""Condition of a machine file: its inertia is the data sheet's, for that of the machine was refused. A load of 190
times the rotor was predicted to turn 12 times as fast in a speed step as it did."""
TORQUE_NOISE, TORQUE_NOISE_MOST = "shaft_torque_noise", 0.02
"""Condition of a machine file: torque of pulses, of theirs, that a rigid shaft does not explain, and from where on it
may be a play: 0.036 and 0.038 with 0.4 and 0.7 degrees that no response showed, at most 0.007 of 16 rigid shafts with
cogging, friction over the angle and encoders off centre."""


PLAY_ZETA, PLAY_FACTOR, PLAY_STEPS = 0.05, 2.0, 4
"""Damping of a resonance above which play makes it, no steel and no jaw: a small torque then shows a resonance that is
too low, by up to this factor. A joint with 0.06 degrees of play that resonates at 399 Hz showed 237 Hz and a damping of
9.6 %, and a speed loop for that shook the shaft at 399 Hz. So many stiffer shafts are looked at."""
CERTAIN_ZETA = 0.1
"""Damping that no coupling has, of rubber neither. A play of 0.74 degrees before 7.6 times the rotor's inertia showed
109 of 275 Hz with 15.8 %; a healthy speed step was 202 % of a band drawn with up to twice that frequency."""


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Inertia and elasticity, seen from the motor."""

    J: float
    """Inertia of all that turns (kg m2)."""
    B: float = 0.0
    """Viscous friction at the motor (N m s)."""
    antiresonance_hz: float = 0.0
    resonance_hz: float = 0.0
    """Of the load behind an elastic shaft (Hz); both 0: rigid."""
    zeta: float = DAMPING
    """Damping of the resonance."""

    @property
    def elastic(self) -> bool:
        """Whether there is a second mass."""
        return self.resonance_hz > 0.0

    @property
    def load_ratio(self) -> float:
        """Inertia of the load over that of the motor; 0 for one mass."""
        return (self.resonance_hz / self.antiresonance_hz) ** 2 - 1.0 if self.elastic else 0.0

    def scaled(self, inertia: float, frequency: float, damping: float) -> Mechanics:
        """Return the shaft with other inertia, resonance and damping, by their factors; the ratio of masses stays."""
        return replace(
            self,
            J=self.J * inertia,
            antiresonance_hz=self.antiresonance_hz * frequency,
            resonance_hz=self.resonance_hz * frequency,
            zeta=self.zeta * damping,
        )

    def system(self) -> tuple[Array, Array, Array]:
        """Return A, b, c of torque (N m) to motor speed (rad/s) and angle (rad): c has two rows.

        The last state is the motor's angle.
        """
        if not self.elastic:
            A = np.array([[-self.B / self.J, 0.0], [1.0, 0.0]])
            return A, np.array([1.0 / self.J, 0.0]), np.eye(2)
        J_M = self.J / (1.0 + self.load_ratio)
        J_L = self.J - J_M
        k = J_L * (2.0 * math.pi * self.antiresonance_hz) ** 2
        d = damping_nms_per_rad(k, 2.0 * math.pi * self.resonance_hz, self.zeta)
        A = np.array(
            [
                [-(self.B + d) / J_M, d / J_M, -k / J_M, 0.0],
                [d / J_L, -d / J_L, k / J_L, 0.0],
                [1.0, -1.0, 0.0, 0.0],
                [1.0, 0.0, 0.0, 0.0],
            ]
        )
        c = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        return A, np.array([1.0 / J_M, 0.0, 0.0, 0.0]), c


def damping_nms_per_rad(stiffness_nm_per_rad: float, resonance_rad_s: float, zeta: float = DAMPING) -> float:
    """Return the damping (N m s/rad) beside a spring whose two masses swing against each other damped by ``zeta``."""
    return 2.0 * zeta * stiffness_nm_per_rad / resonance_rad_s


def mechanics_of(source: MachineFile) -> Mechanics:
    """Return the shaft of a machine file.

    Raises ConfigError: it has no inertia, or a resonance without the antiresonance below it.
    """
    machine = source.machine
    if not machine.J_kgm2:
        raise ConfigError(
            "the axis cannot be designed without an inertia", where="machine.J_kgm2",
            hint="`pmsmtool identify mechanics` measures it, or put that of motor and load into the machine file",
        )  # fmt: skip
    f_r, f_a = machine.resonance_hz, machine.antiresonance_hz
    if f_r is None:
        return Mechanics(machine.J_kgm2, machine.B_nms or 0.0)
    if f_a is None or not 0.0 < f_a < f_r:
        raise ConfigError(
            f"a resonance at {f_r:.4g} Hz without an antiresonance below it says nothing of the load",
            where="machine.antiresonance_hz", hint="`pmsmtool identify frf` measures both",
        )  # fmt: skip
    return Mechanics(machine.J_kgm2, machine.B_nms or 0.0, f_a, f_r, machine.resonance_zeta or DAMPING)


def shafts_of(source: MachineFile) -> list[Mechanics]:
    """Return the shaft of a machine file, and what else it may be; nothing where it is one mass."""
    f_r, f_a = source.machine.resonance_hz, source.machine.antiresonance_hz
    swing_hz, unseen_hz = source.conditions.get(SWING), source.conditions.get(UNSEEN)
    if source.machine.J_kgm2 and f_r is None and isinstance(swing_hz, float):
        return _swinging(mechanics_of(source), (swing_hz / SWING_FACTOR, swing_hz, swing_hz * SWING_FACTOR))
    if source.machine.J_kgm2 and f_r is None and isinstance(unseen_hz, float):
        ratio, tried = source.conditions.get(LOAD_RATIO), (unseen_hz, max(unseen_hz, FASTEST_UNSEEN_HZ), UNSEEN_TRIED)
        ratios = (ratio / SWING_FACTOR, ratio * SWING_FACTOR) if isinstance(ratio, float) else SWING_RATIOS
        return _swinging(mechanics_of(source), np.geomspace(*tried), ratios)
    if not source.machine.J_kgm2 or f_r is None or f_a is None or not f_a < f_r:
        return []
    nominal = mechanics_of(source)
    r, a = doubt(source, "resonance_hz", f_r), doubt(source, "antiresonance_hz", f_a)
    corners = [
        replace(nominal, resonance_hz=f_r * (1.0 + x * r), antiresonance_hz=f_a * (1.0 + y * a), zeta=z * nominal.zeta)
        for x in (-1.0, 1.0)
        for y in (-1.0, 1.0)
        for z in (1.0 / ZETA_FACTOR, ZETA_FACTOR)
    ]
    known = [nominal, *(shaft for shaft in corners if shaft.antiresonance_hz < shaft.resonance_hz)]
    stiffer = (by_more_torque(nominal, k / PLAY_STEPS) for k in range(1, PLAY_STEPS + 1))
    return [*known, *stiffer] if hides_play(source) else known


def hides_play(source: MachineFile, zeta: float = PLAY_ZETA) -> bool:
    """Return whether a resonance is damped by more than what shafts are made of, or by more than ``zeta``."""
    found = source.machine.resonance_zeta or 0.0
    return found - COVERAGE * source.std.get("resonance_zeta", 0.0) > zeta


def by_more_torque(shaft: Mechanics, share: float) -> Mechanics:
    """Return a shaft with play as more torque shows it, 0 to 1: stiffer, and with the damping of what it is made of."""
    return shaft.scaled(1.0, PLAY_FACTOR**share, (SWING_DAMPING / shaft.zeta) ** share)


def why_slower(source: MachineFile, rigid_rad_s: float, slowed_rad_s: float) -> tuple[str, ...]:
    """Return why a speed loop is slower than that of a rigid shaft (crossovers in rad/s); nothing where it is not."""
    if slowed_rad_s >= rigid_rad_s:
        return ()
    swing_hz, f_r = source.conditions.get(SWING), source.machine.resonance_hz
    if f_r is None and swing_hz is None:
        shaft = f"is not rigid, and what swings above {source.conditions.get(UNSEEN):.3g} Hz is not known"
    else:
        shaft = f"swings at {f_r:.3g} Hz" if f_r else f"has play, and torque pulses swing it at {swing_hz:.3g} Hz"
    rigid_hz, hz = rigid_rad_s / (2.0 * math.pi), slowed_rad_s / (2.0 * math.pi)
    return (f"speed loop of {hz:.3g} Hz instead of {rigid_hz:.3g} Hz: the shaft {shaft}, where a faster loop hunts",)


def _swinging(
    whole: Mechanics, frequencies_hz: Iterable[float], ratios: tuple[float, float] = SWING_RATIOS
) -> list[Mechanics]:
    """Return one mass, and the elastic shafts that may swing at some frequencies."""
    return [whole] + [
        replace(whole, antiresonance_hz=hz / math.sqrt(1.0 + ratio), resonance_hz=hz, zeta=SWING_DAMPING)
        for hz in map(float, frequencies_hz)
        for ratio in ratios
    ]


def doubt(source: MachineFile, name: str, value: float) -> float:
    """Return the relative half width of a resonance or an antiresonance."""
    return max(RESONANCE_DOUBT, COVERAGE * source.std.get(name, 0.0) / value)


def sampled(system: tuple[Array, Array, Array], T_s: float) -> tuple[Array, Array, Array, Array]:
    """Return A, b, c, d of a system whose input runs linearly between samples, T_s apart (s); d is one per output.

    Source: first-order-hold equivalent, G. F. Franklin, J. D. Powell, M. Workman, Digital Control, 3rd ed., 6.3.2.
    """
    from scipy.linalg import expm

    A, b, c = system
    n = b.size
    block = np.zeros((n + 2, n + 2))
    block[:n, :n], block[:n, n], block[n, n + 1] = A * T_s, b * T_s, 1.0
    moved = expm(block)
    held, ramp = moved[:n, n], moved[:n, n + 1]
    step = moved[:n, :n]
    return step, held + step @ ramp - ramp, c, c @ ramp
