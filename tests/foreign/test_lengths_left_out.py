# SPDX-License-Identifier: MIT
"""A server may leave the length out of an expedited answer (CiA 301, 7.2.4.3.6, s = 0), with anything behind the value.

The length is then the one that standard, map or data sheet state; taken for four bytes, a torque of -5 permille was
65531, and of a map only the rows of 32 bits were left.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pmsmtool.drive.guard import guarded
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.line import Frame
from tests.cli.conftest import Tool
from tests.foreign.data_sheets import EXPECTED_PDO, Row, copley, write_eds
from tests.foreign.test_foreign_safety import ENVELOPE, opened, unwatched

pytestmark = pytest.mark.chain

STORE: tuple[Row, ...] = ((0x1010, 1, "U32", "rw", "1"),)
CHANNEL = "interior-2k2?nv=drive.nv&eds=x.eds"


@pytest.fixture(autouse=True)
def _no_lengths(monkeypatch: pytest.MonkeyPatch) -> None:
    hear = PmsmSimBus.hear

    def heard(bus: PmsmSimBus, frame: Frame, own: bool) -> None:
        data = frame.data
        if frame.can_id == 0x581 and data[0] & 0xE3 == 0x43:
            empty = data[0] >> 2 & 3
            data = b"\x42" + data[1 : 8 - empty] + b"\xa5" * empty
        hear(bus, frame._replace(data=data), own)

    monkeypatch.setattr(PmsmSimBus, "hear", heard)


def test_no_row_of_a_map_is_lost(tool: Tool) -> None:
    write_eds(Path("x.eds"), (*copley(), *STORE))
    facts = json.loads(tool("--sim", CHANNEL, "caps", "--json")[1])
    assert {"motor.pole_pairs", "motor.R_s_ohm", "motor.psi_f_wb"} <= set(facts["written"]), facts["map"]
    assert {"push", "position", "current", "supervision"} <= set(facts["features"])


def test_process_data_is_lent_and_brought_back(tmp_path: Path) -> None:
    """Its number of entries, of one byte, was compared with four: "a PDO could not be restored"."""
    with opened(tmp_path, unwatched(*EXPECTED_PDO)) as rig:
        before = rig.memory()
        with guarded(rig.drive, ENVELOPE) as guard:
            assert guard.proof is not None and guard.proof.by == "process data"
        rig.drive.close()
        assert rig.memory() == before


def test_all_is_saved_and_comes_back(tool: Tool) -> None:
    """Objects of 8, 16 and 32 bits; of four bytes each, the drive refused what it had shown."""
    write_eds(Path("x.eds"), (*copley(), *STORE))
    assert tool("--sim", CHANNEL, "backup", "--eds", "x.eds", "-o", "b.json")[0] == 0
    sizes = {len(bytes.fromhex(entry["old"])) for entry in json.loads(Path("b.json").read_text())["entries"]}
    assert sizes >= {1, 2, 4}
    assert tool("--sim", CHANNEL, "--yes", "param", "set", "motor.pole_pairs=7", "--store")[0] == 0
    code, _, said = tool("--sim", CHANNEL, "--yes", "restore", "b.json")
    assert code == 0, said
    assert tool("--sim", CHANNEL, "verify", "b.json")[0] == 0
