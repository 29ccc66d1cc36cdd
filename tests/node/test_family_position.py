# SPDX-License-Identifier: MIT
"""One controller of the position and the cascade it is, behind the face of another family."""

from __future__ import annotations

import pytest

from pmsmtool.axis.drive import from_pid
from pmsmtool.axis.loops import AxisGains
from pmsmtool.bus.connect import connect
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.sim.node.position_modes import PID, cascade_of, pid_of


@pytest.mark.parametrize(("K_p", "K_i", "K_v"), [(0.9, 13.5, 15.0), (2.0, 40.0, 12.0), (0.1, 0.0, 9.0)])
def test_a_cascade_is_its_pid_and_comes_back(K_p: float, K_i: float, K_v: float) -> None:
    gains = AxisGains(K_p, K_i, K_v)
    assert pid_of(K_p, K_i, K_v) == pytest.approx(dict(zip(PID, gains.pid, strict=True)))
    back = cascade_of(pid_of(K_p, K_i, K_v))
    assert pid_of(*back) == pytest.approx(pid_of(K_p, K_i, K_v))
    assert from_pid(*gains.pid, AxisGains(*back)).K_v == pytest.approx(back[2])
    assert cascade_of(dict.fromkeys(PID, 0.0)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("mode", "moving"), [(1, True), (9, False)])
def test_each_mode_has_its_own_gains_behind(mode: int, moving: bool) -> None:
    with connect("pmsmsim", "interior-2k2?drive=epos4&nv=:memory:") as connection:
        node = DriveNode(connection, 1, drive_map=load_family("epos4"))
        inner = connection.bus.line.nodes[0].session.dictionary["speed.K_p_nms_per_rad"]  # type: ignore[attr-defined]
        own = inner.number()
        assert own > 0.0
        held = int.from_bytes(node.sdo.read(0x30A2, 1), "little")
        node.sdo.download(0x30A2, 1, (2 * held).to_bytes(4, "little"))
        node.sdo.download(0x6060, 0, bytes([mode]))
        assert inner.number() == pytest.approx(own if moving else 2.0 * own, rel=1e-5)
        node.sdo.download(0x6060, 0, bytes([10 - mode]))
        assert inner.number() == pytest.approx(2.0 * own if moving else own, rel=1e-5)
        node.close()


@pytest.mark.parametrize(("family", "index"), [("epos4", 0x6081), ("ingenia", 0x2025)])
def test_a_stored_profile_acts_after_a_reset(family: str, index: int) -> None:
    """An EPOS4 showed the stored 1140 rpm and moved at 60: new gains seemed to follow 24 times better."""
    with connect("pmsmsim", f"interior-2k2?drive={family}&nv=:memory:") as connection:
        node = DriveNode(connection, 1, drive_map=load_family(family))
        hardware = connection.bus.line.nodes[0]  # type: ignore[attr-defined]
        item = DriveObject(index, 0, "f" if family == "ingenia" else "I")
        speed, before = node.get(item), hardware.session.dictionary["cia402.profile_velocity"].number()
        node.put(item, 19 * speed)
        node.store()
        node.reset()
        assert node.get(item) == 19 * speed
        assert hardware.session.dictionary["cia402.profile_velocity"].number() == pytest.approx(19 * before)
        node.close()
