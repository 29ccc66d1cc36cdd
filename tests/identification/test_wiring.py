# SPDX-License-Identifier: MIT
"""The verdicts of the first turn, on rows made by hand: what is wrong is named first, the ambiguous with both names."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmsmtool.identification.wiring import (
    NOT_SEEN,
    OK,
    WRONG,
    judge_halls,
    judge_sensors,
    judge_supply,
    judge_turn,
    supply_power,
    supply_under_load,
)
from pmsmtool.machine.parameters import HALL_ORDERS, hall_axis
from pmsmtool.trace import Trace


def turned(
    pole_pairs: float, *, way_rad: float = 9.0, lag_rad: float = 0.0, U_dc_v: float = 48.0, rows: int = 20
) -> Trace:
    """A rotor of (apparent) pole pairs led forward and back in ``rows`` each, ``lag_rad`` behind at both ends."""
    there, n = np.linspace(0.0, way_rad, rows), 2 * rows + 3
    imposed = np.concatenate([[0.0], there, [way_rad], there[::-1], [0.0]])
    behind = np.concatenate([np.full(rows + 2, lag_rad), np.full(rows + 1, -lag_rad)])
    at_rest = np.zeros(n)
    at_rest[[0, rows + 1, n - 1]] = 1.0
    theta = (imposed - behind) / pole_pairs
    signals = {"theta_imposed_rad": imposed, "theta_M_rad": theta, "U_dc_v": np.full(n, U_dc_v), "at_rest": at_rest}
    return Trace(np.arange(float(n)), signals, dict.fromkeys(signals, "1"), {})


def wrong(turn: Trace, stated: int, *, against: bool = False) -> list[tuple[str, str]]:
    return [(row.looked_at, row.likely) for row in judge_turn(turn, stated, against) if row.verdict == WRONG]


@given(pole_pairs=st.integers(1, 32), lag_deg=st.floats(-15.0, 15.0))
def test_the_stated_pole_pairs_are_confirmed_behind_friction(pole_pairs: int, lag_deg: float) -> None:
    turn = turned(pole_pairs, way_rad=0.9 * math.pi * pole_pairs, lag_rad=math.radians(lag_deg))
    assert [row.verdict for row in judge_turn(turn, pole_pairs, False)] == [OK, OK, OK]


@pytest.mark.parametrize(
    ("true", "stated", "counts", "named", "other"),
    [
        (3, 7, 1.0, "pole pairs", "3 pole pairs"),
        (4, 8, 1.0, "pole pairs", "4 pole pairs"),  # poles given for pole pairs
        (5, 6, 1.0, "pole pairs", "5 pole pairs"),
        (4, 4, 4.0, "encoder counts", "4 times the angle"),
        (8, 8, 0.25, "encoder counts", "0.25 times the angle"),
        (4, 4, 0.8, "pole pairs", "0.8 times the angle"),  # 5 pole pairs would show the same
        (6, 6, 0.8, "encoder counts", "0.8 times the angle"),
    ],
)
def test_a_wrong_ratio_is_named(true: int, stated: int, counts: float, named: str, other: str) -> None:
    (found,) = wrong(turned(true / counts, way_rad=0.9 * math.pi * stated), stated)
    assert found[0] == named and other in found[1]


@pytest.mark.parametrize(("sign", "against"), [(1, False), (-1, True), (1, True), (-1, False)])
def test_the_sign_is_held_against_what_the_drive_is_set_for(sign: int, against: bool) -> None:
    agrees = (sign < 0) == against
    assert [name for name, _ in wrong(turned(sign * 3), 3, against=against)] == ([] if agrees else ["encoder sign"])


def showing(turn: Trace, pattern: np.ndarray) -> Trace:
    return Trace(turn.t_s, {**turn.signals, "hall_pattern": pattern}, {**turn.units, "hall_pattern": "1"}, {})


def with_halls(turn: Trace, order: str, *, pole_pairs: int = 3, errors_rad: tuple[float, ...] = (0, 0, 0)) -> Trace:
    """Sensors that are high for half a turn about their phases' axes, displaced by the errors."""
    theta_e = pole_pairs * turn["theta_M_rad"]
    axes = [hall_axis(x) + errors_rad["abc".index(x)] for x in order]
    pattern = sum((np.cos(theta_e - axis) >= 0.0).astype(float) * 2**k for k, axis in enumerate(axes))
    return showing(turn, np.asarray(pattern))


@given(
    order=st.sampled_from(HALL_ORDERS),
    errors_deg=st.tuples(*3 * [st.floats(-15.0, 15.0)]),
    lag_deg=st.floats(0.0, 30.0),
)
def test_hall_wires_in_another_order_are_named(order: str, errors_deg: tuple[float, ...], lag_deg: float) -> None:
    turn = turned(3, way_rad=0.9 * math.pi * 3, lag_rad=math.radians(lag_deg), rows=60)
    row = judge_halls(with_halls(turn, order, errors_rad=tuple(map(math.radians, errors_deg))))
    assert row.verdict == (OK if order == "abc" else WRONG)
    assert order == "abc" or "wires" in row.shown


def test_hall_wires_that_do_not_change_or_a_turn_that_is_too_short() -> None:
    turn = turned(3, way_rad=0.9 * math.pi * 3, rows=60)
    pulled_up = showing(turn, np.full(len(turn.t_s), 7.0))  # inputs without sensors
    assert judge_halls(pulled_up).verdict == NOT_SEEN
    short = with_halls(turned(2, way_rad=0.9 * math.pi * 2, rows=60), "bac", pole_pairs=2)
    assert (judge_halls(short).verdict, "identify hall" in judge_halls(short).shown) == (NOT_SEEN, True)
    open_wire = judge_halls(showing(turn, with_halls(turn, "abc")["hall_pattern"] // 2.0 * 2.0))
    assert (open_wire.verdict, "wire 1 does not change" in open_wire.shown) == (WRONG, True)


@pytest.mark.parametrize("turn", [turned(1e9), turned(3, lag_rad=math.radians(50.0))])
def test_a_rotor_that_is_held_or_slips_says_nothing_of_the_rest(turn: Trace) -> None:
    rows = judge_turn(turn, 3, False)
    assert [(row.looked_at, row.verdict) for row in rows] == [
        ("shaft", WRONG), ("pole pairs", NOT_SEEN), ("encoder sign", NOT_SEEN),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("rest", "loaded", "stated", "verdict"),
    [(48.0, 48.0, 48.0, OK), (48.0, 40.0, 48.0, WRONG), (24.0, 24.0, 48.0, WRONG), (75.0, 75.0, 48.0, WRONG),
     (24.0, 24.0, None, OK)],
)  # fmt: skip
def test_the_supply(rest: float, loaded: float, stated: float | None, verdict: str) -> None:
    assert judge_supply(rest, turned(3, U_dc_v=loaded), stated).verdict == verdict


def test_the_supply_under_the_levels_of_R() -> None:
    def link(volts: float) -> Trace:
        return Trace(np.arange(3.0), {"U_dc_v": np.full(3, volts)}, {"U_dc_v": "V"}, {})

    found = supply_under_load(link(210.0), link(126.0))
    assert found is not None and found.verdict == WRONG and "current limit" in found.likely
    assert supply_under_load(link(210.0), link(205.0)).verdict == OK  # type: ignore[union-attr]
    assert supply_under_load(Trace(np.arange(3.0), {}, {}, {}), link(205.0)) is None  # recorded before there was one


@pytest.mark.parametrize(("gain", "offset", "verdict"), [(1.0, 0.3, OK), (1.02, 0.0, OK), (1.1, 0.0, WRONG)])
def test_a_sensor_of_another_gain_is_seen_and_an_offset_is_not(gain: float, offset: float, verdict: str) -> None:
    angles = np.array([0.0, 2.0, 4.0]) * math.pi / 3.0
    phases = [np.cos(angles - k * 2.0 * math.pi / 3.0) for k in range(3)]
    signals = {"i_a_a": phases[0] + offset, "i_b_a": gain * phases[1], "i_c_a": phases[2], "i_d_a": np.ones(3)}
    trace = Trace(np.arange(3.0), signals, dict.fromkeys(signals, "A"), {})
    assert judge_sensors(trace).verdict == verdict


@pytest.mark.parametrize("source_ohm", [2.5, 10.0, 25.0])
def test_the_power_at_which_a_supply_gives_way_is_that_of_its_resistance(source_ohm: float) -> None:
    """210 V behind a resistance: the link U at the power P solves U (U_0 - U) = R P."""
    U_0_v, R_ohm = 210.0, 0.35
    i_a = np.array([5.0, -10.0, 28.0, -20.0])
    held_w = 1.5 * R_ohm * i_a**2
    U_v = 0.5 * (U_0_v + np.sqrt(U_0_v**2 - 4.0 * source_ohm * held_w))
    at_rest = Trace(np.arange(3.0), {"U_dc_v": np.full(3, U_0_v)}, {"U_dc_v": "V"}, {})
    signals = {"U_dc_v": U_v, "i_d_a": i_a, "u_d_v": R_ohm * i_a}
    loaded = Trace(np.arange(4.0), signals, {"U_dc_v": "V", "i_d_a": "A", "u_d_v": "V"}, {})
    found_w, largest_w = supply_power(at_rest, loaded)
    assert largest_w == pytest.approx(held_w[2])
    assert found_w == pytest.approx(0.1 * 0.9 * U_0_v**2 / source_ohm, rel=1e-9)
    stiff = Trace(np.arange(4.0), {**signals, "U_dc_v": np.full(4, 0.991 * U_0_v)}, loaded.units, {})
    assert (
        supply_power(at_rest, stiff)[0] == supply_power(at_rest, replace(loaded, signals={}, units={}))[0] == math.inf
    )
