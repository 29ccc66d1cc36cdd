# SPDX-License-Identifier: MIT
"""Which set a drive holds after a download that was interrupted, began anew, or had nothing left to do."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from pmsmtool.drive.port import Identity
from pmsmtool.errors import DriveFault, Interrupted
from pmsmtool.flash.download import set_named
from pmsmtool.flash.journal import MARKS, Entry, Snapshot, merged
from pmsmtool.flash.restore import marks_of
from pmsmtool.params.parameter_set import ParameterSet
from tests.flash.rig import SMALL, WHEN, Rig, open_rig


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return open_rig(tmp_path)


def test_what_makes_work_for_a_download(rig: Rig) -> None:
    """Changes, another set's mark, or a set that acts and is not stored; the last only where it shall be stored."""
    plan = rig.plan(SMALL)
    marks = marks_of(plan.content, WHEN)
    assert rig.job(plan, marks).has_work(store=False)
    rig.job(plan, marks).run(store=False)
    plan = rig.plan(SMALL)
    assert not plan.changes
    assert not rig.job(plan, marks).has_work(store=False) and rig.job(plan, marks).has_work()
    rig.job(plan, marks).run()
    assert not rig.job(plan, marks).has_work() and not rig.job(plan, marks).has_work(store=False)
    another = {**marks, "design_id": bytes(8)}
    assert rig.job(plan, another).has_work() and rig.job(plan, another).has_work(store=False)


def test_a_download_that_starts_over_says_why(tmp_path: Path) -> None:
    rig, said = open_rig(tmp_path), list[str]()
    job = rig.job(rig.plan(SMALL), {})
    job._say = said.append

    def progress(done: int, total: int) -> None:
        if not any("starting over" in text for text in said) and done == 2:
            rig.bench.nmt(0x81)
            rig.connection.sent[0].append(bytes((0x81, 1)))
            rig.bench.wait(0.1)

    job._progress = progress
    assert job.run().starts == 2
    again = [text for text in said if "starting over once" in text]
    assert len(again) == 1 and again[0].startswith("the node was reset in the middle")
    assert [text for text in said if text.startswith("writing")] == ["writing and reading back 4 objects"] * 2


@pytest.mark.parametrize("stored_before", [False, True])
def test_an_interrupt_after_the_store_leaves_the_memory_as_it_was(rig: Rig, stored_before: bool) -> None:
    """The new set is in the memory already: the old one is stored over it, and both are compared."""
    if stored_before:
        rig.download(ParameterSet({"motor.R_s_ohm": 0.5}))
    before, reset = rig.image(), rig.node.reset
    resets: list[int] = []

    def lost() -> None:
        resets.append(1)
        if len(resets) == 1:
            raise DriveFault("the drive tripped")
        reset()

    rig.node.reset = lost  # type: ignore[method-assign]
    with pytest.raises(DriveFault, match="holds exactly the old set again"):
        rig.download(SMALL)
    assert rig.image() == before and len(set(rig.crcs())) == 1 and len(resets) == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, Interrupted])
def test_an_interrupt_names_the_set_of_every_drive(error: type[BaseException]) -> None:
    jobs = [SimpleNamespace(node=SimpleNamespace(node=n), holds=f"set {n}") for n in (3, 4)]
    for begun, told in (([], "nothing was written: the drive holds the set that it held before"), (jobs[:1], "set 3"),
                        (jobs, "node 3: set 3; node 4: set 4")):  # fmt: skip
        with pytest.raises(Interrupted) as caught, set_named() as named:
            named += begun  # type: ignore[arg-type]
            raise error("the download was finished first") if error is Interrupted else error
        one = error is Interrupted and len(begun) < 2
        assert caught.value.what == ("the download was finished first" if one else told)


def test_of_two_unfinished_downloads_the_oldest_old_and_the_newest_new_count() -> None:
    who = Identity(1, 2, 3, 4, 5, "", "", "")
    marks = [Entry(name, index, sub, b"old " + name.encode()) for name, index, sub in MARKS]

    def journal(*entries: Entry) -> Snapshot:
        return Snapshot("journal", "open", who, 0, entries[0].name, entries)

    first = journal(Entry("a", 0x2010, 1, b"1", b"2"), Entry("b", 0x2010, 2, b"3", b"4"), *marks)
    second = journal(Entry("c", 0x2010, 3, b"7", b"8"), Entry("b", 0x2010, 2, b"4", b"6"), *reversed(marks))
    both = merged(first, second)
    assert [(e.name, e.old, e.new) for e in both.entries[:3]] == [
        ("a", b"1", b"2"), ("b", b"3", b"6"), ("c", b"7", b"8"),
    ]  # fmt: skip
    assert [e.name for e in both.entries[3:]] == ["design_id", "configuration_date", "configuration_time"]
    assert both.content == "c"
