# SPDX-License-Identifier: MIT
"""Loops of an axis against python-control, which shares no code with them, and against the exact rigid speed loop."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from pmsmtool.axis.loops import AxisGains, AxisPath, Loop, Structure, closed_loop_poles, lifted, open_loop
from pmsmtool.axis.search import axis_margins
from pmsmtool.design.loops.current_loop import AxisPlant, axis_loop, imc
from pmsmtool.design.loops.sampled_loop import SampledLoop, margins
from pmsmtool.design.loops.speed_loop import Notch, SpeedGains, SpeedMethod, SpeedPath, notch_coefficients, speed_loop
from pmsmtool.machine.two_masses import Mechanics

if TYPE_CHECKING:
    import control  # loaded by the tests that compare with it: 1.6 s, in every worker that collects this file

T = 4e-4
CURRENT = axis_loop(imc(0.5, 2e-3, 900.0), AxisPlant(0.5, 2e-3, T, 1.5))
SHAFT = Mechanics(1.2e-3, 4e-4, 110.0, 175.0, 0.012)
GAINS = AxisGains(0.06, 1.1, 12.0, Notch(175.0, 0.05, 0.5))
EXACT = 1e-8
"""Relative difference to another program's arithmetic; measured 3e-10."""
COARSE = 1e-3
"""Relative difference to extrema of 3000 frequencies; measured 1e-5."""


def other_plant(shaft: Mechanics, current: SampledLoop) -> control.StateSpace:
    """Torque to angle with python-control: closed current loop, then the shaft behind a first-order hold."""
    import control

    closed = control.tf(current.num, np.polyadd(current.den, current.num), T)
    A, b, c = shaft.system()
    return control.sample_system(control.ss(A, b[:, None], c[1:2], 0.0), T, method="foh") * control.ss(closed)


def other_loop(path: AxisPath, gains: AxisGains) -> control.StateSpace:
    import control

    z = control.tf([1, 0], [1], T)
    notch = control.tf(*notch_coefficients(gains.notch, T), T) if gains.notch.hz else 1.0
    if path.structure == "pid":
        K_P, K_I, K_D = gains.pid
        pole = 10.0 * K_P / K_D
        law = K_P + K_I * T / (z - 1) + K_D * pole * (z - 1) / ((1.0 + pole * T) * z - 1)
    else:
        x = 2.0 * math.pi * path.filter_hz * T
        speed = (z - 1) / (T * z) * (x * z / ((1.0 + x) * z - 1.0) if path.filter_hz else 1.0)
        law = (gains.K_p + gains.K_i * T / (z - 1)) * (gains.K_v + speed)
    return other_plant(path.shaft, path.current) * control.ss(control.tf([1], [1, 0], T) * notch * law)


@pytest.mark.chain
@pytest.mark.parametrize("structure", ["cascade", "pid"])
def test_loop_poles_and_margins_are_those_of_python_control(structure: Structure) -> None:
    path = AxisPath(SHAFT, CURRENT, 1, late=1, structure=structure, filter_hz=500.0)
    plant, other = lifted(path), other_loop(path, GAINS)
    omega = np.geomspace(1.0, 0.99 * math.pi / T, 60)
    ours = open_loop(plant, path, GAINS, "position", omega, plant.at(omega))
    theirs = np.array([complex(other(np.exp(1j * w * T))) for w in omega])
    assert np.max(np.abs(ours / theirs - 1.0)) < EXACT
    poles = closed_loop_poles(plant, path, GAINS, "position")
    own = other.feedback(1).poles()
    assert max(float(np.min(np.abs(own - pole))) for pole in poles) < 1e-6
    found = axis_margins(plant, path, GAINS, "position")
    assert found.loop.stable
    dense = np.geomspace(20.0, math.pi / T, 3000)
    values = np.asarray(other(np.exp(1j * dense * T)))
    above = np.flatnonzero(np.diff(np.signbit(np.abs(values) - 1.0)))
    assert found.loop.phase_margin_deg == pytest.approx(np.degrees(np.min(np.abs(np.angle(-values[above])))), abs=0.3)
    assert found.loop.modulus_margin == pytest.approx(np.min(np.abs(1.0 + values)), rel=COARSE)
    assert found.S_peak_db == pytest.approx(-20.0 * math.log10(found.loop.modulus_margin), abs=1e-9)
    assert 10.0 ** (found.T_peak_db / 20.0) == pytest.approx(np.max(np.abs(values / (1.0 + values))), rel=COARSE)
    for factor, stable in ((0.999, True), (1.001, False)):
        gain = factor * found.loop.gain_margin
        assert bool(np.all(np.abs((gain * other).feedback(1).poles()) < 1.0)) is stable


def test_a_rigid_axis_is_the_exact_speed_loop() -> None:
    current = replace(CURRENT, T_s=1e-4)
    shaft = Mechanics(1.2e-3, 4e-4)
    path = AxisPath(shaft, current, 6, pll_rad_s=1200.0, filter_hz=200.0)
    exact = speed_loop(
        SpeedGains(0.06, 1.1, 50.0, SpeedMethod.SYMMETRIC_OPTIMUM),
        SpeedPath(shaft.J, shaft.B, current, 6, 1200.0, 200.0),
    )
    ours, theirs = axis_margins(lifted(path), path, replace(GAINS, notch=Notch()), "speed").loop, margins(exact)
    for name in ("phase_margin_deg", "gain_margin", "delay_margin_s", "crossover_rad_s"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), rel=1e-6)


@pytest.mark.parametrize("loop", ["speed", "position"])
def test_a_narrow_resonance_is_not_stepped_over(loop: Loop) -> None:
    """Damping of 1e-4: |S| as a grid of two million points finds it."""
    path = AxisPath(replace(SHAFT, zeta=1e-4), CURRENT, 1, late=1)
    gains = AxisGains(0.004, 0.02, 3.0)
    plant = lifted(path)
    near = 2.0 * math.pi * np.linspace(174.0, 176.0, 20_001)
    fine = np.max(1.0 / np.abs(1.0 + open_loop(plant, path, gains, loop, near, plant.at(near))))
    assert axis_margins(plant, path, gains, loop).S_peak_db == pytest.approx(20.0 * math.log10(fine), abs=0.02)


def test_an_unstable_loop_is_called_so() -> None:
    path = AxisPath(SHAFT, CURRENT, 1, late=1)
    assert not axis_margins(lifted(path), path, AxisGains(0.6, 11.0, 12.0), "position").loop.stable


def test_pid_gains_are_those_of_the_cascade() -> None:
    """K_p (K_v e + de/dt) + K_i integral of (K_v e + de/dt), by powers of s."""
    assert AxisGains(2.0, 3.0, 5.0).pid == (2.0 * 5.0 + 3.0, 3.0 * 5.0, 2.0)


def test_two_masses_swing_at_the_frequencies_of_the_file() -> None:
    A, b, c = replace(SHAFT, B=0.0, zeta=0.0).system()
    swing = np.sort(np.abs(np.linalg.eigvals(A).imag))[-1]
    assert swing == pytest.approx(2.0 * math.pi * 175.0, rel=1e-9)
    zero = 2j * math.pi * 110.0  # the motor stands still while the load swings
    assert abs(c[0] @ np.linalg.solve(zero * np.eye(4) - A, b)) < 1e-9
    assert SHAFT.load_ratio == pytest.approx((175.0 / 110.0) ** 2 - 1.0)
