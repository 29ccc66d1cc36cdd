# SPDX-License-Identifier: MIT
"""What every drive owes the port, whatever bus it stands behind."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.cia402 import State
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.port import Excitation, Injection, Shape
from pmsmtool.errors import DriveFault, LimitExceeded, NotAvailable, SdoAbort

ENVELOPE = Envelope(i_max_apk=3.0, speed_max_rad_s=100.0)
CURRENT_TOLERANCE_A = 0.05
"""Mean current over 1000 periods against its reference; measured 0.001 A on ``interior-2k2``."""


class DriveContract:
    """Subclasses give the fixture ``drive``."""

    def test_identity_and_period(self, drive: CanopenDrive) -> None:
        assert drive.identity.vendor == 0x706D736D and drive.identity.serial != 0 and drive.identity.name
        assert 1e-5 < drive.period_s < 1e-3

    def test_a_set_of_another_layout_is_refused(self, drive: CanopenDrive, monkeypatch: pytest.MonkeyPatch) -> None:
        drive.parameters.check_layout()
        monkeypatch.setattr("pmsmtool.drive.parameters.layout_signature", lambda: 7)
        with pytest.raises(NotAvailable, match="signature 0x00000007"):
            drive.parameters.check_layout()

    def test_parameters_are_written_and_read_back(self, drive: CanopenDrive) -> None:
        old = drive.read("motor.R_s_ohm")
        drive.write({"motor.R_s_ohm": 0.25, "motor.pole_pairs": 5})
        assert drive.read("motor.R_s_ohm") == 0.25 and drive.read("motor.pole_pairs") == 5
        drive.write({"motor.R_s_ohm": old})

    def test_unknown_names_and_values_out_of_bounds(self, drive: CanopenDrive) -> None:
        with pytest.raises(NotAvailable):
            drive.read("motor.R_s")
        with pytest.raises(ValueError, match="outside"):
            drive.write({"motor.R_s_ohm": -1.0})

    def test_only_live_gains_change_while_enabled(self, drive: CanopenDrive) -> None:
        gain = drive.read("current.K_p_d_v_per_a")
        drive.enable()
        drive.write({"current.K_p_d_v_per_a": 1.01 * gain})
        assert drive.read("current.K_p_d_v_per_a") == pytest.approx(1.01 * gain, rel=1e-6)
        with pytest.raises(DriveFault, match="while the drive is enabled"):
            drive.write({"motor.R_s_ohm": 0.3})
        drive.quick_stop()

    def test_states(self, drive: CanopenDrive) -> None:
        drive.enable()
        assert drive.node.state() is State.OPERATION_ENABLED
        drive.disable()
        assert drive.node.state() is State.SWITCH_ON_DISABLED
        drive.enable()
        drive.quick_stop()
        assert drive.node.state() is State.SWITCH_ON_DISABLED and not drive.may_be_energised

    def test_current_at_a_fixed_angle(self, drive: CanopenDrive) -> None:
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(1.0, 0.0, fixed_angle_rad=0.0)
            guard.wait(0.3)
            means = guard.average(["i_d_a", "i_q_a", "u_d_v"], 1000)
        assert means["i_d_a"] == pytest.approx(1.0, abs=CURRENT_TOLERANCE_A)
        assert means["i_q_a"] == pytest.approx(0.0, abs=CURRENT_TOLERANCE_A)
        assert means["u_d_v"] > 0.0

    def test_trace_of_an_excitation(self, drive: CanopenDrive) -> None:
        square = Excitation(
            Shape.SQUARE, Injection.U_D, 5.0, bias_d_a=1.0, bias_bandwidth_rad_s=94.0, hold_periods=6,
            fixed_angle_rad=0.0,
        )  # fmt: skip
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(1.0, 0.0, fixed_angle_rad=0.0)
            guard.wait(0.2)
            trace = guard.record(["i_d_a", "u_d_v", "theta_e_rad", "flags"], 1024, excitation=square, pretrigger=64)
        assert len(trace) == 1024 and trace.units["i_d_a"] == "A" and trace.units["flags"] == "1"
        assert trace.t_s[64] == 0.0 and trace.period_s == pytest.approx(drive.period_s, rel=1e-9)
        before, after = trace["u_d_v"][:60], trace["u_d_v"][70:]
        assert np.ptp(before) < 5.0 < np.ptp(after), "the wave starts at the trigger"
        assert np.all(np.abs(trace["theta_e_rad"]) < 1e-6)
        assert trace.meta["excitation"]["shape"] == "square" and trace.meta["voltage_lag"] in (0, 1, 2)

    def test_trace_after_a_lead_shows_the_settled_wave_only(self, drive: CanopenDrive) -> None:
        sine = Excitation(Shape.SINE, Injection.U_D, 5.0, f0_hz=200.0, fixed_angle_rad=0.0, lead_s=0.05)
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            trace = guard.record(["u_d_v"], 1200, excitation=sine)
        assert np.ptp(trace["u_d_v"][:120]) > 5.0, "the wave runs from the first row on"

    def test_recording_without_excitation(self, drive: CanopenDrive) -> None:
        trace = drive.record(["i_a_a", "i_b_a", "i_c_a", "U_dc_v"], 512, decimation=2)
        assert len(trace) == 512 and trace.period_s == pytest.approx(2 * drive.period_s, rel=1e-9)
        assert np.std(trace["i_a_a"]) < 0.1 and np.mean(trace["U_dc_v"]) > 10.0

    def test_what_the_recorder_cannot_hold(self, drive: CanopenDrive) -> None:
        with pytest.raises(NotAvailable, match="do not fit"):
            drive.record(["i_d_a"] * 8, 16384)
        with pytest.raises(NotAvailable, match="no signal"):
            drive.record(["i_x_a"], 16)

    def test_envelope_is_kept(self, drive: CanopenDrive) -> None:
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            with pytest.raises(LimitExceeded, match="current"):
                guard.command_current(2.5, 2.5)
            with pytest.raises(LimitExceeded, match="speed"):
                guard.command_speed(101.0)
            with pytest.raises(LimitExceeded, match="current"):
                guard.record(["i_d_a"], 100, excitation=Excitation(Shape.SINE, Injection.I_D, 2.0, bias_d_a=1.5))
        assert drive.node.state() is State.SWITCH_ON_DISABLED

    def test_dead_man_is_proven_before_anything_is_enabled(self, drive: CanopenDrive) -> None:
        with guarded(drive, ENVELOPE) as guard:
            proof = guard.proof
            assert proof is not None and drive.node.state() is State.SWITCH_ON_DISABLED
        assert 0.0 < proof.measured_s <= proof.declared_s < 0.5

    def test_refused_objects_carry_their_address(self, drive: CanopenDrive) -> None:
        with pytest.raises(SdoAbort) as caught:
            drive.node.sdo.read(0x5FFF, 0)
        assert caught.value.code == 0x06020000 and "0x5FFF:00" in str(caught.value)

    def test_fixed_angle_follows_the_rotor_when_not_given(self, drive: CanopenDrive) -> None:
        with guarded(drive, ENVELOPE) as guard:
            guard.enable()
            guard.command_current(0.5, 0.0)
            guard.wait(0.05)
        assert math.isnan(float(np.frombuffer(drive.node.sdo.read(0x2052, 3), "<f4")[0]))
