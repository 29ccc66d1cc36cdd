# SPDX-License-Identifier: MIT
"""Storing and restoring: objects 0x1010 and 0x1011 over the non-volatile memory.

What is stored is a list of (object, bytes): communication, application (CiA 402) and parameter set can be stored and
restored apart, as CiA 301 groups them. A store takes its time on the node's clock, one memory write per step.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from enum import Enum

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule
from pmsmtool.errors import ConfigError
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.memory import Memory

Stored = dict[int, bytes]
"""Bytes by object (index << 8 | sub)."""

IMAGE_KEY, SIGNATURE_KEY = 0x2001 << 8 | 0xFF, 0x2000 << 8 | 0xFF
"""The set and its signature: sub-index 0xFF is nobody's value (CiA 301), another maker's 0x2001 stays its own."""
NODE_ID_KEY = 0
"""Pseudo-object of the node id that LSS stored."""

ERASE_S = 0.3
PAGE_S = 0.005
"""A store takes ERASE_S and PAGE_S per KiB: longer than a usual SDO time-out of 0.3 s."""
_RECORD = struct.Struct("<II")


class Group(Enum):
    """Groups of 0x1010 and 0x1011: key of the object, range of indices."""

    COMMUNICATION = ("communication", range(0x1000, 0x2000))
    APPLICATION = ("application", range(0x6000, 0xA000))
    PARAMETER_SET = ("parameter_set", range(0x2000, 0x6000))

    @property
    def indices(self) -> range:
        """Indices of the group."""
        found: range = self.value[1]
        return found


_ALL = tuple(Group)


def encode(stored: Mapping[int, bytes]) -> bytes:
    """Return the memory content of stored values."""
    return b"".join(_RECORD.pack(key, len(data)) + data for key, data in sorted(stored.items()))


def decode(content: bytes) -> Stored:
    """Return the stored values of a memory content; the inverse of :func:`encode`."""
    stored: Stored = {}
    position = 0
    while position < len(content):
        key, length = _RECORD.unpack_from(content, position)
        position += _RECORD.size
        stored[key] = content[position : position + length]
        position += length
    return stored


def without(stored: Mapping[int, bytes], groups: Collection[Group]) -> Stored:
    """Return stored values without those of some groups."""
    return {key: data for key, data in stored.items() if not any(key >> 8 in group.indices for group in groups)}


class Store:
    """Objects 0x1010 and 0x1011 of one session.

    Parameters
    ----------
    current : callable
        Returns the values of a group as they are now.
    energised : callable
        Whether the power stage may drive current: then nothing is stored.
    finish : callable
        Confirms the pending write, or refuses it with an abort code.
    scale : callable
        Fault injection: returns the factor on the time a store takes.
    step_done : callable
        Fault injection: called after every write step.

    Attributes
    ----------
    stored : dict
        What the memory holds.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        schedule: Schedule,
        memory: Memory,
        *,
        current: Callable[[Group], Stored],
        energised: Callable[[], bool],
        finish: Callable[[int | None], None],
        scale: Callable[[], float] = lambda: 1.0,
        step_done: Callable[[], None] = lambda: None,
    ) -> None:
        content = memory.load()
        self.stored: Stored = {} if content is None else decode(content)
        self._schedule = schedule
        self._memory = memory
        self._current = current
        self._energised = energised
        self._finish = finish
        self._scale = scale
        self._step_done = step_done
        self._busy = False
        for groups, key in ((_ALL, "all"), *(((group,), group.value[0]) for group in Group)):
            dictionary[f"store.{key}"].sink = self._sink(b"save", groups)
            dictionary[f"restore.{key}"].sink = self._sink(b"load", groups)

    def _sink(self, signature: bytes, groups: tuple[Group, ...]) -> Callable[[bytes], bool]:
        def sink(data: bytes) -> bool:
            if data != signature:
                raise Refused(AbortCode.NOT_STORED)
            if self._energised() or self._busy:
                raise Refused(AbortCode.DEVICE_STATE)
            content = without(self.stored, groups)
            if signature == b"save":
                for group in groups:
                    content |= self._current(group)
            self.write(content, self._finish)
            return True

        return sink

    @property
    def busy(self) -> bool:
        """Whether a store is under way."""
        return self._busy

    def write(self, content: Stored, done: Callable[[int | None], None]) -> None:
        """Store values step by step, then call ``done`` with None, or with the abort code of what went wrong."""
        self._busy = True
        packed = encode(content)
        steps = self._memory.store(packed)

        def complete(code: int | None) -> None:
            self._busy = False
            if code is None:
                self.stored = content
            done(code)

        self._next_step(steps, ERASE_S, complete)

    def _next_step(self, steps: Iterator[None], seconds: float, complete: Callable[[int | None], None]) -> None:
        def step() -> None:
            try:
                next(steps)
            except StopIteration:
                complete(None)
                return
            except ConfigError:  # the file cannot be written; on a drive: the memory is broken
                complete(AbortCode.HARDWARE)
                return
            self._step_done()
            self._next_step(steps, PAGE_S, complete)

        self._schedule.after(seconds * self._scale(), step)
