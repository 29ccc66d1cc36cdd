# SPDX-License-Identifier: MIT
"""The download as a transaction: what arrives, what comes back, what survives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.sdo_transfer import BUSY_POLL_S
from pmsmtool.bus.supervision import SecondMaster
from pmsmtool.drive.parameters import BUSY_S, DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import Cell, DriveMap, reference_map
from pmsmtool.errors import (
    ConfigError,
    DriveFault,
    NotAvailable,
    PmsmtoolError,
    SafetyRefusal,
    SdoAbort,
    VerifyMismatch,
)
from pmsmtool.flash.download import NOTHING_WRITTEN
from pmsmtool.flash.journal import MARKS, JournalFolder
from pmsmtool.params.parameter_set import ParameterSet, default_set
from pmsmtool.sim.line import Frame
from pmsmtool.sim.node.dictionary import Refused
from pmsmtool.sim.node.memory import IMAGE_KEY
from tests.flash.rig import SMALL, Rig, attach, open_rig, with_tables


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return open_rig(tmp_path)


def test_set_arrives_is_stored_and_dated(rig: Rig) -> None:
    outcome = rig.download(SMALL)
    assert (outcome.written, outcome.equal, outcome.stored, outcome.starts) == (4, 0, True, 1)
    image_crc, active, stored = rig.crcs()
    assert image_crc == active == stored == outcome.crc
    held = rig.node.map.decode(DriveParameters(rig.node).read(SMALL.values))
    assert held.values == SMALL.values
    assert rig.node.sdo.read(0x2000, 9) == bytes.fromhex(SMALL.content_hash()[7:])[:8]
    assert int.from_bytes(rig.node.sdo.read(0x1020, 1), "little") == 15665  # days from 1984-01-01 to 2026-11-21
    assert int.from_bytes(rig.node.sdo.read(0x1020, 2), "little") == 34_200_250
    journal = rig.folder.last()
    assert journal is not None and journal.state == "done"


def test_second_run_writes_nothing(rig: Rig) -> None:
    rig.download(SMALL)
    before = rig.bench.line.frames
    outcome = rig.download(SMALL)
    assert (outcome.written, outcome.equal) == (0, 4)
    writes = rig.bench.line.frames - before
    assert writes < 120, "identity, old values and marks are read, nothing is written"
    assert rig.bench.core.restarts == 1, "only the first download reset the drive"


@pytest.mark.parametrize("kind", [1, 2])
def test_tables_travel_and_are_held(rig: Rig, kind: int) -> None:
    wanted = with_tables(17, kind)
    rig.download(wanted)
    held = rig.node.map.decode(DriveParameters(rig.node).read([*wanted.values, *wanted.tables]))
    assert held.tables["lut.i_q_a"] == pytest.approx(wanted.tables["lut.i_q_a"], abs=1e-6)
    assert len(set(rig.crcs())) == 1


def test_full_set_and_part_of_a_table_later(rig: Rig) -> None:
    rig.download(default_set().merged(with_tables()))
    moved = ParameterSet({}, {"lut.i_d_a": [-1.0] * 81})
    wanted = ParameterSet(
        {"lut.format": 1, "lut.n_x": 9, "lut.n_y": 9, "lut.n_z": 1}, {**with_tables().tables, **moved.tables}
    )
    outcome = rig.download(wanted)
    assert outcome.written == 1 and len(set(rig.crcs())) == 1


def test_without_store_the_next_reset_forgets(rig: Rig) -> None:
    before = rig.image()
    rig.download(SMALL, store=False)
    assert rig.image() != before
    rig.node.reset()
    assert rig.image() == before


def test_restore_brings_back_the_very_bytes(rig: Rig) -> None:
    rig.download(SMALL)
    first = rig.image()
    mark = rig.node.sdo.read(0x2000, 9)
    rig.download(with_tables())
    rig.restore()
    assert rig.image() == first
    assert rig.node.sdo.read(0x2000, 9) == mark
    journal = rig.folder.last()
    assert journal is not None and journal.state == "restored" and len(list(rig.folder.path.parent.iterdir())) == 2


def test_what_counts_as_old_stays_however_often_it_is_restored(rig: Rig) -> None:
    first = rig.image()
    rig.download(SMALL)
    for _ in range(3):
        rig.restore()
        assert rig.image() == first
    rig.download(with_tables())
    rig.restore()
    assert rig.image() == first


def test_a_restore_that_fails_leaves_the_journal_as_it_was(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The new set comes back, and the journal still says so: the next restore brings the old one."""
    first = rig.image()
    rig.download(SMALL)
    second, store = rig.image(), rig.node.store

    def refused() -> None:
        monkeypatch.setattr(rig.node, "store", store)
        raise SdoAbort(0x08000020, 0x1010, 1, "the store is refused")

    monkeypatch.setattr(rig.node, "store", refused)
    with pytest.raises(DriveFault, match="exactly the old set again"):
        rig.restore()
    journal = rig.folder.last()
    assert rig.image() == second and journal is not None and journal.state == "done"
    rig.restore()
    assert rig.image() == first


def test_drives_of_two_makers_with_one_serial_number_have_a_journal_each(tmp_path: Path) -> None:
    one = Identity(1, 0x147, 1, 1, 22001)
    folders = [
        JournalFolder(identity, tmp_path) for identity in (one, replace(one, vendor=0xFB), replace(one, product=2))
    ]
    assert len({folder.path for folder in folders}) == len(folders)


# ---- refusals before anything is written ---------------------------------------------------------


def test_enabled_drive_is_left_alone(rig: Rig) -> None:
    rig.node.enable()
    before = rig.image()
    with pytest.raises(SafetyRefusal, match="OPERATION ENABLED"):
        rig.download(SMALL)
    assert rig.image() == before and not rig.folder.path.exists()


def test_another_drive_is_refused(rig: Rig) -> None:
    rig.identity = replace(rig.identity, serial=99)
    with pytest.raises(SafetyRefusal, match="another drive answers"):
        rig.download(SMALL)
    assert not rig.folder.path.exists()


def test_second_master_is_refused_before_writing(rig: Rig) -> None:
    plan = rig.plan(SMALL)
    rig.bench.bus.clock.after(0.1, lambda: rig.bench.line.deliver(None, Frame(0x601, b"\x40\x41\x60\0" + bytes(4))))
    with pytest.raises(SecondMaster):
        rig.job(plan, {}).run()
    assert not rig.folder.path.exists()


def supervised(node: int, time_ms: int = 500) -> bytes:
    """Return an entry of 0x1016."""
    return (node << 16 | time_ms).to_bytes(4, "little")


@pytest.mark.parametrize(
    ("entry", "beating", "refused"),
    [
        (supervised(20), 20, True),
        (supervised(127), 127, True),
        (supervised(20), 21, False),
        (supervised(20, 0), 20, False),
        (supervised(0), 0, False),
        (supervised(128), 128, False),
    ],
)
def test_the_heartbeat_of_a_master_that_the_drive_supervises_is_heard(
    rig: Rig, entry: bytes, beating: int, refused: bool
) -> None:
    assert rig.bench.node.session is not None
    rig.bench.node.session.dictionary.find(0x1016, 1).value = entry
    plan = rig.plan(SMALL)
    rig.bench.line.clock.every(0.1, lambda: rig.bench.line.deliver(None, Frame(0x700 + beating, b"\x05")))
    if refused:
        with pytest.raises(SecondMaster, match=f"heartbeat of node {beating}, a master this drive supervises"):
            rig.job(plan, {}).run()
        assert not rig.folder.path.exists()
        return
    assert rig.job(plan, {}).run().written == 4


@pytest.mark.parametrize("answer", [b"\x43\x00\x10\x00\x92\x01\x02\x00", b"\x80\x00\x10\x00\x00\x00\x02\x06"])
def test_a_drive_that_the_drive_supervises_is_no_master(rig: Rig, answer: bytes) -> None:
    """Drives of one machine supervise each other: who answers for an object, or refuses it, is a device."""
    rig.node.sdo.download(0x1016, 1, supervised(20))
    plan, line, asked = rig.plan(SMALL), rig.bench.line, list[bytes]()

    def hear(can_id: int, data: bytes, flags: int) -> None:
        if can_id == 0x614:
            asked.append(data)
            line.clock.after(1e-3, lambda: line.deliver(None, Frame(0x594, answer)))

    receive = rig.bench.node.receive
    rig.bench.node.receive = lambda *frame: (hear(*frame), receive(*frame))[1]  # type: ignore[method-assign, func-returns-value]
    line.clock.every(0.1, lambda: line.deliver(None, Frame(0x714, b"\x05")))
    assert rig.job(plan, {}).run().written == 4
    assert asked == [b"\x40\x00\x10\x00" + bytes(4)]


def test_a_download_that_had_reached_its_end_closes_its_journal(rig: Rig) -> None:
    """Killed between the last read and the note: nothing is due, and the journal is finished."""
    rig.download(SMALL)
    for state in ("open", "restored"):
        journal = rig.folder.last()
        assert journal is not None
        rig.folder.close(journal, "open" if state == "open" else "restored")
        outcome = rig.download(SMALL)
        assert (outcome.written, outcome.stored, outcome.starts, outcome.retries) == (0, True, 1, 0)
        after = rig.folder.last()
        assert after is not None and after.state == ("done" if state == "open" else "restored")


def test_unknown_layout_is_refused(rig: Rig) -> None:
    session = rig.bench.node.session
    assert session is not None
    session.dictionary["parameter_set.signature"].put(1)
    with pytest.raises(NotAvailable, match="different versions"):
        rig.download(SMALL)


def test_unwritable_folder_is_refused_before_writing(rig: Rig, tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    rig.root = blocked
    before = rig.image()
    with pytest.raises(ConfigError, match="cannot be made"):
        rig.download(SMALL)
    assert rig.image() == before


def test_bad_values_are_all_named_before_writing(rig: Rig) -> None:
    wrong = ParameterSet({"motor.R_s_ohm": -1.0, "motor.pole_pairs": 99, "motor.L_d_h": 0.002})
    with pytest.raises(ConfigError) as caught:
        rig.download(wrong)
    assert len(caught.value.violations) == 2


# ---- failures on the way -------------------------------------------------------------------------


def test_refused_values_are_all_named_and_the_old_set_comes_back(tmp_path: Path) -> None:
    faults = (
        '[[refuse]]\nobject = "0x2010:02"\ncode = 0x06090030\n[[refuse]]\nobject = "0x2010:03"\ncode = 0x06090031\n'
    )
    rig = open_rig(tmp_path, faults=faults)
    before = rig.image()
    with pytest.raises(DriveFault) as caught:
        rig.download(SMALL)
    message = str(caught.value)
    assert "refused 2 of 4" in message and "motor.R_s_ohm" in message and "motor.L_d_h" in message
    assert "holds exactly the old set again" in message
    assert rig.image() == before and caught.value.exit_code == 4
    journal = rig.folder.last()
    assert journal is not None and journal.state == "restored"


def test_refused_store_brings_the_old_set_back(tmp_path: Path) -> None:
    rig = open_rig(tmp_path, faults='[[refuse]]\nobject = "0x1010:01"\ncode = 0x08000020\ncount = 1\n')
    before = rig.image()
    with pytest.raises(DriveFault, match="holds exactly the old set again"):
        rig.download(SMALL)
    assert rig.image() == before


@pytest.mark.parametrize("always", [False, True])
def test_a_drive_that_is_busy_for_a_value_is_asked_again(rig: Rig, always: bool) -> None:
    """One such answer had ended the download; each of an enabled drive is waited for once, not for every value."""
    assert rig.bench.node.session is not None
    asked = []

    def busy(data: bytes) -> None:
        asked.append(data)
        if always or len(asked) == 1:
            raise Refused(AbortCode.DEVICE_STATE)
        kept(data)

    entries = [rig.bench.node.session.dictionary[name] for name in ("motor.R_s_ohm", "motor.L_d_h")]
    kept = entries[0].sink
    for entry in entries if always else entries[:1]:
        entry.sink = busy
    if not always:
        assert rig.download(SMALL).written == 4 and len(asked) == 2
        return
    begun = rig.connection.clock.now()
    with pytest.raises(DriveFault, match="refused 2 of 4 values") as caught:
        rig.download(SMALL)
    assert "stop" in caught.value.hint and "limits" not in caught.value.hint
    assert rig.connection.clock.now() - begun < 2.0 * BUSY_S
    assert 0.5 * BUSY_S / BUSY_POLL_S < len(asked) < 2.0 * BUSY_S / BUSY_POLL_S


@pytest.mark.parametrize("saved_before", [False, True])
@pytest.mark.parametrize("lies", [False, True])
def test_a_drive_that_never_stores_holds_the_old_set(rig: Rig, saved_before: bool, lies: bool) -> None:
    """It refuses every store, or confirms it and does nothing: after the reset the old set acts, and that is said."""
    if saved_before:
        rig.download(ParameterSet({"motor.R_s_ohm": 0.5}))

    def store(data: bytes) -> bool | None:
        if lies:
            return None
        raise Refused(0x06060000)

    def spoil() -> None:
        assert rig.bench.node.session is not None
        rig.bench.node.session.dictionary["store.all"].sink = store
        build = rig.bench.node.start
        rig.bench.node.start = lambda: (spoil(), build())  # type: ignore[method-assign, assignment, func-returns-value]

    before, crcs = rig.image(), rig.crcs()
    spoil()
    with pytest.raises(PmsmtoolError, match="holds exactly the old set again") as caught:
        rig.download(SMALL)
    assert isinstance(caught.value, VerifyMismatch if lies else DriveFault)
    assert rig.image() == before and rig.crcs() == crcs
    journal = rig.folder.last()
    assert journal is not None and journal.state == "restored"


FOREIGN = b"\x2b\x40\x60" + bytes(5)
"""A write of the controlword that is not ours."""


def test_another_master_while_the_drive_stores_brings_the_old_set_back(tmp_path: Path) -> None:
    """The drive refuses every write until it has stored; the roll-back waits for that."""
    rig = open_rig(tmp_path, faults="[store]\nfactor = 20.0\n")
    before = rig.image()

    def say(text: str) -> None:
        if text == "storing":
            rig.bench.line.clock.after(0.2, lambda: rig.node.supervision._on_request(0x601, FOREIGN, 0.0))

    plan = rig.plan(SMALL)
    job = rig.job(plan, {})
    job._say = say
    with pytest.raises(SecondMaster, match="holds exactly the old set again"):
        job.run()
    assert rig.image() == before and len(set(rig.crcs())) == 1


def test_slow_store_is_waited_for_and_sent_once(tmp_path: Path) -> None:
    rig = open_rig(tmp_path, faults="[store]\nfactor = 20.0\n")
    outcome = rig.download(SMALL)
    assert outcome.stored and outcome.retries == 0


@pytest.mark.chain
def test_store_that_loses_its_answer_is_not_sent_twice(tmp_path: Path) -> None:
    rig = open_rig(tmp_path)
    session = rig.bench.node.session
    assert session is not None
    stores: list[bytes] = []
    sink = session.dictionary["store.all"].sink
    assert sink is not None

    def store(data: bytes) -> bool | None:
        stores.append(data)
        return sink(data)

    def finish(code: int | None = None) -> None:
        session.sdo.reset()  # the confirmation never leaves

    session.dictionary["store.all"].sink = store
    session.sdo.finish = finish  # type: ignore[method-assign]
    rig.download(SMALL)
    assert stores == [b"save"] and len(set(rig.crcs())) == 1


def test_node_reset_in_the_middle_starts_over_once(tmp_path: Path) -> None:
    rig = open_rig(tmp_path)
    plan = rig.plan(SMALL)
    job = rig.job(plan, {})
    writes = 0

    def progress(done: int, total: int) -> None:
        nonlocal writes
        writes += 1
        if writes == 2:
            rig.bench.nmt(0x81)
            rig.connection.sent[0].append(bytes((0x81, 1)))
            rig.bench.wait(0.1)

    job._progress = progress
    outcome = job.run()
    assert outcome.starts == 2 and len(set(rig.crcs())) == 1


def test_emergency_in_the_middle_stops_and_rolls_back(rig: Rig) -> None:
    before = rig.image()
    job = rig.job(rig.plan(SMALL), {})
    emergency = Frame(0x081, (0x4310).to_bytes(2, "little") + b"\x09" + bytes(5))
    job._progress = lambda done, total: rig.bench.line.deliver(None, emergency) if done == 2 else None
    with pytest.raises(DriveFault, match=r"0x4310 \(motor over-temperature\), register 0x09"):
        job.run()
    assert rig.image() == before


def test_operational_node_is_operational_again_after_the_reset(rig: Rig) -> None:
    rig.bench.nmt(1)
    rig.connection.sent[0].append(bytes((1, 1)))
    rig.connection.wait(0.5)
    rig.download(SMALL)
    session = rig.bench.node.session
    assert session is not None and session.nmt == 5


def test_silent_rounding_is_caught(tmp_path: Path) -> None:
    """A drive that stores something else than it confirmed."""
    rig = open_rig(tmp_path)
    session = rig.bench.node.session
    assert session is not None
    entry = session.dictionary["motor.L_d_h"]
    sink = entry.sink
    assert sink is not None
    entry.sink = lambda data: sink(b"\0" + data[1:])
    before = rig.image()
    with pytest.raises(VerifyMismatch, match="motor.L_d_h"):
        rig.download(SMALL)
    assert rig.image() == before


def test_a_stored_set_with_another_check_sum_is_not_confirmed(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every value that was written is there; something that was not written is another."""
    right = DriveParameters.crc_stored.fget
    assert right is not None
    monkeypatch.setattr(DriveParameters, "crc_stored", property(lambda parameters: right(parameters) ^ 1))
    with pytest.raises(VerifyMismatch, match="the stored set is"):
        rig.download(SMALL)


def test_a_mark_that_is_not_kept_is_told(rig: Rig) -> None:
    session = rig.bench.node.session
    assert session is not None
    name, index, sub = MARKS[0]
    (entry,) = [entry for entry in session.dictionary if (entry.row.index, entry.row.sub) == (index, sub)]
    entry.sink = lambda data: None
    with pytest.raises(VerifyMismatch, match=name):
        rig.download(SMALL)


def test_value_that_changes_over_the_reset_is_named_and_taken_back(rig: Rig) -> None:
    before = rig.image()
    session = rig.bench.node.session
    assert session is not None
    write = session.store.write

    def write_something_else(content: dict[int, bytes], done: Callable[[int | None], None]) -> None:
        image = bytearray(content[IMAGE_KEY])
        image[8:12] = b"\x0a\xd7\x23\x3c"  # L_d_h becomes 0.01
        write({**content, IMAGE_KEY: bytes(image)}, done)

    session.store.write = write_something_else  # type: ignore[method-assign]
    with pytest.raises(VerifyMismatch, match="after the reset") as caught:
        rig.download(SMALL)
    assert any(line.startswith("motor.L_d_h") for line in caught.value.differences)
    assert "old set again" in str(caught.value) and rig.image() == before
    image_crc, active, stored = rig.crcs()
    assert image_crc == active == stored


def test_ctrl_c_rolls_back_and_exits_130(rig: Rig) -> None:
    before = rig.image()
    job = rig.job(rig.plan(SMALL), {})

    def progress(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    job._progress = progress
    with pytest.raises(PmsmtoolError) as caught:
        job.run()
    assert caught.value.exit_code == 130 and "old set again" in str(caught.value)
    assert rig.image() == before


def test_drive_gone_keeps_the_journal_and_says_what_to_do(rig: Rig) -> None:
    before = rig.image()
    job = rig.job(rig.plan(SMALL), {})
    job._progress = lambda done, total: rig.bench.node.power_cut() if done == 2 else None
    with pytest.raises(PmsmtoolError) as caught:
        job.run()
    assert caught.value.exit_code == 3
    assert "roll-back failed too" in str(caught.value) and "pmsmtool restore -n 1" in str(caught.value)
    journal = rig.folder.last()
    assert journal is not None and journal.state == "open"
    rig.bench.node.power_on()
    rig.bench.wait(0.2)
    again = attach(rig.bench, rig.root)
    assert again.image() == before
    holds = again.job(again.plan(SMALL), {}).holds
    assert holds.startswith("nothing was written, and an earlier download was interrupted: ")
    again.download(SMALL)
    assert again.job(again.plan(SMALL), {}).holds == NOTHING_WRITTEN
    finished = again.folder.last()
    assert finished is not None and finished.state == "done" and len(set(again.crcs())) == 1


# ---- a drive without staging ---------------------------------------------------------------------


def unstaged() -> DriveMap:
    full = reference_map()
    return DriveMap("plain", full.vendor, full.product, {n: c for n, c in full.cells.items() if n.startswith("motor.")})


def test_drive_without_staging_is_written_read_back_and_rolled_back(tmp_path: Path) -> None:
    rig = open_rig(tmp_path, drive_map=unstaged())
    outcome = rig.download(SMALL)
    assert outcome.written == 3 and outcome.crc is None
    assert rig.plan(SMALL).missing == ("current.K_p_d_v_per_a",)
    other = ParameterSet({"motor.R_s_ohm": 0.3, "motor.pole_pairs": 7, "motor.L_q_h": 0.004})
    session = rig.bench.node.session
    assert session is not None
    sink = session.dictionary["motor.L_q_h"].sink
    assert sink is not None
    session.dictionary["motor.L_q_h"].sink = lambda data: sink(b"\0" + data[1:])
    before = rig.image()
    with pytest.raises(VerifyMismatch):
        rig.download(other)
    session.dictionary["motor.L_q_h"].sink = sink
    assert rig.node.map.decode(DriveParameters(rig.node).read(["motor.R_s_ohm", "motor.pole_pairs"])).values == {
        "motor.R_s_ohm": 0.25,
        "motor.pole_pairs": 5,
    }
    assert rig.image()[:12] == before[:12]


def test_the_consent_names_what_the_map_has_and_counts_the_rest(rig: Rig) -> None:
    told = "speed.K_p_nms_per_rad"
    drive_map = replace(unstaged(), left_out={told: "unit unclear"})
    rig.node.map = drive_map
    wanted = default_set()
    plan = rig.plan(wanted)
    lines, others = plan.lines(), len(wanted.values) - len(drive_map.cells) - 1
    assert others > 40 and plan.missing == drive_map.missing(wanted)  # the machine-readable plan names all
    assert lines[-2:] == [
        f"not written: {told}: unit unclear",
        f"not written: {others} entries of the set that the drive's map has no object for",
    ]
    assert len(lines) == len(plan.changes) + 3 and not any("current." in line for line in lines)


def test_quantised_values_are_shown_in_the_plan(rig: Rig) -> None:
    cell = Cell("motor.I_max_apk", 0x2010, 6, "UNSIGNED32", 0.25)
    scaled = DriveMap("scaled", rig.identity.vendor, rig.identity.product, {cell.name: cell})
    rig.node.map = scaled
    text = "\n".join(rig.plan(ParameterSet({"motor.I_max_apk": 40.1})).lines())
    assert "(asked for 40.1)" in text and " 40 A" in text
