# SPDX-License-Identifier: MIT
"""The bias of the square waves: a rotor off its vector, and a coarse offset that is off."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import cast

import pytest

from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.noise import Noise
from pmsmtool.experiments.square_injection import SquarePlan
from pmsmtool.measurement.square_waves import SquareStage

FRICTION_RAD = math.radians(0.2)
"""What friction held the rotor off its vector in the slow turn."""
ENCODER = cast(
    EncoderResult,
    SimpleNamespace(
        direction=1, pole_pairs=SimpleNamespace(value=1.0), offset=SimpleNamespace(value=0.0), lag_rad=FRICTION_RAD
    ),
)


class Rotor:
    """A rotor of one pole pair that stands where a bias puts it, as the encoder shows it."""

    period_s = 1e-4

    def __init__(self, off_rad: float, load: float) -> None:
        self.off_rad, self.load, self.bias, self.angle = off_rad, load, 1.0, 0.0

    def command_current(self, i_d_a: float, i_q_a: float, *, fixed_angle_rad: float = 0.0) -> None:
        self.bias, self.angle = i_d_a, fixed_angle_rad

    def wait(self, seconds: float) -> None:
        """Nothing swings."""

    def live(self, name: str) -> float:
        return self.bias

    def average(self, signals: tuple[str, ...], periods: int) -> dict[str, float]:
        at = self.angle + self.off_rad + math.asin(min(1.0, self.load / max(self.bias, 1e-9)))
        return dict.fromkeys(signals, self.bias) | {"theta_m_rad": at}


def held(rotor: Rotor) -> SquarePlan:
    stage = SquareStage(cast(Drive, rotor), cast("object", None), lambda n, t: None, lambda text: None, 0.1)  # type: ignore[arg-type]
    return stage._hold_stable_bias(SquarePlan(1.0, 0.2, 10.0), ENCODER, 0.0, Noise(1e-3, 0.0, 0.0, 64))


@pytest.mark.parametrize("off_deg", [-8.5, 7.0, 11.0])
def test_an_offset_that_is_off_leaves_the_rotor_on_its_vector(off_deg: float) -> None:
    """The same angle at half the bias: the rotor is where the vector is, so the first bias serves."""
    assert held(Rotor(math.radians(off_deg), 0.0)).bias_d_a == 1.0


@pytest.mark.parametrize(("off_deg", "load"), [(0.0, 0.15), (20.0, 0.0)])
def test_a_load_and_a_wild_offset_are_refused(off_deg: float, load: float) -> None:
    """A load turns the rotor further with every half of the bias; 20 degrees are no error of a slow turn."""
    with pytest.raises(IdentificationError, match="E_ROTOR_MOVED"):
        held(Rotor(math.radians(off_deg), load))


def test_a_rotor_on_its_vector_is_left_there() -> None:
    assert held(Rotor(math.radians(1.0), 0.0)).bias_d_a == 1.0
