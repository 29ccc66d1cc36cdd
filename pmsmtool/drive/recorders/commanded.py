# SPDX-License-Identifier: MIT
"""What the makers' recorders have in common: started by command, read when they stand still, no averages.

None of them has a CRC over its data. What each of them has is a count; a record whose count, length or state does not
agree with what was asked for is refused, never cut or filled up.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject, signal_unit
from pmsmtool.drive.recorders.reference import MEASURE_AGAIN, Recorder
from pmsmtool.drive_maps.recorder_map import Address
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import NotAvailable, SdoAbort, VerifyMismatch
from pmsmtool.trace import Trace

LARGEST_WORD = 0xFFFF
_Row = TypeVar("_Row")


class CommandedRecorder(Recorder):
    """A recorder that a drive's map describes.

    Raises NotAvailable: the drive has no such recorder, or the map does not state enough of it.

    Attributes
    ----------
    what : str
        What messages call it.
    start, data, memory : str
        Objects that start it, hold its data and say how much that may be, for messages.
    """

    what: str
    start: str
    data: str
    memory: str

    def __init__(self, node: DriveNode) -> None:
        super().__init__(node, 0.0)
        self._samples = 0
        try:
            self._period_s = self._base_period_s()
        except SdoAbort as abort:
            raise NotAvailable(f"the drive has no {self.what}", where=abort.where) from abort

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals it can take."""
        return tuple(self._known())

    def _known(self) -> Mapping[str, Any]:
        """Return the rows of the map by their signals: channels of the recorder."""
        return self._node.map.recorder.channels

    @property
    def period_s(self) -> float:
        """Shortest time between two samples (s)."""
        return self._period_s

    @abstractmethod
    def room(self, signals: Sequence[str]) -> int:
        """Return how many samples of signals fit; they are chosen on the drive.

        Raises NotAvailable: it does not have these signals.
        """

    @abstractmethod
    def halt(self) -> None:
        """Stop recording; what was recorded stays."""

    @abstractmethod
    def _base_period_s(self) -> float: ...

    @abstractmethod
    def _start(self, signals: Sequence[str], samples: int, decimation: int) -> None:
        """Set what the choice of the signals left open, and record."""

    def arm(
        self, signals: Sequence[str], samples: int, decimation: int, pretrigger: int, *, at_excitation: bool,
        at_move: bool = False,
    ) -> None:  # fmt: skip
        """Choose the signals and record them from now on.

        Raises NotAvailable: not these signals, not this much memory, or a trigger it has not; VerifyMismatch: the drive
        has taken something else.
        """
        self._begin_arming(samples, decimation, pretrigger, at_excitation=at_excitation or at_move)
        largest = self.room(signals)
        if samples > largest:
            raise self._too_much(signals, samples, f"{largest} samples", self.memory)
        self._start(signals, samples, decimation)

    def start_average(self, signals: Sequence[str], periods: int) -> None:
        """Refuse: it takes no averages."""
        raise NotAvailable(f"the {self.what} takes no averages", where=f"node {self._node.node}, {self.data}")

    def finish_average(self, signals: Sequence[str]) -> Mapping[str, float]:
        """Refuse: it takes no averages."""
        raise NotAvailable(f"the {self.what} takes no averages", where=f"node {self._node.node}, {self.data}")

    # ---- parts of arm and fetch -----------------------------------------------------------------

    def _begin_arming(self, samples: int, decimation: int, pretrigger: int, *, at_excitation: bool) -> None:
        """Refuse triggers it has not, and a time between samples it cannot count."""
        if pretrigger or at_excitation:
            raise NotAvailable(
                f"the {self.what} is started by command only", where=f"node {self._node.node}, {self.start}"
            )
        if not 0 < decimation <= LARGEST_WORD:
            raise NotAvailable(
                f"the {self.what} takes every 1st to {LARGEST_WORD}th sample, not every {decimation}th",
                where=f"node {self._node.node}",
            )
        self._samples = samples

    def _chosen(self, signals: Sequence[str], known: Mapping[str, _Row], most: int) -> list[_Row]:
        """Return the rows of the map for signals."""
        unknown = [name for name in signals if name not in known]
        if unknown or not 0 < len(signals) <= most:
            raise NotAvailable(
                f"the {self.what} has no signal {', '.join(unknown)}"
                if unknown
                else f"the {self.what} takes 1 to {most} signals",
                where=f"node {self._node.node}",
                hint=f"its map names {', '.join(known) or 'none'}",
            )
        return [known[name] for name in signals]

    def _lasts_s(self, decimation: int) -> float:
        return self._samples * decimation * self._period_s

    def _in_si(self, counts: Mapping[str, NDArray[np.generic]], units: Sequence[str], decimation: int) -> Trace:
        """Return the record of counts, a unit for each column."""
        period_s = decimation * self._period_s
        return Trace(
            t_s=period_s * np.arange(self._samples, dtype=np.float64),
            signals={
                name: wire_unit(unit).scale * column.astype(np.float64)
                for (name, column), unit in zip(counts.items(), units, strict=True)
            },
            units={name: signal_unit(name) for name in counts},
            meta={
                "period_s": period_s,
                "control_period_s": self._period_s,
                "decimation": decimation,
                "trigger_row": 0,
            },
        )

    def _get(self, address: Address) -> int:
        return self._node.whole(DriveObject(*address))

    def _put(self, address: Address, value: int) -> None:
        """Write a setting: a guard brings it back."""
        self._node.put(DriveObject(*address), value)

    def _command(self, address: Address, value: int) -> None:
        self._node.command(DriveObject(*address), value)

    def _wrong(self, difference: str) -> VerifyMismatch:
        return VerifyMismatch(
            f"the record of the {self.what} is damaged", where=f"node {self._node.node}, {self.data}",
            differences=[difference], hint=MEASURE_AGAIN,
        )  # fmt: skip


def numbered(address: Address, k: int) -> Address:
    """Return the object ``k`` sub-indices further."""
    return address[0], address[1] + k, address[2]
