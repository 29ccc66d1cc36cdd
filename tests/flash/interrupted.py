# SPDX-License-Identifier: MIT
"""Downloads that end at a chosen frame: the drive loses its supply, the tool is killed, a person presses Ctrl-C."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import can

from pmsmtool.errors import Interrupted, PmsmtoolError
from pmsmtool.firmware.image import crc32
from pmsmtool.flash.download import set_named
from pmsmtool.flash.restore import marks_of
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.node.memory import IMAGE_KEY, RamStorage
from pmsmtool.sim.node.parameter_set import ParameterImage
from tests.flash.rig import WHEN, Rig, attach, open_rig

How = Literal["power cut", "killed", "ctrl-c"]


class Killed(BaseException):
    """SIGKILL, as far as a test in one process can have it: nothing the tool does afterwards has an effect."""


@dataclass(frozen=True)
class End:
    """What was found after an interruption.

    ``held`` is ``old`` or ``new``; ``finished`` tells whether the interruption came too late to matter.
    """

    held: str
    finished: bool


def frames_of(wanted: ParameterSet, root: Path) -> int:
    """Return how many frames an undisturbed download takes from its first request on."""
    rig = open_rig(root)
    before = rig.bench.line.frames
    rig.download(wanted)
    return rig.bench.line.frames - before


def interrupt(wanted: ParameterSet, root: Path, at: int, how: How, *, finish: Literal["again", "restore"]) -> End:
    """Interrupt a download ``at`` frames after its first request, check the drive, finish, check again.

    Raises AssertionError when the drive holds anything but the old or the new set, with a valid CRC.
    """
    storage = RamStorage()
    rig = open_rig(root, storage=storage)
    old = rig.image()
    new = _image_after(old, wanted, root)
    last = rig.bench.line.frames + at
    deliver = rig.bench.line.deliver

    def counted(sender: object, frame: object) -> None:
        deliver(sender, frame)  # type: ignore[arg-type]
        if rig.bench.line.frames == last:
            if how == "power cut":
                rig.bench.node.power_cut()
            elif how == "ctrl-c":
                signal.raise_signal(signal.SIGINT)  # the clock holds it back until the frame is through
            else:
                rig.bench.bus.send = killed  # type: ignore[method-assign]

    def killed(msg: can.Message, timeout: float | None = None) -> None:
        raise Killed

    rig.bench.line.deliver = counted  # type: ignore[method-assign]
    finished = False
    try:
        _download(rig, wanted)
        finished = True
    except Interrupted as told:
        assert how == "ctrl-c"
        _assert_told(rig, told.what, old, new)
    except (PmsmtoolError, Killed):
        assert how != "ctrl-c"
    rig.bench.line.deliver = deliver  # type: ignore[method-assign]
    if how == "killed":
        del rig.bench.bus.send
    rig.bench.node.power_on()
    rig.bench.wait(2.0)  # a store that was under way ends, a node that booted is up
    assert_whole(rig.bench.node.session, old, new)
    rig.bench.bus.clock.wait(0.1)
    while rig.bench.bus.recv(0.0) is not None:
        pass
    again = attach(rig.bench, root)
    held = "new" if again.image() == new else "old"
    if finish == "again":
        again.download(wanted)
        assert again.image() == new
    elif again.folder.last() is not None:
        again.restore()
        assert again.image() == old
    journal = again.folder.last()
    assert journal is None or journal.state != "open"
    again.node.reset()
    assert again.image() == (new if finish == "again" else old) or journal is None
    assert_whole(again.bench.node.session, old, new)
    again.bench.bus.shutdown()
    return End(held, finished)


def _download(rig: Rig, wanted: ParameterSet) -> None:
    """As the commands do it."""
    with set_named() as jobs:
        plan = rig.plan(wanted)
        jobs.append(rig.job(plan, marks_of(plan.content, WHEN)))
        jobs[0].run()


def _assert_told(rig: Rig, text: str, old: bytes, new: bytes) -> None:
    """The message of an exit 130 names the set that acts and is stored, and no journal is left open."""
    session = rig.bench.node.session
    assert session is not None
    named = [held for words, held in ((_OLD, old), (_NEW, new)) if any(word in text for word in words)]
    assert named == [rig.image()], text
    stored = session.store.stored.get(IMAGE_KEY)
    assert stored == (new if named == [new] else stored) and stored in (None, *named), text
    journal = rig.folder.last()
    assert journal is None or journal.state != "open"


_OLD = ("the drive holds the set that it held before", "the drive holds exactly the old set again")
_NEW = ("the drive holds the new set, stored and read back",)


def assert_whole(session: object, old: bytes, new: bytes) -> None:
    """The active and the stored set are the old or the new one, and their CRCs say so."""
    active = session.parameters.active.pack()  # type: ignore[attr-defined]
    assert active in (old, new), "a mixed set acts"
    assert session.parameters.active_crc == crc32(active)  # type: ignore[attr-defined]
    stored = session.store.stored.get(IMAGE_KEY)  # type: ignore[attr-defined]
    assert stored in (None, old, new), "a mixed set is stored"


def _image_after(old: bytes, wanted: ParameterSet, root: Path) -> bytes:
    """The image the drive will hold, made without the download."""
    from pmsmtool.drive_maps.drive_map import reference_map
    from pmsmtool.drive_maps.map_tables import look_up_words

    image = ParameterImage.of_bytes(old)
    for name, value in wanted.values.items():
        image.set(name, value)
    return bytes(image.words) + look_up_words(reference_map().encode(wanted))
