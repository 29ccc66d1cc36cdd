# SPDX-License-Identifier: MIT
"""The first check of drives that show less: what is wrong is named where it shows, the rest is listed, none passes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from benchmarks.random_drives import draw_drive
from pmsmtool.commissioning.first_check import led_beyond
from pmsmtool.commissioning.first_check_levels import _supply as link_row
from pmsmtool.commissioning.first_check_levels import _whole, beyond, judge_kept, unmoved
from pmsmtool.drive.port import Drive
from pmsmtool.errors import IdentificationError, LimitExceeded
from pmsmtool.experiments.first_turn import WAY_RAD, push_forth_and_back
from pmsmtool.identification.by_pulses import NO_LINK, no_link
from pmsmtool.identification.wiring import NOT_CHECKED, NOT_SEEN, WRONG, judge_current, judge_pulses, judge_push
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, machine_path
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame
from pmsmtool.trace import Trace
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import epos4, unknown, write_eds


def checked(tool: Tool, level: str, extra: str = "encoder_bits = 17") -> tuple[int, dict[str, str]]:
    text = dump_machine_file(load_machine_file(machine_path("interior-2k2")))
    Path("sheet.toml").write_text(text, encoding="utf-8")
    lines = text.splitlines()
    at = lines.index("[simulation]") + 1
    rest = [line for line in lines[at:] if line.partition(" ")[0] != extra.partition(" ")[0]]
    Path("drive.toml").write_text("\n".join([*lines[:at], extra, *rest]), encoding="utf-8")
    channel = f"drive.toml?nv=:memory:&{level}"
    code, out, told = tool("-i", "pmsmsim", "-c", channel, "check", "sheet.toml", "--yes", "--json")
    assert "at most 15 s" in told and "NOT CHECKED" in told
    return code, {row["looked_at"]: row["verdict"] for row in json.loads(out)["findings"]}


@pytest.mark.chain
@pytest.mark.parametrize(
    ("extra", "wrong"),
    [
        ("encoder_bits = 17", ""), ("leads_swapped = true", "encoder sign"), ("U_dc_v = 300.0", "supply"),
        ('rotor = "locked"', "shaft"), ('phase_open = "b"', "phases"), ("encoder_bits = 15", "encoder counts"),
    ],
)  # fmt: skip
def test_a_drive_with_a_recorder(extra: str, wrong: str, tool: Tool) -> None:
    code, rows = checked(tool, "level=recorder", extra)
    assert [name for name, verdict in rows.items() if verdict == WRONG] == ([wrong] if wrong else []), rows
    assert code == (1 if wrong else 10)
    assert rows["current sensors"] == NOT_CHECKED


@pytest.mark.chain
def test_a_makers_drive_lists_what_it_cannot_show(tool: Tool, tmp_path: Path) -> None:
    code, rows = checked(tool, f"eds={write_eds(tmp_path / 'x.eds', epos4())}")
    assert code == 10 and rows["shaft"] == rows["encoder sign"] == "ok"
    assert {name for name, verdict in rows.items() if verdict == NOT_CHECKED} == {
        "supply", "phases", "current sensors", "pole pairs",
    }  # fmt: skip


def test_without_a_machine_file_nothing_moves(tool: Tool) -> None:
    code, _, told = tool("-i", "pmsmsim", "-c", "interior-2k2?nv=:memory:&level=recorder", "check", "--yes")
    assert code == 2 and "MACHINE is missing" in told


def pushed(i_q_a: tuple[float, float], way_rad: tuple[float, float]) -> dict[str, str]:
    signals = {"i_command_a": np.array([1.0, -1.0]), "i_q_a": np.array(i_q_a), "way_rad": np.array(way_rad)}
    return {
        row.looked_at: row.verdict
        for row in judge_push(Trace(np.array([0.0, 1.0]), signals, dict.fromkeys(signals, ""), {}))
    }


def test_pushes_are_judged_by_current_way_and_sign() -> None:
    assert pushed((0.9, -0.9), (0.3, -0.2)) == {"shaft": "ok", "encoder sign": "ok"}
    assert pushed((0.9, -0.9), (-0.3, 0.2)) == {"shaft": "ok", "encoder sign": WRONG}
    assert pushed((0.9, -0.9), (0.3, 0.2)) == {"shaft": WRONG}
    assert pushed((0.1, -0.1), (0.0, 0.0)) == {"phases": WRONG, "shaft": "not seen"}
    assert pushed((0.71, -0.71), (0.3, -0.2))["shaft"] == "ok", "a reading as peak of what is rms"


@pytest.mark.parametrize(("way_rad", "how"), [((0.13, 0.0), "one way alone"), ((0.3, 0.2), "both the same way")])
def test_a_shaft_that_does_not_come_back_names_an_open_phase(way_rad: tuple[float, float], how: str) -> None:
    """Before, a simulated EPOS4 with an open phase a was blamed on its load or its encoder."""
    signals = {"i_command_a": np.array([1.0, -1.0]), "i_q_a": np.array([0.9, -0.9]), "way_rad": np.array(way_rad)}
    (found,) = judge_push(Trace(np.array([0.0, 1.0]), signals, dict.fromkeys(signals, ""), {}))
    assert found.likely.startswith("a motor lead that is not connected;") and found.shown.endswith(how)


@pytest.mark.parametrize(
    ("shares", "way", "kept"),
    [
        ((0.9, 0.9), 0.1, True), ((0.71, 0.65), 0.1, True), ((1.41, 1.3), 0.3, True), ((0.33, 0.9), 0.1, False),
        ((1.6, -0.05), 0.3, False), ((0.28, 0.52), 0.3, True),  # a slow current loop moves the shaft all the same
    ],
)  # fmt: skip
def test_a_push_without_its_current_is_about_the_phases(shares: tuple[float, float], way: float, kept: bool) -> None:
    signals = {
        "i_command_a": np.array([2.0, -2.0]), "i_q_a": np.array([2.0, -2.0]) * shares, "way_rad": np.array([way, -way]),
    }  # fmt: skip
    found = judge_kept(Trace(np.array([0.0, 1.0]), signals, dict.fromkeys(signals, "A"), {}))
    assert [row.looked_at for row in found if row.verdict == WRONG] == ([] if kept else ["phases"])


def test_a_current_that_breaks_in_at_some_angles_is_an_open_phase() -> None:
    angle = np.linspace(0.0, 6.0, 61)
    whole = {"i_q_a": np.full(61, 0.9), "at_rest": np.zeros(61)}
    assert not judge_current(Trace(angle, whole, dict.fromkeys(whole, ""), {}), 1.0)
    (found,) = judge_current(Trace(angle, {**whole, "i_q_a": np.sin(angle)}, dict.fromkeys(whole, ""), {}), 1.0)
    assert found.looked_at == "phases" and found.verdict == WRONG


class SlowLoop:
    """A shaft of 1000 rad/s2 per ampere, without friction, behind a current loop of 60 ms."""

    def __init__(self) -> None:
        self.asked_a = self.i_a = self.omega = self.theta = self.furthest = 0.0

    def command_current(self, i_d_a: float, i_q_a: float) -> None:
        self.asked_a = i_q_a

    def wait(self, seconds: float) -> None:
        for _ in range(round(seconds / 1e-3)):
            self.i_a += (self.asked_a - self.i_a) / 60.0
            self.omega += self.i_a
            self.theta += 1e-3 * self.omega
            self.furthest = max(self.furthest, abs(self.theta))

    def live(self, name: str) -> float:
        return {"theta_m_rad": self.theta, "i_q_a": self.i_a}[name]


def test_a_slow_current_loop_does_not_push_the_shaft_further() -> None:
    """Short pushes show a tenth of its acceleration: by them the push would go on for three ways and more."""
    drive = SlowLoop()
    pushes = push_forth_and_back(cast(Drive, drive), 1.0, 30.0)
    assert np.all(np.abs(pushes["way_rad"]) < 1.5 * WAY_RAD)
    assert drive.furthest < np.pi


@pytest.mark.parametrize(
    ("quantity", "turns", "about", "verdict"),
    [
        ("time energised", True, "shaft", NOT_SEEN), ("travel", True, "shaft", WRONG),
        ("travel", False, "phases", WRONG), ("current", True, "phases", WRONG),
    ],
)  # fmt: skip
def test_a_limit_is_about_what_it_shows(quantity: str, turns: bool, about: str, verdict: str) -> None:
    row = beyond(LimitExceeded(quantity, 2.0, 1.0, "A"), turns)
    assert (row.looked_at, row.verdict) == (about, verdict)
    if turns:  # the levels above push nothing; a rotor that swung for 15 s was WRONG there
        due = WRONG if quantity == "current" else verdict
        assert (led_beyond(LimitExceeded(quantity, 2.0, 1.0, "A")).verdict) == due


def test_a_shaft_that_little_current_does_not_move_is_not_held() -> None:
    """A motor of 48 A behind an EPOS2 of 5 A: a tenth of 5 A is 1.5 % of its current, and `shaft` was WRONG."""
    error = IdentificationError("E_EXCITATION", "the shaft does not move", likely="a closed brake")
    held, unseen = unmoved(error, False, 0.1), unmoved(error, False, 0.015)
    assert held.verdict == unmoved(error, False, 0.072).verdict == WRONG and held.likely == "a closed brake"
    assert unseen.verdict == NOT_SEEN and "1.5 % of the motor's rated current" in unseen.shown
    assert unseen.likely.startswith("friction, for want of current: a small drive for this motor")
    for row, why in ((held, "mend what is wrong first"), (unseen, "the check ended before it")):
        assert {other.looked_at: other.shown for other in _whole([row], False)}["encoder sign"] == why


@pytest.mark.chain
def test_answers_that_come_late_are_no_open_phase(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 ms an answer: a healthy light shaft ran beyond half a turn, and `phases` was WRONG."""
    drive = draw_drive(705)
    simulated = {**drive.simulation, "leads_swapped": False, "encoder_reversed": False}
    Path("m.toml").write_text(dump_machine_file(replace(drive, simulation=simulated)), encoding="utf-8")
    write_eds(Path("x.eds"), unknown("0x2D", (0x6079, 0, "U32", "ro", "")))
    hear = PmsmSimBus.hear

    def late(bus: PmsmSimBus, frame: Frame, own: bool) -> None:
        if own or not 0x580 < frame.can_id < 0x600:
            hear(bus, frame, own)
        else:
            bus.clock.after(0.02, lambda: hear(bus, frame, own))

    monkeypatch.setattr(PmsmSimBus, "hear", late)
    channel = "m.toml?nv=:memory:&eds=x.eds"
    code, out, _ = tool("--sim", channel, "--yes", "check", "m.toml", "--json")
    rows = {row["looked_at"]: (row["verdict"], row["shown"]) for row in json.loads(out)["findings"]}
    assert code == 10 and rows["phases"][0] == NOT_CHECKED and rows["shaft"][0] == NOT_SEEN
    assert "an answer takes 20 ms" in rows["shaft"][1]
    code, _, said = tool("--sim", channel, "--yes", "identify", "mechanics")
    assert code == 6 and "28 readings are needed in each of 4 torque pulses, 0 of 12 pulses have them" in said
    assert "answers slowly" in said


def pulsed(
    shown: float, sense: float, noise_rad: float = 0.0, seed: int = 1, sign: Callable[[float], float] = float
) -> list[tuple[str, str]]:
    """Verdicts on twelve pulses of which ``shown`` of the command is seen and that move the shaft in ``sense``."""
    rng, pulses = np.random.default_rng(seed), []
    for command in (0.3, -0.3, 0.3, -0.3, 0.5, -0.5, 0.5, -0.5, 0.7, -0.7, 0.7, -0.7):
        t = np.linspace(0.0, 0.08, 80)
        way = sense * 40.0 * command * t * t - 2.0 * command * t + rng.normal(0.0, noise_rad, len(t))
        signals = {"theta_M_rad": way, "i_q_a": np.full(len(t), shown * sign(command))}
        pulses.append(Trace(t, signals, {"theta_M_rad": "rad", "i_q_a": "A"}, {"i_command_a": command}))
    return [(row.looked_at, row.verdict) for row in judge_pulses(pulses)]


@pytest.mark.parametrize("seed", range(5))
def test_the_pulses_of_identify_show_a_missing_current_and_a_wrong_sign(seed: int) -> None:
    """The bend of the least pulse is 0.08 rad in its time; an encoder of 1024 counts leaves 2 mrad of noise."""
    assert pulsed(0.97, 1.0, 2e-3, seed) == pulsed(0.71, 1.0, 2e-3, seed) == []
    assert pulsed(0.97, -1.0, 2e-3, seed) == [("encoder sign", WRONG)]
    assert pulsed(0.21, 1.0, 2e-3, seed) == pulsed(0.0, 1.0, 2e-3, seed) == [("phases", WRONG)]
    for shown, sign in ((-0.97, float), (0.97, abs), (-0.97, abs)):  # as an open phase: "-89 % of the current"
        assert pulsed(shown, 1.0, 2e-3, seed, sign) == [("current sensors", WRONG)]


def pulses_of(shown: Callable[[float, float, float], float], top: float = 1e9) -> list[str]:
    """What is wrong by twelve pulses of 1 kHz whose share of the command depends on time, angle and speed."""
    pulses, theta, omega = [], 0.0, 0.0
    for sign, seconds in ((1.0, 0.04), (-1.0, 0.08), (1.0, 0.08), (-1.0, 0.04)) * 3:
        t = np.arange(0.0, seconds, 1e-3)
        speed = np.clip(omega + sign * 1000.0 * t, -top, top)
        angle = theta + np.cumsum(speed) * 1e-3
        share = np.array([shown(at, where, fast) for at, where, fast in zip(t, angle, speed / top, strict=True)])
        signals = {"theta_M_rad": angle, "i_q_a": sign * share}
        pulses.append(Trace(t, signals, dict.fromkeys(signals, ""), {"i_command_a": sign}))
        theta, omega = float(angle[-1]), float(speed[-1])
    return [row.looked_at for row in judge_pulses(pulses) if row.looked_at == "phases"]


def test_a_current_that_comes_late_or_ends_at_the_voltage_is_no_open_phase() -> None:
    """A dead time of 4.5 V kept a current away for 40 to 65 ms; another one ended at the top of every pulse."""
    late = pulses_of(lambda t, angle, fast: 0.02 if t < 0.06 else 0.3 + 20.0 * (t - 0.06))
    assert late == []
    assert pulses_of(lambda t, angle, fast: 0.11 if abs(fast) > 0.9 else 0.95, top=20.0) == []
    assert pulses_of(lambda t, angle, fast: 0.02 if t < 0.06 else 0.1) == ["phases"]  # it never comes
    assert pulses_of(lambda t, angle, fast: abs(np.sin(angle)) ** 3) == ["phases"]  # it breaks in at some angles
    assert pulses_of(lambda t, angle, fast: abs(np.sin(angle)) ** 3, top=20.0) == ["phases"]


@pytest.mark.chain
@pytest.mark.parametrize(
    ("key", "code", "named"),
    [
        ("leads_swapped=true", 10, "encoder sign: the position falls under positive torque"),
        ("phase_open=a", 6, "an open phase, or the supply in current limit"),
        ("drive_fault=not_connected", 6, "a motor lead that is not connected"),
        ("drive_fault=encoder_stuck", 6, "an encoder that does not count"),
        ("drive_fault=safe_torque_off", 4, "the safe-torque-off (STO) or enable input is open; the DC link has 540 V"),
    ],
)
def test_identify_names_wrong_wiring_of_an_epos4(tool: Tool, key: str, code: int, named: str) -> None:
    """Before, an open phase was called a shaft with little inertia, and swapped leads were not named at all."""
    channel = f"interior-2k2?nv=:memory:&drive=epos4&{key}&bitrate=250000"
    got, out, told = tool("-i", "pmsmsim", "-c", channel, "identify", "mechanics", "--yes", "--speed-max", "400rpm")
    assert got == code and named in out + told


@pytest.mark.parametrize(("counts", "unit"), [(48, "V"), (480, "0.1 V"), (4700, "0.01 V")])
def test_a_link_in_another_unit_is_no_supply_that_is_off(counts: int, unit: str) -> None:
    """A drive whose 0x6079 counts volts had its supply WRONG, and nothing else was looked at."""
    row = link_row(1e-3 * counts, None, 48.0)
    assert row.verdict == NOT_CHECKED and f"in {unit} it is the stated 48 V" in row.shown
    sagging = Trace(np.zeros(2), {"U_dc_v": 1e-3 * counts * np.array([1.0, 0.5])}, {"U_dc_v": "V"})
    assert link_row(1e-3 * counts, sagging, 48.0).verdict == WRONG
    assert link_row(1e-3 * counts, None, 300.0).verdict == WRONG


def test_a_link_that_an_energised_drive_cannot_have_tells_no_flux_linkage() -> None:
    """0.048 V: whatever the voltage limit then tells of the flux linkage, it is no measurement."""
    assert "0.048 V, so that its unit is another" in no_link(0.048)
    assert no_link(0.0) == NO_LINK
