"""The monitor of Novanta/Ingenia Summit drives behind the recorder's port: rows read block by block from one register.

The drive has no CRC over its rows. What it has is a count of the bytes left: every block must take exactly its own
length off it, else a block was lost or came twice, and the record is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pmsmtool.cia402 import State
from pmsmtool.drive.drive_node import POLL_S, DriveNode
from pmsmtool.drive.objects import DriveObject, signal_unit
from pmsmtool.drive.recorder import PATIENCE_S, Recorder
from pmsmtool.errors import DriveTimeout, NotAvailable, SdoAbort, VerifyMismatch
from pmsmtool.firmware import monitor_objects as objects
from pmsmtool.firmware.drive_map import LETTERS, SignalCell
from pmsmtool.firmware.wire_units import wire_unit
from pmsmtool.trace import Trace


def _object(address: objects.Address) -> DriveObject:
    return DriveObject(address[0], 0, address[1])


class MonitorRecorder(Recorder):
    """Recorder of a drive whose map says ``recorder = "index"``.

    Parameters
    ----------
    node : DriveNode
        The drive, with its map.

    Raises
    ------
    NotAvailable
        The drive has no monitor.
    """

    def __init__(self, node: DriveNode) -> None:
        try:
            rate_hz = node.get(_object(objects.LOOP_RATE_HZ))
            self._largest = node.whole(_object(objects.LARGEST_BYTES))
        except SdoAbort as abort:
            raise NotAvailable("the drive has no monitor", where=abort.where) from abort
        if rate_hz <= 0.0:
            raise NotAvailable(f"the drive says its loop runs at {rate_hz:g} Hz", where=f"node {node.node}, 0x2520:00")
        super().__init__(node, 1.0 / rate_hz)
        self._samples = 0

    def arm(
        self, signals: Sequence[str], samples: int, decimation: int, pretrigger: int, *, at_excitation: bool
    ) -> None:
        """Map the signals and start the monitor.

        Raises
        ------
        NotAvailable
            Not these signals, not this much memory, or a trigger it has not.
        VerifyMismatch
            The drive counts another number of bytes per row.
        """
        if pretrigger or at_excitation:
            raise NotAvailable("the monitor is started by command only", where=f"node {self._node.node}, 0x58F0:00")
        cells = self._cells(signals)
        row_bytes = sum(cell.size for cell in cells)
        if samples * row_bytes > self._largest:
            raise NotAvailable(
                f"{samples} samples of {len(signals)} signals do not fit the monitor ({self._largest} bytes)",
                where=f"node {self._node.node}, 0x58B5:00",
                hint="record fewer signals or samples, or use a decimation",
            )
        self._put(objects.ENABLE, 0)
        self._put(objects.MAPPED, 0)
        self._put(objects.REMOVE_DATA, 1)
        for k, cell in enumerate(cells):
            word = objects.mapping_word(cell.index, cell.wire, cell.size)
            self._put((objects.FIRST_MAP[0] + k, objects.FIRST_MAP[1]), word)
            self._put(objects.MAPPED, k + 1)
        self._put(objects.DIVIDER, decimation)
        self._put(objects.TRIGGER_KIND, objects.FORCED)
        self._put(objects.WINDOW, samples)
        self._put(objects.ENABLE, 1)
        said = self._get(objects.ROW_BYTES)
        if said != row_bytes:
            raise VerifyMismatch(
                "the monitor has not taken the signals", where=f"node {self._node.node}, 0x58E4:00",
                differences=[f"{row_bytes} bytes per row are mapped, the drive says {said}"],
            )  # fmt: skip
        if not self._get(objects.STATUS) & objects.ENABLED_BIT:
            raise NotAvailable("the monitor does not start", where=f"node {self._node.node}, 0x58B0:00")
        self._put(objects.FORCE_TRIGGER, 1)
        self._samples = samples

    def fetch(self, signals: Sequence[str], decimation: int) -> Trace:
        """Wait until the record is complete and read it.

        Raises
        ------
        DriveFault
            The drive went into fault meanwhile.
        DriveTimeout
            The monitor does not fill.
        VerifyMismatch
            Blocks are missing, came twice, or the number of rows is another.
        """
        cells = self._cells(signals)
        row = np.dtype([(name, "<" + LETTERS[cell.wire]) for name, cell in zip(signals, cells, strict=True)])
        expected = self._samples * row.itemsize
        self._await_frame(decimation)
        table = np.frombuffer(self._read(expected), row)
        self._put(objects.ENABLE, 0)
        period_s = decimation * self._period_s
        return Trace(
            t_s=period_s * np.arange(self._samples, dtype=np.float64),
            signals={
                name: wire_unit(cell.unit).scale * table[name].astype(np.float64)
                for name, cell in zip(signals, cells, strict=True)
            },
            units={name: signal_unit(name) for name in signals},
            meta={
                "period_s": period_s,
                "control_period_s": self._period_s,
                "decimation": decimation,
                "trigger_row": 0,
            },
        )

    def _read(self, expected: int) -> bytes:
        """Read blocks until nothing is left."""
        data = b""
        left = self._get(objects.BYTES_LEFT)
        if left != expected:
            raise self._wrong(f"{expected} bytes were asked for, {left} are there")
        while left:
            size = min(left, objects.BLOCK_BYTES)
            block = self._node.sdo.upload(objects.DATA, 0).data
            now = self._get(objects.BYTES_LEFT)
            if len(block) < size or left - now != size:
                raise self._wrong(f"a block of {len(block)} bytes took {left - now} off the count, {size} were due")
            data += block[:size]
            left = now
        return data

    def _await_frame(self, decimation: int) -> None:
        node = self._node
        deadline = node.connection.clock.now() + PATIENCE_S + self._samples * decimation * self._period_s
        while not self._get(objects.STATUS) & objects.AVAILABLE_BIT:
            if node.state() in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                raise node.fault_error()
            if node.connection.clock.now() >= deadline:
                raise DriveTimeout("the monitor does not finish", where=f"node {node.node}, 0x58B0:00")
            node.connection.wait(POLL_S)
            node.supervision.check()

    def _cells(self, signals: Sequence[str]) -> list[SignalCell]:
        known = {name: cell for name, cell in self._node.map.signals.items() if not name.startswith("target_")}
        unknown = [name for name in signals if name not in known]
        if unknown or not 0 < len(signals) <= objects.CHANNELS:
            raise NotAvailable(
                f"the monitor has no signal {', '.join(unknown)}"
                if unknown
                else f"the monitor takes 1 to {objects.CHANNELS} signals",
                where=f"node {self._node.node}",
                hint=f"its map names {', '.join(known)}",
            )
        return [known[name] for name in signals]

    def _get(self, address: objects.Address) -> int:
        return self._node.whole(_object(address))

    def _put(self, address: objects.Address, value: int) -> None:
        self._node.command(_object(address), value)

    def _wrong(self, difference: str) -> VerifyMismatch:
        return VerifyMismatch(
            "the record of the monitor is damaged", where=f"node {self._node.node}, 0x58B2:00",
            differences=[difference],
        )  # fmt: skip


def recorder_of(node: DriveNode, period_s: float) -> Recorder:
    """Return the recorder of a drive by what its map says it has.

    Parameters
    ----------
    period_s : float
        Control period, for the reference drive's recorder (s).

    Raises
    ------
    NotAvailable
        It has none that this program reads.
    """
    if node.map.staging:
        return Recorder(node, period_s)
    if node.map.capabilities.recorder == "index":
        return MonitorRecorder(node)
    raise NotAvailable(
        f"the drive map {node.map.name!r} has no recorder that this program reads", where=f"node {node.node}"
    )
