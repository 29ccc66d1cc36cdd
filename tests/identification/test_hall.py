# SPDX-License-Identifier: MIT
"""Hall sensors: the order of the wires, their alignment, and what is no such sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.errors import IdentificationError
from pmsmtool.identification.hall import hall_alignment
from pmsmtool.machine.parameters import HALL_ORDERS, hall_axis
from pmsmtool.trace import Trace

ERRORS = {"a": 0.2, "b": -0.15, "c": 0.1}
STEP_RAD, LAG_RAD = math.radians(2.0), 0.05
WITHIN_RAD = math.radians(0.6)
"""Of a vector in steps of 2 degrees; measured 0.35 degrees."""


def turned(axes: list[float], *, swing_rad: float = 0.0) -> Trace:
    """The wires of sensors at three angles, over a rotor that is behind its vector and may swing about that."""
    way = STEP_RAD * np.arange(1, 231)
    commanded = np.concatenate((way, way[-2::-1]))
    behind = LAG_RAD * np.concatenate((np.ones(len(way)), -np.ones(len(way) - 1)))
    rotor = commanded - behind + swing_rad * np.sin(2.0 * np.arange(len(commanded)))
    pattern = sum((np.cos(rotor - axis) >= 0.0).astype(float) * 2.0**k for k, axis in enumerate(axes))
    signals = {"commanded_rad": commanded, "angle_rad": commanded, "hall_pattern": np.asarray(pattern)}
    return Trace(np.arange(len(commanded)) * 0.03, signals, dict.fromkeys(signals, "rad"), {})


@pytest.mark.parametrize("order", HALL_ORDERS)
@pytest.mark.parametrize("swing_rad", [0.0, 0.06])
def test_order_offset_and_placement(order: str, swing_rad: float) -> None:
    turn = 0.4
    found = hall_alignment(turned([turn + hall_axis(x) + ERRORS[x] for x in order], swing_rad=swing_rad))
    mean = sum(ERRORS.values()) / 3.0
    assert found.order == order
    assert found.offset_rad == pytest.approx(turn + mean, abs=WITHIN_RAD)
    assert found.errors_rad == pytest.approx([ERRORS[x] - mean for x in "abc"], abs=2.0 * WITHIN_RAD)
    assert found.lag_rad == pytest.approx(LAG_RAD, abs=WITHIN_RAD)
    assert bool(found.wiring) == (order != "abc")
    for pattern, middle in found.sectors().items():
        axes = [turn + hall_axis(x) + ERRORS[x] for x in order]
        assert pattern == sum((math.cos(middle - axis) >= 0.0) << k for k, axis in enumerate(axes))
    assert sorted(found.sectors()) == [1, 2, 3, 4, 5, 6]


def test_swapped_wires_are_named() -> None:
    found = hall_alignment(turned([hall_axis(x) for x in "acb"]))
    assert found.wiring == "Hall wires 2 and 3 are swapped"


@pytest.mark.parametrize(
    ("axes", "what"),
    [
        ([0.0, hall_axis("b"), math.nan], "wire 3 does not change"),
        ([0.0, math.pi / 3.0, 2.0 * math.pi / 3.0], "60 degrees apart"),
        ([0.0, hall_axis("b") + 1.0, hall_axis("c")], "placement errors up to"),
    ],
)
def test_what_is_no_set_of_three_sensors_is_refused(axes: list[float], what: str) -> None:
    with pytest.raises(IdentificationError, match=what) as caught:
        hall_alignment(turned(axes))
    assert "E_HALL" in str(caught.value)
