# SPDX-License-Identifier: MIT
"""Values that lie on a bound, and conversions that the longer tests leave out."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from pmsmtool.cia402 import LEAST_LINK_V
from pmsmtool.drive import motion_objects as motion
from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Recording
from pmsmtool.drive.position_drive import PositionDrive
from pmsmtool.drive.recorder_drives import LINEAR_SHARE, MappedRecorderDrive
from pmsmtool.drive_maps.drive_map import LETTERS
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import NotAvailable
from pmsmtool.trace import Trace
from tests.drive.table_drive import node_of


class Recorded(MappedRecorderDrive):
    """A drive of two pole pairs whose recorder holds four rows; its link shows 300 V."""

    U_dc_v = 300.0

    def __init__(self, trace: Trace) -> None:
        self.asked: list[Any] = []
        self.trace = trace
        self.traces = cast(Any, SimpleNamespace(fetch=self._fetch))
        self._apart, self._own_pole_pairs = 3, 2.0

    def _fetch(self, *asked: Any) -> Trace:
        self.asked.append(asked)
        return self.trace

    def live(self, name: str) -> float:
        return self.U_dc_v

    def coast(self) -> None: ...

    def check_operating(self) -> None: ...


def test_a_makers_record_by_the_names_asked_for() -> None:
    """Electrical speed and the samples at the linear range's end are of the program's making; every third row fits."""
    top = LINEAR_SHARE * 300.0 / math.sqrt(3.0)
    u = np.array([0.0, 0.99 * top, 1.01 * top, -1.01 * top])
    signals = {"omega_M_rad_s": np.arange(4.0), "i_q_a": np.ones(4), "u_d_v": np.zeros(4), "u_q_v": u}
    drive = Recorded(Trace(np.arange(4.0), signals, dict.fromkeys(signals, "1")))
    found = drive.finish_record(Recording(("omega_e_rad_s", "i_q_a", "u_d_v", "u_q_v", "flags"), 12, decimation=2))
    assert drive.asked[0][1] == 6
    assert found["omega_e_rad_s"].tolist() == [0.0, 2.0, 4.0, 6.0] and found["i_q_a"].tolist() == [1.0] * 4
    assert found["flags"].tolist() == [0.0, 0.0, 1.0, 1.0]
    bare = Recorded(Trace(np.arange(4.0), {"u_d_v": u, "u_q_v": np.zeros(4)}, {"u_d_v": "V", "u_q_v": "V"}))
    assert bare.finish_record(Recording(("flags",), 4))["flags"].tolist() == [0.0, 0.0, 1.0, 1.0]
    without = {name: values for name, values in signals.items() if name != "u_d_v"}
    bare = Recorded(Trace(np.arange(4.0), without, dict.fromkeys(without, "1")))
    assert not bare.finish_record(Recording(("i_q_a", "flags"), 4))["flags"].any()


@pytest.mark.parametrize(
    ("link_v", "said"),
    [
        (LEAST_LINK_V - 1e-3, "is off: the DC link has 5 V, where 0x6079 counts mV"),
        (LEAST_LINK_V, "5 V"),
        (24.0, "24 V"),
    ],
)
def test_the_link_tells_the_supply_from_the_inputs(link_v: float, said: str) -> None:
    with node_of({objects.DC_LINK_MV: round(1e3 * link_v)}) as (_, node):
        assert said in node._kept_off_by()


def test_a_drive_that_another_program_has_in_hand_says_so() -> None:
    with node_of({objects.DC_LINK_MV: 24_000, objects.STATUSWORD: 0x0040}) as (table, node):
        assert "takes no commands from the bus (statusword, bit 9" in node._kept_off_by()
        table.objects[0x6041, 0] = (0x0240).to_bytes(2, "little")
        assert "STO" in node._kept_off_by()


def test_a_position_factor_that_says_nothing_new() -> None:
    """4000 increments of the encoder are 2000 units of a factor 2: both say the same of a turn."""
    turn = {motion.POSITION: 0, motion.ENCODER_COUNTS: 4000, motion.FEED: 2000, motion.FACTOR: 2}
    with node_of(turn) as (_, node):
        assert motion.position_units(node) == 2000.0
    with node_of({**turn, motion.FEED: 2000, motion.FACTOR: 4, motion.FACTOR_DIVISOR: 2}) as (_, node):
        assert motion.position_units(node) == 2000.0
    with node_of({**turn, motion.ENCODER_COUNTS: 8000, motion.MOTOR_TURNS: 2}) as (_, node):
        assert motion.position_units(node) == 2000.0
    with node_of({**turn, motion.FACTOR: 4}) as (_, node), pytest.raises(NotAvailable, match="factor of 4"):
        motion.position_units(node)


def test_the_angle_of_one_count() -> None:
    drive = object.__new__(PositionDrive)
    drive.counts_per_turn = -4000
    assert drive.rad_per_count == pytest.approx(2.0 * math.pi / 4000.0, rel=1e-15)


def test_a_value_is_held_where_map_and_drive_have_it() -> None:
    """Not of another type than the map's, nor without the value that it counts in, nor what no map names."""
    family = load_family("ingenia")
    K_i, K_p = (family.cells[f"current.{name}"] for name in ("K_i_q_v_per_as", "K_p_q_v_per_a"))
    assert K_i.gain == K_p.name
    gain, rate = (DriveObject(cell.index, cell.sub, LETTERS[cell.wire]) for cell in (K_p, K_i))
    with node_of({gain: 2, rate: 3}, family) as (table, node):
        values = DriveParameters(node)
        assert values.held_value(K_i.name) == values.read_value(K_i.name) > 0.0
        assert values.held_value("motor.warp_factor") is None
        table.objects[rate.index, rate.sub] += b"\0"
        assert values.held_value(K_i.name) is None and values.held_value(K_p.name) == values.read_value(K_p.name)
        del table.objects[gain.index, gain.sub]
        assert values.held_value(K_i.name) is None
