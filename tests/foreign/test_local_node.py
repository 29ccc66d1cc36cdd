# SPDX-License-Identifier: MIT
"""A drive that is not ours: canopen's LocalNode with a maker's objects is asked, saved, restored and written."""

from __future__ import annotations

import json
import threading
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import canopen
import pytest

from pmsmtool.cli.main import run
from pmsmtool.params.catalogue import BY_NAME
from tests.foreign.data_sheets import Row, epos4, write_eds
from tests.simulated_bus import settle

pytestmark = [pytest.mark.chain, pytest.mark.wall_clock]

NODE, SERIAL = 9, 4711
CONSENT = ("--yes", "--serial", str(SERIAL))
STORE: tuple[Row, ...] = ((0x1010, 1, "U32", "rw", "1"), (0x1008, 0, "VSTR", "ro", "EPOS4"))
GAINS = {(0x30A0, 1): 1_171_880, (0x30A0, 2): 3_906_250}
SPEED_GAINS = ((0x30A2, 1), (0x30A2, 2))
Ask = Callable[..., tuple[int, str, str]]


class Drive:
    """The node, and how often it was reset."""

    def __init__(self, sheet: Path) -> None:
        self.channel = uuid.uuid4().hex
        self.resets = 0
        self.network = canopen.Network()
        self.network.NOTIFIER_CYCLE = 0.02
        self.network.connect(interface="virtual", channel=self.channel, ignore_config=True)
        self.node = self.network.create_node(NODE, canopen.import_od(str(sheet), NODE))
        self.node.nmt.state = "PRE-OPERATIONAL"
        for index, value in ((0x6041, 0x0240), (0x6061, 0), (0x6064, 0)):
            self.node.sdo[index].raw = value
        self.network.subscribe(0, self._command)

    def _command(self, can_id: int, data: bytearray, timestamp: float) -> None:
        if data[0] in (0x81, 0x82):  # LocalNode stays in INITIALISING and says nothing
            self.resets += 1
            threading.Timer(0.05, self._boot).start()

    def _boot(self) -> None:
        self.network.send_message(0x700 + NODE, b"\0")
        self.node.nmt.state = "PRE-OPERATIONAL"

    def holds(self, index: int, sub: int) -> int:
        """Return the number in an object."""
        return int(self.node.sdo[index][sub].raw)


@pytest.fixture
def drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Drive]:
    settle(tmp_path, monkeypatch)
    rows = [row for row in epos4() if row[:2] != (0x1018, 4)]
    blank = [(i, s, k, a, v or "1000") for i, s, k, a, v in rows]
    sheet = write_eds(tmp_path / "x.eds", [*blank, (0x1018, 4, "U32", "ro", str(SERIAL)), *STORE])
    drive = Drive(sheet)
    yield drive
    drive.network.disconnect()


@pytest.fixture
def ask(drive: Drive, capsys: pytest.CaptureFixture[str]) -> Ask:
    def call(*words: str) -> tuple[int, str, str]:
        code = run(["-i", "virtual", "-c", drive.channel, "-n", str(NODE), *words])
        return code, *capsys.readouterr()

    return call


def test_caps_tells_what_it_gives(ask: Ask) -> None:
    code, printed, said = ask("caps", "--json")
    assert code == 0, said
    facts = json.loads(printed)
    assert facts["map"] == "epos4" and facts["level"] == "standard"


def test_saved_changed_and_brought_back(drive: Drive, ask: Ask) -> None:
    code, printed, said = ask("backup", "--eds", "x.eds", "-o", "b.json")
    assert code == 0 and f"serial {SERIAL}" in printed, said
    for (index, sub), value in GAINS.items():
        drive.node.sdo[index][sub].raw = value + 1
    code, printed, said = ask("restore", "b.json", *CONSENT)
    assert code == 0 and "2 written" in printed, (printed, said)
    assert {at: drive.holds(*at) for at in GAINS} == GAINS and drive.resets == 1
    code, printed, _ = ask("restore", "b.json", *CONSENT)
    assert code == 0 and "nothing was done" in printed and drive.resets == 1


def test_a_set_is_written_stored_and_read_back(drive: Drive, ask: Ask) -> None:
    """Gains in the maker's counts: uV/A and uV/(A ms)."""
    assert BY_NAME["current.K_p_q_v_per_a"].unit == "V/A"
    Path("set.toml").write_text(
        'schema = "pmsmtool.params/1"\n[current]\nK_p_q_v_per_a = 2.5\nK_i_q_v_per_as = 1000.0\n'
    )
    code, printed, said = ask("flash-params", "set.toml", "--map", "epos4", *CONSENT)
    assert code == 0 and "2 written" in printed and "stored" in printed, (printed, said)
    assert (drive.holds(0x30A0, 1), drive.holds(0x30A0, 2), drive.resets) == (2_500_000, 1_000_000, 1)
    assert all(drive.holds(*at) == 0 for at in SPEED_GAINS), "no other object was touched"
