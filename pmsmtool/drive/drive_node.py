# SPDX-License-Identifier: MIT
"""A drive as a CANopen node: typed objects, identity, CiA 402 states, reset and store."""

from __future__ import annotations

import contextlib
import struct
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.bus.nmt import NmtCommand, NmtState, reset_node, send_nmt
from pmsmtool.bus.sdo import Retry, SdoChannel
from pmsmtool.bus.supervision import Supervision
from pmsmtool.cia402 import (
    ERROR_CAUSES,
    EXCITATION_ABORTED,
    LEAST_LINK_V,
    Command,
    State,
    Status,
    command_towards_enabled,
    error_text,
    state_of,
)
from pmsmtool.drive import objects
from pmsmtool.drive.objects import LAST_AXIS, DriveObject, of_axis
from pmsmtool.drive.port import Identity
from pmsmtool.drive_maps.drive_map import LETTERS, DriveMap, reference_map
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import BusError, DriveFault, DriveTimeout, NotAvailable, SdoAbort
from pmsmtool.plain_text import one_line

STATE_TIMEOUT_S = 2.0
"""A state transition without motion takes milliseconds; charging a DC link may take longer."""
STORE_TIMEOUT_S = 10.0
"""Flash memory of a drive may take seconds (docs/canopen.md, 6: 3 to 10 s)."""
STORE_POLL_S = 0.1
READY_TIMEOUT_S = 3.0
"""After boot-up a node answers SDO requests within this time."""
POLL_S = 0.005
LOOKS, MEAN_ANSWER_S = 8, 0.1
"""Answers that are timed before a first motion, and their largest mean: a slow gateway takes some tens of ms."""
IDENTITY_BYTES = 4
LONGEST_NAME = 256
"""Bytes of 0x1008 to 0x100A that are read; drives use up to 64."""

NOT_READ = (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX, AbortCode.WRITE_ONLY)
"""Refusals to read an object that count as missing: what cannot be read back proves nothing."""
OF_LENGTH = (AbortCode.LENGTH, AbortCode.TOO_LONG, AbortCode.TOO_SHORT)

Watcher = Callable[[int, int, bytes], None]
"""Called with index, sub-index and bytes before an object is written."""


class DriveNode:
    """One drive on a bus.

    Parameters
    ----------
    connection : Connection
        The bus.
    node : int
        Node id.
    drive_map : DriveMap, optional
        Which object holds which parameter; the reference drive's when not given.

    Attributes
    ----------
    sdo : SdoChannel
        Confirmed transfers.
    supervision : Supervision
        Heartbeat, emergencies, other masters.
    may_try : bool
        Whether :meth:`takes` may write: the drive is simulated for a rehearsal alone.
    before_write : callable or None
        Told of every object that :meth:`put` and :meth:`write_bytes` are about to change.
    before_close : list of callable
        Called, the last first, by :meth:`close`, while the node can still be talked to.
    """

    def __init__(self, connection: Connection, node: int, *, drive_map: DriveMap | None = None) -> None:
        self.connection = connection
        self.node = node
        self.map = drive_map or reference_map()
        self.supervision = Supervision(connection, node)
        self.sdo = SdoChannel(connection, node, check=self.supervision.check)
        self.sdo.slow_objects[objects.STORE_ALL] = STORE_TIMEOUT_S
        self.may_try = False
        self.before_write: Watcher | None = None
        self.before_close: list[Callable[[], object]] = []
        self._lengths: dict[tuple[int, int], int] = {}
        connection.at_close.append(self.close)

    def close(self) -> None:
        """Stop listening to the node; whoever closes the bus does it, too. Once."""
        ended_by = sys.exc_info()[1]
        try:
            with contextlib.ExitStack() as last:
                last.callback(self.supervision.close)
                last.callback(self.sdo.close)
                while self.before_close:
                    last.callback(self.before_close.pop(0))
        except BusError:  # never in place of what ended it: that the drive may still be energised
            if ended_by is None:
                raise

    # ---- objects --------------------------------------------------------------------------------

    def get(self, item: DriveObject) -> float:
        """Return the number in an object."""
        item = self.typed(item)
        return item.decode(self.sdo.read(item.index, item.sub, size=item.size))

    def typed(self, item: DriveObject) -> DriveObject:
        """Return an object in the width in which :meth:`held` found it."""
        return item.of_length(self._lengths.get((item.index, item.sub), item.size)) or item

    def held(self, item: DriveObject) -> float | None:
        """Return the number in an object, None where the drive has none that can be read.

        A whole number may have another width than the standard's: makers keep 0x6075 in 16 bits and 0x6071 in 32. From
        now on it is read, written and mapped in its own.
        """
        self.sdo.usual_lengths.setdefault((item.index, item.sub), item.size)
        try:
            data = self.sdo.read(item.index, item.sub)
        except SdoAbort as abort:
            if abort.code in NOT_READ:
                return None
            raise
        found = item.of_length(len(data))
        if found is None:
            return None
        self._lengths[item.index, item.sub] = len(data)
        return found.decode(data)

    def takes(self, item: DriveObject, *values: float) -> bool:
        """Whether an object takes values, and its own, where that may be tried; else whether it is there."""
        held = self.held(item)
        if held is None or not self.may_try:
            return held is not None
        try:
            for value in (*values, held):
                self.put(item, value)
        except (SdoAbort, NotAvailable):
            with contextlib.suppress(SdoAbort):
                self.put(item, held)
            return False
        return True

    def whole(self, item: DriveObject) -> int:
        """Return the whole number in an object."""
        return int(self.get(item))

    def put(self, item: DriveObject, value: float) -> None:
        """Write a number; where the answer is lost it is read back.

        Raises NotAvailable: the object is too narrow for it.
        """
        typed = self.typed(item)
        try:
            data = typed.encode(value)
        except (struct.error, OverflowError) as error:
            where = f"node {self.node}, 0x{item.index:04X}:{item.sub:02X}"
            raise NotAvailable(
                f"{value:.0f} does not fit into the object's {8 * typed.size} bits", where=where,
                likely="a coarse unit of the drive's, or a shaft that does not follow and was asked for more and more",
                hint="`pmsmtool check` looks at the shaft, `pmsmtool caps` at the units",
            ) from error  # fmt: skip
        self.write_bytes(item.index, item.sub, data)

    def command(self, item: DriveObject, value: int, *, retry: Retry = Retry.REPEAT) -> None:
        """Write a command: nothing a restore would have to bring back."""
        self.sdo.download(item.index, item.sub, self.typed(item).encode(value), retry=retry)

    def write_bytes(self, index: int, sub: int, data: bytes, *, retry: Retry = Retry.READ_BACK) -> None:
        """Write the bytes of an object."""
        self.sdo.usual_lengths[index, sub] = len(data)
        if self.before_write is not None:
            self.before_write(index, sub, data)
        self.sdo.download(index, sub, data, retry=retry)

    def has(self, index: int, sub: int) -> bool:
        """Whether the node has an object it lets read."""
        try:
            self.sdo.read(index, sub)
        except SdoAbort:
            return False
        return True

    # ---- identity -------------------------------------------------------------------------------

    def identity(self) -> Identity:
        """Read identity object and names; also the producer heartbeat time; supervision begins here.

        A number the node does not have is 0: only the vendor is mandatory (CiA 301, object 0x1018).

        Raises BusError: two nodes answer.
        """
        self.supervision.begin()
        vendor, product, serial = vendor_product_serial(self.sdo, self.map)
        revision = identity_number(self.sdo, 3)
        name, hardware, software = (
            self._text(*where) for where in (objects.DEVICE_NAME, objects.HARDWARE_VERSION, objects.SOFTWARE_VERSION)
        )
        with contextlib.suppress(SdoAbort):
            self.supervision.heartbeat_period_s = self.get(objects.PRODUCER_HEARTBEAT_MS) / 1000.0 or None
        doubt = self._doubt(vendor, product, name)
        self._refuse_two_nodes()
        return Identity(self.node, vendor, product, revision, serial, name, hardware, software, doubt)

    def _refuse_two_nodes(self) -> None:
        if self.sdo.contradiction:
            self.supervision.check()  # answers to another master's requests come here, too
            raise BusError(
                f"two nodes answer on node id {self.node}: {self.sdo.contradiction}",
                where=f"node {self.node}",
                likely="two drives have this node id",
                hint="connect one drive alone, and give it another node id (its switches, or `pmsmtool lss`)",
            )

    def _doubt(self, vendor: int, product: int, name: str) -> str:
        """Say why a drive of an identity that others have, too, is not taken for its map's; empty when it is."""
        drive_map = _map_of(self.map, vendor, product)
        if drive_map is None or not drive_map.identity.shared:
            return ""
        if any(word.lower() in name.lower() for word in drive_map.identity.names):
            return ""
        wrong = [
            f"0x{index:04X}:{sub:02X}"
            for index, sub, size in drive_map.identity.marks
            if len(_held(self.sdo, index, sub, size)) != size
        ]
        if not wrong and drive_map.identity.marks:
            return ""
        own = f"calls itself {name!r}" if name else "has no name (0x1008)"
        lacks = f" and lacks {', '.join(wrong)} of that family" if wrong else ""
        other = "makers share" if drive_map.identity.names else "other kinds of drive have"
        return f"{other} vendor number {vendor:#010x}: this drive {own}{lacks}, so it is no {drive_map.name}"

    def _text(self, index: int, sub: int) -> str:
        try:
            data = self.sdo.upload(index, sub, longest=LONGEST_NAME).data
        except SdoAbort as abort:
            return f"(longer than {LONGEST_NAME} bytes)" if abort.code == AbortCode.TOO_LONG else ""
        return one_line(data.rstrip(b"\0").decode("ascii", "replace"))

    # ---- CiA 402 --------------------------------------------------------------------------------

    def other_axes(self) -> dict[int, State | None]:
        """Return the states of the further axes of a device that has several, by number; empty where it has one.

        The reference drive has one, and is not asked.
        """
        found: dict[int, State | None] = {}
        with contextlib.suppress(SdoAbort):
            for axis in range(2, 2 if self.map.staging else LAST_AXIS + 1):
                word = self.held(of_axis(objects.STATUSWORD, axis))
                if word is None:
                    break
                found[axis] = state_of(int(word))
        return found

    def state(self) -> State | None:
        """Return the state the statusword shows, None for a pattern CiA 402 does not define."""
        return state_of(self.whole(objects.STATUSWORD))

    def go(self, word: Command) -> None:
        """Write a controlword; repeating one is harmless.

        A drive that refuses its length is asked for the width in which it keeps it.
        """
        try:
            self.command(objects.CONTROLWORD, word)
        except SdoAbort as abort:
            if abort.code not in OF_LENGTH or self.held(objects.CONTROLWORD) is None:
                raise
            self.command(objects.CONTROLWORD, word)

    def wait_for_state(
        self, reached: Callable[[State | None], bool], timeout_s: float = STATE_TIMEOUT_S
    ) -> State | None:
        """Poll the statusword until ``reached``; return the last state, reached or not."""
        deadline = self.connection.clock.now() + timeout_s
        while True:
            state = self.state()
            if reached(state) or self.connection.clock.now() >= deadline:
                return state
            self.connection.wait(POLL_S)

    def answer_s(self) -> float:
        """Return how long an answer takes (s): the shortest of three."""
        return min(self._answers_s(3))

    def _answers_s(self, number: int) -> list[float]:
        clock, took_s = self.connection.clock, []
        for _ in range(number):
            asked_s = clock.now()
            self.state()
            took_s.append(clock.now() - asked_s)
        return took_s

    def refuse_late(self) -> None:
        """Refuse a drive whose answers take too long for motion that is looked at.

        Raises DriveTimeout: with how long they take.
        """
        took_s = self._answers_s(LOOKS)
        mean_s = sum(took_s) / LOOKS
        if mean_s > MEAN_ANSWER_S:
            raise DriveTimeout(
                f"the drive answers late: {LOOKS} answers took {1e3 * mean_s:.0f} ms on average and up to "
                f"{1e3 * max(took_s):.0f} ms; a motion needs {1e3 * MEAN_ANSWER_S:.0f} ms or less",
                where=f"node {self.node}, 0x6041:00", likely="a busy drive, a slow gateway or adapter, or a full bus",
                hint="nothing was energised; bring the drive nearer to this program, or take load off the bus",
            )  # fmt: skip

    def enable(self) -> None:
        """Walk to OPERATION ENABLED. Raises DriveFault: the drive is in fault, or stays in a state on the way."""
        for _ in range(len(State)):
            state = self.state()
            if state is State.OPERATION_ENABLED:
                return
            word = None if state is None else command_towards_enabled(state)
            if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
                raise self.fault_error()
            if word is None:
                before = state
                state = self.wait_for_state(lambda now: now is not before)  # noqa: B023 - called before the next turn
                if state is before:
                    break
                continue
            self.go(word)
            before = state
            if self.wait_for_state(lambda now: now is not before) is before:  # noqa: B023
                break
        raise DriveFault(
            f"the drive stays in {state_text(state)} and does not enable",
            where=f"node {self.node}, 0x6041:00",
            likely=self._kept_off_by(),
            hint="check the supply and the enable inputs",
        )

    def _kept_off_by(self) -> str:
        """Return why the drive may not enable: its DC link, where shown, separates supply and inputs."""
        if not self.whole(objects.STATUSWORD) & Status.REMOTE:
            return (
                "it takes no commands from the bus (statusword, bit 9: remote): its maker's software, a panel or "
                "an input has the control"
            )
        link_v = self.link_v()
        if link_v is None:
            return "no DC-link voltage, or a missing hardware enable or safe-torque-off input"
        if link_v < LEAST_LINK_V:
            counts = ", where 0x6079 counts mV" if self.held(objects.DC_LINK_MV) is not None else ""
            return f"the supply of the power stage is off: the DC link has {link_v:.3g} V{counts}"
        return f"the safe-torque-off (STO) or enable input is open; the DC link has {link_v:.4g} V"

    def link_v(self) -> float | None:
        """Return the voltage of the DC link by the object that a maker's map names, else by 0x6079; None: not shown."""
        signal = None if self.map.staging else self.map.signals.get("U_dc_v")
        if signal is not None:
            held = self.held(DriveObject(signal.index, signal.sub, LETTERS[signal.wire]))
            if held is not None:
                return wire_unit(signal.unit).scale * held
        held = self.held(objects.DC_LINK_MV)
        return None if held is None else 1e-3 * held

    def disable_voltage(self, timeout_s: float = STATE_TIMEOUT_S) -> State | None:
        """Remove the voltage; return the state that the statusword then shows."""
        self.go(Command.DISABLE_VOLTAGE)
        return self.wait_for_state(is_safe, timeout_s)

    def reset_fault(self) -> None:
        """Reset a fault by the rising edge of its bit. Raises DriveFault: it came back."""
        self.go(Command.DISABLE_VOLTAGE)
        self.go(Command.FAULT_RESET)
        state = self.wait_for_state(lambda now: now not in (State.FAULT, State.FAULT_REACTION_ACTIVE))
        self.go(Command.DISABLE_VOLTAGE)
        if state in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            raise self.fault_error()

    def fault_error(self) -> DriveFault:
        """Return the error that tells the drive's fault: by 0x603F, else by its last emergency."""
        code = self.fault_code()
        aborted = code == EXCITATION_ABORTED
        cause = "allow more (--speed-max, --i-max) or ask for less" if aborted else "remove the cause"
        named = f" {code:#06x}: {error_text(code)}" if code else ", and names no error (0x603F, emergencies)"
        return DriveFault(
            f"the drive is in fault{named}",
            where=f"node {self.node}, 0x603F:00",
            likely="current or speed left the limits of the envelope" if aborted else ERROR_CAUSES.get(code, ""),
            hint=f"{cause}, then `pmsmtool fault reset -n {self.node}`",
        )

    def fault_code(self) -> int:
        """Return the code of the present error (0x603F, which is optional), else of the last emergency; 0: none."""
        try:
            return self.whole(objects.ERROR_CODE)
        except SdoAbort as abort:
            if abort.code not in (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX):
                raise
        self.connection.collect()
        return next((said.code for said in reversed(self.supervision.emergencies) if said.code), 0)

    # ---- reset and store ------------------------------------------------------------------------

    def reset(self) -> None:
        """Reset the node, wait until it answers again, and start it if it was operational.

        Raises DriveTimeout: it does not come back.
        """
        operational = self.supervision.nmt_state is NmtState.OPERATIONAL
        with self.supervision.expected_reset():
            try:
                reset_node(self.connection, self.node)
            except DriveTimeout as error:
                with contextlib.suppress(DriveTimeout):
                    self.has(objects.DEVICE_TYPE.index, objects.DEVICE_TYPE.sub)
                    error.likely = "it answers: it does not obey the reset, or sends no boot-up message"
                    error.hint = "switch the drive off and on, then see with `pmsmtool verify` what it has stored"
                raise
            self._wait_until_ready()
        if operational:
            send_nmt(self.connection, NmtCommand.START, self.node)

    def _wait_until_ready(self) -> None:
        deadline = self.connection.clock.now() + READY_TIMEOUT_S
        while True:
            try:
                self.sdo.read(objects.DEVICE_TYPE.index, objects.DEVICE_TYPE.sub)
                return
            except (DriveTimeout, SdoAbort):
                if self.connection.clock.now() >= deadline:
                    raise
                self.connection.wait(POLL_S)

    def can_store(self) -> bool:
        """Whether the node has the command that stores all parameters."""
        try:
            self.sdo.read(*objects.STORE_ALL)
        except SdoAbort as abort:
            return abort.code not in (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX)
        return True

    def store(self) -> None:
        """Store all parameters; the command is sent once, flash memory wears out.

        Raises SdoAbort: the drive refuses to store; DriveTimeout: no answer within ``STORE_TIMEOUT_S``, and the store
        cannot be seen to have ended.
        """
        index, sub = objects.STORE_ALL
        try:
            self.sdo.download(index, sub, b"save", retry=Retry.NEVER)
        except DriveTimeout:
            self.wait_for_store()

    def wait_for_store(self) -> None:
        """Wait where the confirmation is missing: the drive has finished when it answers for 0x1010 again.

        Raises DriveTimeout: it does not within twice ``STORE_TIMEOUT_S``.
        """
        deadline = self.connection.clock.now() + STORE_TIMEOUT_S
        slow = self.sdo.slow_objects.pop(objects.STORE_ALL)  # of the command: a question is answered at once, or not
        try:
            while self.connection.clock.now() < deadline:
                try:
                    self.sdo.upload(*objects.STORE_ALL, tries=1)
                    return
                except DriveTimeout:
                    pass
                except SdoAbort as abort:
                    if abort.code in (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX, AbortCode.WRITE_ONLY):
                        return  # it answers, and cannot be asked for more
                self.connection.wait(STORE_POLL_S)
        finally:
            self.sdo.slow_objects[objects.STORE_ALL] = slow
        raise DriveTimeout(
            f"the drive does not finish storing within {2 * STORE_TIMEOUT_S:g} s",
            where=f"node {self.node}, 0x1010:01",
            hint="leave it powered; run the command again, it continues where this one ended",
        )

    @contextmanager
    def emergencies_tolerated(self) -> Iterator[None]:
        """While a fault is provoked or cleared on purpose: emergencies do not end the work."""
        before, self.supervision.stop_at_emergency = self.supervision.stop_at_emergency, False
        try:
            yield
        finally:
            self.connection.collect()
            self.supervision.take_note_of_emergencies()
            self.supervision.stop_at_emergency = before


def vendor_product_serial(sdo: SdoChannel, drive_map: DriveMap | None = None) -> tuple[int, int, int]:
    """Read who a drive is; the serial number where its family keeps it, if 0x1018:04 is absent or 0.

    ``drive_map``: a map that may name the drive; otherwise the shipped one for its vendor and product is asked.
    """
    vendor, product, serial = (identity_number(sdo, sub) for sub in (1, 2, 4))
    known = None if serial else _map_of(drive_map, vendor, product)
    if known is not None and known.identity.serial is not None:
        index, sub, size = known.identity.serial
        data = _held(sdo, index, sub, size)
        serial = int.from_bytes(data, "little") if len(data) == size else 0
    return vendor, product, serial


def identity_number(sdo: SdoChannel, sub: int) -> int:
    """Return a number of the identity object, 0 where the node lacks it; the vendor (1) is mandatory.

    Of another type than the standard's UNSIGNED32 (CiA 301, 7.5.2.19) a shorter number is taken, a text is none.
    """
    try:
        data = sdo.upload(objects.IDENTITY, sub, longest=LONGEST_NAME).data
        return int.from_bytes(data, "little") if len(data) <= IDENTITY_BYTES else 0
    except SdoAbort as abort:
        if sub > 1 and abort.code in (AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX, AbortCode.WRITE_ONLY):
            return 0
        raise


def _map_of(drive_map: DriveMap | None, vendor: int, product: int) -> DriveMap | None:
    if drive_map is not None and drive_map.is_for(vendor, product):
        return drive_map
    from pmsmtool.drive_maps.shipped_maps import family_of  # reads every map: not for a command on a drive of its map

    return family_of(vendor, product)


def _held(sdo: SdoChannel, index: int, sub: int, size: int) -> bytes:
    """Return an object's bytes, ``size`` of them where the node does not say how many; none where it is not shown."""
    sdo.usual_lengths.setdefault((index, sub), size)
    try:
        return sdo.upload(index, sub, longest=LONGEST_NAME).data
    except SdoAbort:
        return b""


def is_safe(state: State | None) -> bool:
    """Whether a state certainly drives no current; an undefined pattern does not count as one."""
    return state is not None and not state.energised


def state_text(state: State | None) -> str:
    """Return a state as people write it."""
    return "an undefined state" if state is None else state.name.replace("_", " ")
