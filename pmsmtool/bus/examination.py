# SPDX-License-Identifier: MIT
"""Examination of a bus: what is heard, what answers, how fast, and what that tells about the wiring."""

from __future__ import annotations

import contextlib
import importlib
import logging
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import can
from can.interfaces import BACKENDS

from pmsmtool.bus.connect import connect
from pmsmtool.bus.connection import Connection
from pmsmtool.bus.frame_time import frame_bits
from pmsmtool.bus.nmt import FoundNode, find_nodes
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.errors import BusError, DriveTimeout, PmsmtoolError, SdoAbort

BITRATES = (1_000_000, 800_000, 500_000, 250_000, 125_000, 100_000, 50_000, 20_000, 10_000)
"""Rates of CiA 301, section 5.3, and 100 kbit/s."""
TERMINATION = (
    "termination: without power CAN_H to CAN_L measures 60 ohm; 120 ohm is one missing resistor, 40 ohm one too many"
)
"""ISO 11898-2: 120 ohm at each end of the line."""
LISTEN_S = 1.0
ROUND_TRIPS = 50
NODES_TIMED = 3


@dataclass(frozen=True, slots=True)
class Adapter:
    """One python-can interface: whether its driver loads, and why not."""

    name: str
    ready: bool
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Examination:
    """Findings on one bus."""

    frames: int
    error_frames: int
    """Heard while only listening."""
    load: float | None
    """Share of the time frames took, from their exact lengths; None without a bit rate."""
    state: str
    """Controller state as the adapter tells it; empty where it does not."""
    nodes: tuple[FoundNode, ...]
    """Who answers or was heard."""
    findings: tuple[tuple[str, str], ...] = field(default=())
    """Verdict PASS, WARN or FAIL and its sentence."""


def adapters() -> list[Adapter]:
    """Return every interface python-can knows here, with whether its module loads."""
    return [_load(name, module, class_name) for name, (module, class_name) in sorted(BACKENDS.items())]


def _load(name: str, module: str, class_name: str) -> Adapter:
    complaints = _Complaints()
    log, top = logging.getLogger("can"), logging.getLogger()  # some modules complain under names of their own
    propagate, log.propagate = log.propagate, False
    log.addHandler(complaints)
    top.addHandler(complaints)
    try:
        getattr(importlib.import_module(module), class_name)
    except Exception as error:  # a vendor's module may fail in any way while it loads its driver
        return Adapter(name, False, str(error).splitlines()[0] if str(error) else type(error).__name__)
    finally:
        log.removeHandler(complaints)
        top.removeHandler(complaints)
        log.propagate = propagate
    # Most modules without their driver do load, and only complain.
    return Adapter(name, not complaints.texts, complaints.texts[0] if complaints.texts else "")


class _Complaints(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.texts.append(record.getMessage().splitlines()[0])


def examine(connection: Connection, bitrate: int | None, *, listen_s: float = LISTEN_S) -> Examination:
    """Listen first, then ask; nothing is written to any node.

    ``bitrate``: to turn frame lengths into bus load.
    """
    bits = _Bits(connection)
    before, errors_before = connection.frames_received, connection.error_frames
    connection.wait(listen_s)
    frames, error_frames = connection.frames_received - before, connection.error_frames - errors_before
    load = None if not bitrate else bits.total / bitrate / listen_s
    bits.close()
    findings = [_heard(frames, error_frames, load)]
    nodes: tuple[FoundNode, ...] = ()
    try:
        nodes = tuple(find_nodes(connection))
        answering = [entry.node for entry in nodes if entry.device_type is not None]
        findings.append(_answered(connection, nodes, answering))
        findings += [_timing(connection, node) for node in answering[:NODES_TIMED]]
    except BusError as error:
        findings.append(("FAIL", f"{error.what}; likely: {error.likely}"))
    state = _state(connection.bus)
    if state == "ERROR":
        findings.append(("FAIL", f"the controller is bus-off: wrong bit rate, a short circuit, or {TERMINATION}"))
    return Examination(frames, error_frames, load, state, nodes, tuple(findings))


def find_bitrate(
    interface: str | None, channel: str | None, *, listen_s: float = LISTEN_S
) -> dict[int, tuple[int, int]]:
    """Open the bus at each rate, only listening where the adapter can, and count (frames, error frames)."""
    found = {}
    for rate in BITRATES:
        try:
            with connect(interface, channel, rate) as connection:
                with contextlib.suppress(Exception):  # most adapters cannot be told after opening
                    connection.bus.state = can.BusState.PASSIVE
                connection.wait(listen_s)
                found[rate] = connection.frames_received, connection.error_frames
        except PmsmtoolError:
            continue  # the adapter does not have this rate
    return found


def no_rate(rates: Mapping[int, tuple[int, int]]) -> str:
    """Return why no bit rate was heard without errors, of the counts of :func:`find_bitrate`."""
    if rates and all(errors and not frames for frames, errors in rates.values()):
        return f"only error frames, at every bit rate: {TERMINATION}; or CAN_H and CAN_L are swapped"
    return "no bit rate was heard: switch a node on while this listens, it sends when it starts; or swapped wires"


class _Bits:
    """Sum of the exact lengths of all frames heard."""

    def __init__(self, connection: Connection) -> None:
        self.total = 0
        self._connection = connection
        connection.listeners.append(self._add)

    def _add(self, message: can.Message) -> None:
        if not message.is_error_frame:
            self.total += frame_bits(
                message.arbitration_id, bytes(message.data), extended=message.is_extended_id,
                remote=message.is_remote_frame, dlc=message.dlc if message.is_remote_frame else None,
            )  # fmt: skip

    def close(self) -> None:
        self._connection.listeners.remove(self._add)


def _heard(frames: int, error_frames: int, load: float | None) -> tuple[str, str]:
    if error_frames and not frames:
        return "FAIL", f"only error frames ({error_frames}): wrong bit rate, or {TERMINATION}"
    if error_frames:
        return "WARN", f"{error_frames} error frames among {frames} frames: {TERMINATION}; long stubs; a loose plug"
    if not frames:
        return "WARN", "nothing was heard: no node sends by itself (heartbeat off), no power, or another channel"
    used = "" if load is None else f", bus load {100.0 * load:.1f} %"
    return "PASS", f"{frames} frames heard, no error frames{used}"


def _answered(connection: Connection, nodes: Sequence[FoundNode], answering: Sequence[int]) -> tuple[str, str]:
    if answering:
        return "PASS", f"answers from: node {', '.join(map(str, answering))}"
    if nodes:
        return "FAIL", f"heard, but no answer to an SDO: node {', '.join(str(n.node) for n in nodes)}: stopped by NMT?"
    return "FAIL", f"no node answers; likely: {connection.explain_silence(0)[0]}"


def _timing(connection: Connection, node: int) -> tuple[str, str]:
    """Return how fast a node answers; FAIL where it leaves requests unanswered, each of them sent once."""
    channel = SdoChannel(connection, node)
    times = []
    lost = 0
    try:
        for _ in range(ROUND_TRIPS):
            started = connection.clock.now()
            try:
                channel.upload(0x1000, 0, tries=1)
            except SdoAbort:
                pass
            except DriveTimeout:
                lost += 1
                if lost >= ROUND_TRIPS // 5:
                    break
                continue
            times.append(connection.clock.now() - started)
    finally:
        channel.close()
    if channel.contradiction:
        return "FAIL", f"node {node}: two nodes answer on this id, {channel.contradiction}: give each drive its own"
    if lost:
        return "FAIL", (
            f"node {node}: {lost} of {lost + len(times)} requests without an answer: frames get lost; {TERMINATION}; "
            "a loose plug; an overloaded gateway"
        )
    median_s, slow_s = statistics.median(times), sorted(times)[int(0.95 * len(times))]
    text = f"node {node}: round trip {1e3 * median_s:.3g} ms median, {1e3 * slow_s:.3g} ms at 95 %"
    return ("WARN" if slow_s > 0.05 else "PASS"), text


def _state(bus: Any) -> str:
    # Some adapters have no state at all (python-can #736); then there is nothing to tell.
    with contextlib.suppress(Exception):
        return str(bus.state.name)
    return ""
