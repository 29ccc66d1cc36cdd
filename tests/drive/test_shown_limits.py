# SPDX-License-Identifier: MIT
"""The drive's own limits are shown to act before they are relied on; one that does not act is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import cast

import pytest

from pmsmtool.drive.guard import WATCH_S, GuardedDrive, guarded
from pmsmtool.drive.port import Drive
from pmsmtool.drive.standard_drive import TorqueCurrent
from pmsmtool.drive.torque_drives import TorqueDrive
from pmsmtool.errors import SafetyRefusal
from pmsmtool.experiments import current_limit
from pmsmtool.experiments.current_limit import (
    OVER,
    LimitShown,
    require_limit,
    show_current_limit,
    show_speed_limit,
    show_torque_limit,
    unproven,
)
from pmsmtool.experiments.mechanics_run import acceleration_per_ampere
from pmsmtool.identification.by_pulses import FACTS, dump_facts, read_facts
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.measurement.by_pulses import push_by_torque
from pmsmtool.run_directory import RunDirectory
from pmsmtool.sim.node.factory import set_up_values
from pmsmtool.sim.node.power_drive import RAD_S_PER_MRPM, PowerDrive
from pmsmtool.sim.node.session import Session
from tests.drive.test_limits_contract import ENVELOPE, POLE_PAIRS, STOP_S, Rig, opened, stopped

SHOWN = 0.06
"""What a limit was shown to keep, relative: measured within 0.004 by the current, 0.037 by the way of the shaft."""


def shown_limit(rig: Rig, guard: GuardedDrive) -> LimitShown | None:
    """Along a vector the rotor lies on, or by a push of an aligned rotor."""
    guard.enable()
    if not isinstance(rig.drive, TorqueCurrent):
        return show_current_limit(guard, guard.limit_current, 6.0, ENVELOPE.i_max_apk, 0.0)
    least = 10.0 / rig.counts_per_turn * 2.0 * math.pi
    answer = acceleration_per_ampere(guard, ENVELOPE.i_max_apk, lambda way, seconds: way > least)
    return show_torque_limit(guard, guard.limit_current, answer, ENVELOPE.i_max_apk)


@pytest.mark.parametrize("name", ["full", "recorder", "torque"])
def test_the_current_limit_is_shown_to_act(name: str, tmp_path: Path) -> None:
    with opened(name, tmp_path) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            limit = [rig.session.dictionary["cia402.max_current"].number()]
            shown = shown_limit(rig, guard)
            assert [rig.session.dictionary["cia402.max_current"].number()] == limit, "the envelope's holds again"
        assert shown is not None and shown.proven and "limit proven" in str(shown) and not unproven(shown)
        assert shown.asked >= OVER * shown.kept * (1.0 - 1e-9)
        assert shown.seen == pytest.approx(shown.kept, rel=SHOWN)
        assert rig.memory() == before


@pytest.mark.parametrize("name", ["full", "recorder", "torque"])
def test_a_current_limit_that_does_not_act_is_told(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The object holds what was written, and the drive gives what is asked for."""
    monkeypatch.setattr(
        Session, "_load_core", lambda self: self.hardware.take_parameters(self.parameters.active.copy().pack())
    )
    with opened(name, tmp_path) as rig, guarded(rig.drive, ENVELOPE) as guard:
        shown = shown_limit(rig, guard)
        assert shown is not None and not shown.acts
        assert shown.seen == pytest.approx(shown.asked, rel=SHOWN)
        assert "every command is bounded here" in unproven(shown), "a line of the report"
        with pytest.raises(SafetyRefusal, match="does not keep its own current limit"):
            require_limit(shown)


class Swinging:
    """A shaft that slipped a cog: windows of the current (A) that a simulated drive gave, limited to 2.116 A."""

    period_s = 100e-6
    windows = (0.870, 1.878, 1.923, 1.755, 1.978, 2.781, 2.767, 2.063, 1.799, 1.856, 1.977, 2.386, 2.468, 2.131)
    windows += (1.906, 1.991, 2.205, 2.283, 2.147, 2.034, 2.062, 2.162, 2.170, 2.128, 2.106, 2.097, 2.116, 2.122)

    def __init__(self, scale: float) -> None:
        self._left = [scale * window for window in self.windows]

    def average(self, names: tuple[str, ...], periods: int) -> dict[str, float]:
        return {"i_d_a": self._left.pop(0), "i_q_a": 0.0}


@pytest.mark.parametrize(("scale", "seen"), [(1.0, 2.11), (1.5, 3.18)])
def test_a_swinging_shaft_hides_no_limit_and_shows_none(
    scale: float, seen: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first window that stands may be 1.3 times the limit: measured 2.77 A of 2.12 A."""
    monkeypatch.setattr(current_limit, "ARRIVAL_LIMIT_S", len(Swinging.windows) * current_limit.WINDOW_S)
    given = current_limit._settled(cast(Drive, Swinging(scale)), 2.116)
    assert given == pytest.approx(seen, rel=SHOWN)
    assert LimitShown(3.17, 2.116, given, current_limit.MOST * 2.116).acts == (scale == 1.0)


TURNING_A, TURNING_S, SLOW_RPM_PER_S = 3.0, 0.2, 150.0
"""A current, and its time, that leave a shaft turning; a ramp that takes longer to stop it than the trial waits."""


def speed_shown(
    rig: Rig, guard: GuardedDrive, *, quick: bool = False, acceleration_rpm_per_s: float = 1500.0
) -> LimitShown | None:
    machine = load_machine_file(machine_path("interior-2k2"))
    J = machine.machine.J_kgm2 or 0.0
    loop = {"K_p_nms_per_rad": 50.0 * J, "K_i_nm_per_rad": 625.0 * J, "tau_max_nm": 3.0}
    loop["acceleration_rpm_per_s"] = acceleration_rpm_per_s
    guard.write({**set_up_values(machine), **{f"speed.{name}": value for name, value in loop.items()}})
    return show_speed_limit(guard, guard.limit_speed, ENVELOPE.speed_max_rad_s, POLE_PAIRS, quick=quick)


@pytest.mark.chain
@pytest.mark.parametrize(("name", "quick"), [("full", False), ("inject", False), ("full", True)])
def test_the_speed_limit_is_shown_to_act(name: str, quick: bool, tmp_path: Path) -> None:
    """On every class that is commanded a speed; measured within 0.2 %."""
    with opened(name, tmp_path) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            limit = rig.session.dictionary["cia402.max_speed"].number()
            shown = speed_shown(rig, guard, quick=quick)
            assert rig.session.dictionary["cia402.max_speed"].number() == limit, "the envelope's holds again"
            assert not rig.energised
        assert shown is not None and shown.proven and "speed limit proven" in str(shown) and not unproven(shown)
        assert shown.asked == pytest.approx(OVER * shown.kept)
        assert shown.kept <= (0.2 if quick else 0.1) * ENVELOPE.speed_max_rad_s
        assert shown.seen == pytest.approx(shown.kept, rel=SHOWN)
        assert rig.memory() == before


@pytest.mark.chain
def test_a_shaft_that_still_turns_is_stopped_first(tmp_path: Path) -> None:
    """A heavy shaft kept 4 times the limit from the pushes before, longer than the trial waits for a speed."""
    with opened("full", tmp_path) as rig, guarded(rig.drive, ENVELOPE) as guard:
        guard.enable()
        guard.command_current(0.0, -TURNING_A)
        guard.wait(TURNING_S)
        before = guard.live("omega_e_rad_s") / POLE_PAIRS
        guard.disable()
        shown = speed_shown(rig, guard, acceleration_rpm_per_s=SLOW_RPM_PER_S)
        assert shown is not None and before < -3.0 * shown.kept
        assert shown.proven and shown.seen == pytest.approx(shown.kept, rel=SHOWN)


@pytest.mark.chain
def test_a_speed_limit_that_does_not_act_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The object holds what was written, and the shaft turns as fast as it is asked to; so a run is refused."""
    monkeypatch.setattr(
        Session, "_load_core", lambda self: self.hardware.take_parameters(self.parameters.active.copy().pack())
    )
    monkeypatch.setattr(PowerDrive, "_target_speed", lambda self: self._number("target_velocity") * RAD_S_PER_MRPM)
    with opened("full", tmp_path) as rig, guarded(rig.drive, ENVELOPE) as guard:
        shown = speed_shown(rig, guard)
        assert shown is not None and not shown.acts and shown.seen == pytest.approx(shown.asked, rel=SHOWN)
        with pytest.raises(SafetyRefusal, match="does not keep its own speed limit") as caught:
            require_limit(shown)
        assert "0x6080" in caught.value.likely


def test_a_drive_without_a_speed_limit_is_told(tmp_path: Path) -> None:
    with opened("full", tmp_path) as rig, guarded(rig.drive, ENVELOPE) as guard:
        assert show_speed_limit(guard, lambda rad_s: None, 100.0, POLE_PAIRS) is None
        assert "speed limit not proven" in unproven(None, "speed")


@pytest.mark.chain
def test_a_limit_that_does_not_act_is_kept_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every command is bounded, so the run goes on; its report says it, replayed or not."""
    monkeypatch.setattr(
        Session, "_load_core", lambda self: self.hardware.take_parameters(self.parameters.active.copy().pack())
    )
    with opened("torque", tmp_path) as rig:
        assert isinstance(rig.drive, TorqueDrive)
        facts = push_by_torque(rig.drive, ENVELOPE, lambda name, trace: None, lambda text: None)
    assert facts.limit.startswith("the drive does not keep its own current limit")
    (tmp_path / FACTS).write_text(dump_facts(facts), encoding="utf-8")
    kept = read_facts(RunDirectory(tmp_path))
    assert kept is not None and kept.limit == facts.limit


@pytest.mark.parametrize("name", ["full", "recorder"])
def test_a_value_that_is_no_number(name: str, tmp_path: Path) -> None:
    """A drive that shows NaN keeps no limit; those of the standard's objects show whole numbers."""
    for what in ("current", "speed"):
        with opened(name, tmp_path) as rig:
            show = rig.show_current if what == "current" else rig.show_turning
            stopped(rig, ENVELOPE, lambda guard: show(math.nan), what, WATCH_S + STOP_S)  # noqa: B023
