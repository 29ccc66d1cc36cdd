# SPDX-License-Identifier: MIT
"""The pushes that tell flux and inertia roughly, on a drive whose current comes late: a large dead time holds it up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pmsmtool.drive.port import Excitation
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.inverter_error import InverterCurve
from pmsmtool.measurement.limits import Limits
from pmsmtool.measurement.speeds import (
    PUSH_END_SHARE,
    PUSH_MOST_S,
    PUSH_REACHED,
    PUSH_SHARE,
    PUSH_SPEED_SHARE,
    SpeedStage,
)
from pmsmtool.trace import Trace

POLE_PAIRS, PSI, RATE, R, V_DEAD = 4, 0.05, 400.0, 0.2, 10.0
"""The rate is in rad/s2 (mechanical) per ampere."""
BEHIND_A_LAG = 0.01
"""Of flux linkage and inertia: 0.07 and 0.28 % found; 9 and 25 % too much without the lag."""
READING_S = 0.05
"""Time that a record takes to be read, in which the shaft coasts and the speed estimate settles."""
BEHIND_FRICTION = 0.1
"""Of flux linkage and inertia: 5.0 and 8.2 % found; J 10 to 107 % too large by a first push alone."""
LIMITS = Limits(10.0, 12.0, 300.0, 150.0)


class LateCurrent:
    """``i_q`` is there ``late_s`` after its command; the voltage is off by ``off_v``: the dead time's rest.

    The speed is shown through a double pole at ``bandwidth_rad_s``.
    """

    period_s = 5e-5

    def __init__(
        self, late_s: float, off_v: float, rate: float, bandwidth_rad_s: float, friction_a: float, curve: InverterCurve
    ) -> None:
        self.curve, self.held_a = curve, 0.0
        self.late_s, self.off_v, self.rate, self.bandwidth_rad_s = late_s, off_v, rate, bandwidth_rad_s
        self.friction_a, self.fastest = friction_a, 0.0
        self.omega, self.poles = 0.0, [0.0, 0.0]

    def after(self, i_a: float, step_s: float) -> float:
        """Return the speed a step later: friction brakes, and holds a shaft that a current does not move."""
        if self.omega == 0.0 and abs(i_a) < self.held_a:
            return 0.0
        gain, loss = self.rate * i_a * step_s, self.rate * self.friction_a * step_s
        free = self.omega + gain
        return math.copysign(max(0.0, abs(free) - loss), free)

    def read(self, name: str) -> float:
        assert name == "encoder.pll_bandwidth_rad_s"
        return self.bandwidth_rad_s

    def shown(self, omega: NDArray[np.float64], step_s: float) -> NDArray[np.float64]:
        """The speed estimate, and its state behind the record: an independent one, by the matrix exponential."""
        w = self.bandwidth_rad_s
        decay, rows = math.exp(-w * step_s), []
        for value in omega:
            x, v = self.poles[0] - value, self.poles[1]
            self.poles = [value + decay * ((1.0 + w * step_s) * x + step_s * v),
                          decay * (v - w * step_s * (w * x + v))]  # fmt: skip
            rows.append(self.poles[0])
        return np.array(rows)

    def command_current(self, i_d_a: float, i_q_a: float) -> None:
        self.omega = self.after(0.0, READING_S)
        self.poles = [self.omega, 0.0]

    def record(
        self, names: Sequence[str], samples: int, *, decimation: int = 1, excitation: Excitation | None = None
    ) -> Trace:
        assert excitation is not None
        t = np.arange(samples) * decimation * self.period_s
        i_q = excitation.amplitude * (t >= self.late_s)
        omega = np.empty(samples)
        for k, i_a in enumerate(i_q):
            if abs(POLE_PAIRS * self.omega) > excitation.abort_speed_rad_s:
                i_q[k:] = i_a = 0.0
            self.omega = self.after(float(i_a), decimation * self.period_s)
            omega[k] = self.omega
        self.fastest = max(self.fastest, float(np.max(np.abs(omega))))
        angles = np.arange(0.0, 2.0 * math.pi, 0.01)
        curve = [self.curve.error_dq_v(0.0 * angles, i_a + 0.0 * angles, angles)[1].mean() for i_a in np.unique(i_q)]
        error = np.interp(i_q, np.unique(i_q), curve) - self.off_v * np.sign(i_q)
        signals: dict[str, Any] = {
            "i_q_a": i_q,
            "omega_e_rad_s": POLE_PAIRS * self.shown(omega, decimation * self.period_s),
            "u_q_v": PSI * POLE_PAIRS * omega + R * i_q + error,
        }
        asked = {name: signals.get(name, np.zeros(samples)) for name in names}
        return Trace(t, asked, dict.fromkeys(names, "1"), {"period_s": decimation * self.period_s})


def pushed(
    late_s: float, off_v: float = 0.5, rate: float = RATE, bandwidth_rad_s: float = 3000.0, friction_a: float = 0.0,
    knee_a: float = 1e-3, held_a: float = 0.0,
) -> tuple[dict[str, Trace], float, float]:  # fmt: skip
    kept: dict[str, Trace] = {}
    curve = InverterCurve(np.array([knee_a]), np.array([V_DEAD]), 0.0)
    drive: Any = LateCurrent(late_s, off_v, rate, bandwidth_rad_s, friction_a, curve)
    drive.held_a = held_a
    stage = SpeedStage(drive, LIMITS, kept.__setitem__, lambda text: None)
    resistance: Any = SimpleNamespace(R_measured=SimpleNamespace(value=R), V_dead_v=V_DEAD, curve=curve)
    psi, J = stage._pushes(resistance, POLE_PAIRS, (1e-3, 1e-3))
    assert drive.fastest < 1.02 * PUSH_END_SHARE * LIMITS.omega_max_rad_s  # the drive ends it a row later
    return kept, psi, J


@pytest.mark.parametrize("late_s", [0.0, 0.03, 0.049])
def test_a_push_goes_on_until_it_turns_the_shaft(late_s: float) -> None:
    kept, psi, _ = pushed(late_s)
    reached = max(abs(float(push["omega_e_rad_s"][-1])) for push in kept.values()) / POLE_PAIRS
    assert reached >= 0.9 * PUSH_REACHED * PUSH_SPEED_SHARE * LIMITS.omega_max_rad_s
    assert reached < LIMITS.omega_max_rad_s
    assert psi == pytest.approx(PSI, rel=0.25)


@pytest.mark.parametrize("rate", [400.0, 8e3])
def test_a_speed_estimate_that_lags_behind_a_light_shaft_hides_neither_flux_nor_inertia(rate: float) -> None:
    """The double pole at 500 rad/s lags by 4 ms; a push to 36 rad/s takes a few of them."""
    kept, psi, J = pushed(0.0, 0.0, rate, 500.0)
    assert len(kept) == 2 and psi == pytest.approx(PSI, rel=BEHIND_A_LAG)
    assert J == pytest.approx(1.5 * POLE_PAIRS * PSI / rate, rel=BEHIND_A_LAG)


def test_a_light_shaft_is_pushed_below_the_knee_of_the_inverters_error() -> None:
    """The whole plateau, taken from a voltage that holds a tenth of it, left no flux linkage: psi_f was refused."""
    _, psi, _ = pushed(0.0, 0.0, 2e4, 3000.0, 0.0, 4.0)
    assert psi == pytest.approx(PSI, rel=BEHIND_A_LAG)


def test_a_light_shaft_that_cogging_holds_gets_more_current_not_more_time() -> None:
    """A fortieth of the test current did not leave the cogging within 0.35 s; its voltage showed -0.07 of 0.11 Wb."""
    kept, psi, _ = pushed(0.0, 0.0, 2e4, 3000.0, held_a=0.4)
    assert psi == pytest.approx(PSI, rel=BEHIND_A_LAG)
    assert 0.4 < float(np.max(kept["push_0"]["i_q_a"])) < PUSH_SHARE * LIMITS.I_test_apk


@pytest.mark.parametrize("friction_a", [0.25, 0.45, 1.0, 2.0])
def test_friction_hides_no_inertia(friction_a: float) -> None:
    """Of a first push of 0.5 to 4 A, which is the first that moves the shaft, friction takes up to nine tenths."""
    _, psi, J = pushed(0.0, 0.0, 400.0, 500.0, friction_a)
    assert psi == pytest.approx(PSI, rel=BEHIND_FRICTION)
    assert J == pytest.approx(1.5 * POLE_PAIRS * PSI / 400.0, rel=BEHIND_FRICTION)


@pytest.mark.parametrize(
    ("answers", "rate"),
    [
        ([(3.54, 1.74e-3), (11.1, 1.75e-3), (20.6, 1.89e-3), (33.9, 2.46e-3)], 30.36 / 0.72e-3),
        ([(3.54, 1.74e-3)] * 5, 3.54 / 1.74e-3),
    ],
)
def test_a_second_push_in_which_no_more_current_flowed_tells_no_inertia(
    answers: list[tuple[float, float]], rate: float
) -> None:
    """60 W behind cogging (28 000 rad/s2/A): the first two, 0.6 % apart in what flowed, gave 760 000."""
    pushed_a = []

    class Answering(SpeedStage):
        def _there_and_back(self, i_q_a: float, seconds: float, pole_pairs: int) -> tuple[float, float]:
            pushed_a.append(i_q_a)
            return answers[len(pushed_a) - 1]

    stage = Answering(SimpleNamespace(), LIMITS, lambda name, trace: None, lambda text: None)  # type: ignore[arg-type]
    assert stage._acceleration_per_ampere(10.0, POLE_PAIRS, (1e-3, 1e-3)) == pytest.approx(rate)
    assert pushed_a == sorted(pushed_a) and pushed_a[-1] <= LIMITS.I_test_apk


@pytest.mark.parametrize(("L_d", "reason"), [(1.1e-3, "E_EXCITATION"), (1.3e-3, "E_NO_MAGNET")])
def test_a_rotor_that_no_push_turns_has_a_brake_or_no_magnets(L_d: float, reason: str) -> None:
    """A reluctance machine was pushed four times longer each time, until the run's 600 s were over."""
    seconds_of = []

    class Still(SpeedStage):
        def _there_and_back(self, i_q_a: float, seconds: float, pole_pairs: int) -> tuple[float, float]:
            seconds_of.append(seconds)
            return 1e-9, i_q_a * seconds

    stage = Still(SimpleNamespace(), LIMITS, lambda name, trace: None, lambda text: None)  # type: ignore[arg-type]
    with pytest.raises(IdentificationError, match=reason):
        stage._acceleration_per_ampere(10.0, POLE_PAIRS, (L_d, 1e-3))
    assert max(seconds_of) == PUSH_MOST_S and 2.0 * sum(seconds_of) < 60.0
