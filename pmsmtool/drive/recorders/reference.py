# SPDX-License-Identifier: MIT
"""The drive's trace recorder and its window averages (objects 0x2060 to 0x2064 of the reference drive)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pmsmtool.bus.sdo import Mode
from pmsmtool.cia402 import State
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import POLL_S, DriveNode
from pmsmtool.drive.objects import LIVE, DriveObject, signal_unit
from pmsmtool.drive.port import Halves
from pmsmtool.errors import DriveTimeout, NotAvailable, SdoAbort, VerifyMismatch
from pmsmtool.trace import Trace

PATIENCE_S = 1.0
"""Beyond the time a recording or an average takes by itself."""
MEASURE_AGAIN = "measure again; if it comes back, `pmsmtool doctor` examines the bus"
_BYTES = 4  # every channel is recorded as binary32


_RECORDED, _AVERAGED = 3, 2
"""Complete, as the objects 0x2060:08 and 0x2063:03 say it."""
_TRIGGER_NOW, _TRIGGER_EXCITATION, _TRIGGER_MOVE = 0, 4, 6


class Recorder:
    """Recorder and averages of one drive."""

    def __init__(self, node: DriveNode, period_s: float) -> None:
        self._node = node
        self._period_s = period_s
        self._capacity: int | None = None
        self._channels: dict[DriveObject, int] = {}

    # ---- traces ---------------------------------------------------------------------------------

    def arm(
        self, signals: Sequence[str], samples: int, decimation: int, pretrigger: int, *, at_excitation: bool,
        at_move: bool = False,
    ) -> None:  # fmt: skip
        """Set the recorder up and arm it: from now on, from an excitation on, or from the begin of a move on.

        Raises NotAvailable: the drive has no recorder, or not these signals, or not this much memory.
        """
        self._check_room(signals, samples)
        self._select(objects.TRACE_CHANNELS, signals)
        node = self._node
        node.put(objects.TRACE_DECIMATION, decimation)
        # The pre-trigger must stay below the depth at every moment.
        node.put(objects.TRACE_PRETRIGGER, 0)
        node.put(objects.TRACE_DEPTH, samples)
        node.put(objects.TRACE_PRETRIGGER, pretrigger)
        trigger = _TRIGGER_MOVE if at_move else _TRIGGER_EXCITATION if at_excitation else _TRIGGER_NOW
        node.put(objects.TRACE_TRIGGER, trigger)
        node.command(objects.TRACE_COMMAND, 1)

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        """Wait until the recording is complete and upload it.

        Raises
        ------
        DriveFault
            The drive went into fault meanwhile.
        DriveTimeout
            The recorder was not triggered, or does not fill.
        VerifyMismatch
            The CRC-32 of the data is not the drive's.
        """
        node = self._node
        self._await(objects.TRACE_STATE, _RECORDED, "the recorder")
        stored, position = node.whole(objects.TRACE_STORED), node.whole(objects.TRACE_POSITION)
        size = stored * len(signals) * _BYTES
        data = node.sdo.upload(*objects.TRACE_DATA, size=size, mode=Mode.BLOCK).data
        crc = node.whole(objects.TRACE_CRC)
        if zlib.crc32(data) != crc:
            raise VerifyMismatch(
                "the trace is damaged", where=f"node {node.node}, 0x2062:00",
                differences=[f"CRC-32 {zlib.crc32(data):#010x}, the drive reports {crc:#010x}"], hint=MEASURE_AGAIN,
            )  # fmt: skip
        period_s = 1e-9 * node.whole(objects.TRACE_PERIOD_NS)
        table = np.frombuffer(data, "<f4").reshape(stored, len(signals)).astype(np.float64)
        return Trace(
            t_s=period_s * np.arange(-position, stored - position, dtype=np.float64),
            signals={name: np.ascontiguousarray(table[:, k]) for k, name in enumerate(signals)},
            units={name: signal_unit(name) for name in signals},
            meta={
                "period_s": period_s,
                "control_period_s": period_s / decimation,
                "decimation": decimation,
                "trigger_row": position,
                "voltage_lag": node.whole(objects.TRACE_VOLTAGE_LAG),
                "crc32": crc,
            },
        )

    def _check_room(self, signals: Sequence[str], samples: int) -> None:
        unknown = [name for name in signals if name not in LIVE]
        if unknown:
            raise NotAvailable(f"the recorder has no signal {', '.join(unknown)}", hint=f"it has {', '.join(LIVE)}")
        if self._capacity is None:
            try:
                self._capacity = self._node.whole(objects.TRACE_CAPACITY)
            except SdoAbort as abort:
                raise NotAvailable(
                    "the drive has no trace recorder", where=f"node {self._node.node}, 0x2060"
                ) from abort
        if len(signals) > len(objects.TRACE_CHANNELS) or samples * len(signals) * _BYTES > self._capacity:
            holds = f"{len(objects.TRACE_CHANNELS)} channels, {self._capacity} bytes"
            raise self._too_much(signals, samples, holds, "0x2060:0B")

    def _too_much(self, signals: Sequence[str], samples: int, holds: str, where: str) -> NotAvailable:
        return NotAvailable(
            f"{samples} samples of {len(signals)} signals do not fit the recorder ({holds})",
            where=f"node {self._node.node}, {where}",
            hint="record fewer signals or samples, or use a decimation",
        )

    def _select(self, channels: Sequence[DriveObject], signals: Sequence[str]) -> None:
        """Write mapping words, only those that differ from the last ones."""
        for k, channel in enumerate(channels):
            word = LIVE[signals[k]].mapping_word if k < len(signals) else 0
            if self._channels.get(channel) != word:
                self._node.put(channel, word)
                self._channels[channel] = word

    def forget(self) -> None:
        """What was written to the drive is no longer known (it was reset or restored)."""
        self._channels.clear()

    def _await(self, item: DriveObject, wanted: int, what: str) -> None:
        where = f"0x{item.index:04X}:{item.sub:02X}"
        likely = "its trigger never came: the excitation or the move did not start"
        self._until(lambda: self._node.whole(item) == wanted, what, where, likely=likely)

    def _until(
        self, reached: Callable[[], bool], what: str, where: str, *, lasts_s: float = 0.0, likely: str = ""
    ) -> None:
        """Poll until ``reached``, which takes ``lasts_s`` by itself."""
        node = self._node
        deadline = node.connection.clock.now() + PATIENCE_S + lasts_s
        while not reached():
            if node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                raise node.fault_error()
            if node.connection.clock.now() >= deadline:
                raise DriveTimeout(
                    f"{what} does not finish", where=f"node {node.node}, {where}", likely=likely, hint=MEASURE_AGAIN
                )
            node.connection.wait(POLL_S)
            node.supervision.check()

    # ---- averages -------------------------------------------------------------------------------

    def start_average(self, signals: Sequence[str], periods: int) -> None:
        """Start the mean over the next ``periods`` control periods.

        Raises NotAvailable: the drive has no such signals, or too few channels.
        """
        unknown = [name for name in signals if name not in LIVE]
        if unknown or len(signals) > len(objects.AVERAGE_CHANNELS):
            raise NotAvailable(
                f"no average of {', '.join(unknown or signals)}",
                hint=f"at most {len(objects.AVERAGE_CHANNELS)} of {', '.join(LIVE)}",
            )
        self._select(objects.AVERAGE_CHANNELS, signals)
        self._node.put(objects.AVERAGE_PERIODS, periods)
        self._node.command(objects.AVERAGE_COMMAND, 1)

    def finish_average(self, signals: Sequence[str]) -> Mapping[str, float]:
        """Wait for the average and return it by signal."""
        self._await(objects.AVERAGE_STATE, _AVERAGED, "the average")
        return {name: self._node.get(objects.AVERAGE_MEANS[k]) for k, name in enumerate(signals)}

    def halves(self, take: Callable[[int], Mapping[str, float]], periods: int) -> Halves:
        """Return means over two windows: ``take`` returns those over so many control periods from now on."""
        return Halves(take(periods), take(periods), 2 * periods)
