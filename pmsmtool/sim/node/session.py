# SPDX-License-Identifier: MIT
"""Everything of the node that a reset forgets: one session lasts from boot-up to the next reset."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Protocol

from pmsmtool.bus.clock import Schedule
from pmsmtool.cia402 import State
from pmsmtool.firmware.image import crc32
from pmsmtool.sim.node import memory as storing
from pmsmtool.sim.node.dictionary import Dictionary, DriveFace, Entry, Refused
from pmsmtool.sim.node.error_control import Emergency, HeartbeatConsumer, HeartbeatProducer
from pmsmtool.sim.node.lss import ANSWER_ID, REQUEST_ID, LssSlave
from pmsmtool.sim.node.measurement import Measurement
from pmsmtool.sim.node.memory import Group, Store, Stored
from pmsmtool.sim.node.objects import eds_text
from pmsmtool.sim.node.parameter_set import ParameterImage, ParameterSet
from pmsmtool.sim.node.pdo import ProcessData
from pmsmtool.sim.node.power_drive import PDO_MISSED, Plant, PowerDrive
from pmsmtool.sim.node.sdo_server import SdoServer

SET_LOST = 0x6310
MEMORY_DAMAGED = 0x5530
LSS_NOT_STORED = 2
"""LSS error code: storage media access error (CiA 305)."""
RESET_COMMUNICATION_S = 0.005
"""Silence of the node during a reset of its communication."""
_CONFIGURATION_INDEX = 0x1020


class NmtState(IntEnum):
    """States of CiA 301, 7.3.2, as the heartbeat carries them."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


class NmtCommand(IntEnum):
    """NMT commands of the master."""

    START = 1
    STOP = 2
    PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class Hardware(Plant, Protocol):
    """What a session needs of the node it runs on."""

    node_id: int
    next_node_id: int
    bitrate: int | None
    factory: ParameterImage
    identity: tuple[int, int, int, int]
    name: str
    rated_current_ma: int
    rated_torque_mnm: int
    face: DriveFace | None
    pdo_lateness: Iterator[float]

    def send(self, can_id: int, data: bytes) -> None:
        """Transmit a frame."""

    def withdraw(self, can_id: int) -> None:
        """Take back frames of an identifier that are not on the wire yet."""

    def reset(self) -> None:
        """Restart the firmware."""

    def start(self) -> None:
        """Boot an unconfigured node that has got its id."""

    def take_parameters(self, image: bytes) -> None:
        """Give a parameter image to the core."""

    def make_store(self, session: Session) -> Store:
        """Return the storing objects, over the node's memory and faults."""


class Session:
    """One run of the firmware.

    Attributes
    ----------
    dictionary, parameters, power, measurement, sdo, store
        The parts, for the node and for tests.
    nmt : NmtState
        Present NMT state.
    attending : bool
        True inside :meth:`attend`.
    """

    def __init__(self, hardware: Hardware, schedule: Schedule) -> None:
        self.nmt = NmtState.INITIALISING
        self.attending = False
        self.hardware = hardware
        self.schedule = schedule
        self.dictionary = Dictionary(hardware.node_id)
        self._identify()
        if hardware.face is not None:
            hardware.face.dress(self.dictionary)
        self.store = hardware.make_store(self)
        self._recall(range(0x1000, 0xFFFF))
        active, lost = self._stored_set()
        self.parameters = ParameterSet(self.dictionary, active, self.is_energised, self._take_set)
        self._note_stored_set()
        self.emergency = Emergency(self.dictionary, schedule, self._send_emergency)
        self.power = PowerDrive(self.dictionary, schedule, hardware, self.emergency)
        self.measurement = Measurement(self.dictionary, hardware, self.power)
        if hardware.face is not None:
            hardware.face.attach(self.dictionary, hardware, self.power, schedule)
        self.sdo = SdoServer(self.dictionary, schedule, self._send_sdo, self._withdraw_sdo)
        self.heartbeat = HeartbeatProducer(self.dictionary, schedule, self.send_state)
        self.consumer = HeartbeatConsumer(
            self.dictionary, schedule, self._heartbeat_lost, self.power.connection_regained
        )
        self.pdo = ProcessData(
            self.dictionary, schedule, self._is_operational, hardware.send, self.emergency.raise_error,
            hardware.pdo_lateness, lambda: self.power.connection_lost(0, PDO_MISSED),
            lambda: self.power.connection_regained(PDO_MISSED),
        )  # fmt: skip
        self.guarding = None if hardware.face is None else hardware.face.guarding(self)
        self.lss = self._make_lss()
        self.power.on_state = self.pdo.changed
        self.dictionary["device.eds"].source = lambda: eds_text().encode("ascii")
        for key in ("max_current", "max_torque", "max_speed", "rated_current", "rated_torque"):
            self._hook_limit(f"cia402.{key}")
        self.dictionary.on_change = self._changed
        self._set_lost = lost
        self._load_core()

    # ---- building ------------------------------------------------------------------------------

    def _identify(self) -> None:
        hardware, entries = self.hardware, self.dictionary.by_key
        for key, number in zip(("vendor", "product", "revision", "serial"), hardware.identity, strict=True):
            entries[f"identity.{key}"].put(number)
        entries["device.name"].value = hardware.name.encode("ascii", "replace")
        entries["cia402.rated_current"].put(hardware.rated_current_ma)
        entries["cia402.rated_torque"].put(hardware.rated_torque_mnm)
        if hardware.face is not None:  # set up by its maker's tool
            entries["cia402.max_speed"].put(hardware.factory.get("motor.n_max_rpm"))

    def _recall(self, indices: range) -> None:
        """Take stored values over; a value the present firmware would refuse is left at its default."""
        for key, data in self.store.stored.items():
            if key >> 8 not in indices:
                continue
            try:
                entry = self.dictionary.find(key >> 8, key & 0xFF)
                if entry.row.stored:
                    entry.check(data)
                    entry.value = data
            except Refused:
                continue

    def _stored_set(self) -> tuple[ParameterImage, bool]:
        """Return the set to start with, and whether a stored one had to be left."""
        stored = self.store.stored
        image = stored.get(storing.IMAGE_KEY)
        if image is None:
            return self.hardware.factory.copy(), False
        signature = self.dictionary["parameter_set.signature"].value
        found = ParameterImage.of_bytes(image)
        if stored.get(storing.SIGNATURE_KEY) != signature or found.first_offender() is not None:
            return self.hardware.factory.copy(), True
        return found, False

    def _make_lss(self) -> LssSlave:
        hardware = self.hardware
        return LssSlave(
            hardware.identity,
            hardware.bitrate,
            active_id=lambda: hardware.node_id,
            pending_id=lambda: hardware.next_node_id,
            set_pending=self._set_node_id,
            store=self._store_node_id,
            leave=self._lss_left,
            send=lambda frame: hardware.send(ANSWER_ID, frame),
        )

    def _set_node_id(self, node_id: int) -> None:
        self.hardware.next_node_id = node_id

    def _store_node_id(self, done: Callable[[int], None]) -> None:
        if self.store.busy:
            done(LSS_NOT_STORED)
            return
        content = {**self.store.stored, storing.NODE_ID_KEY: bytes((self.hardware.next_node_id,))}

        def stored(code: int | None) -> None:
            if code is not None:
                self.report_damage()
            done(0 if code is None else LSS_NOT_STORED)

        self.store.write(content, stored)

    def _lss_left(self) -> None:
        if self.nmt is NmtState.INITIALISING and self.hardware.next_node_id <= 127:
            self.hardware.start()

    def _hook_limit(self, key: str) -> None:
        def sink(data: bytes) -> None:
            self.dictionary[key].value = data
            self._load_core()
            self.power.apply()

        self.dictionary[key].sink = sink

    # ---- parameters ----------------------------------------------------------------------------

    def _take_set(self) -> None:
        self._load_core()
        self._forget_configuration()

    def _load_core(self) -> None:
        """Load the active set into the core, cut to the limits of objects 0x6072, 0x6073 and 0x6080."""
        image = self.parameters.active.copy()
        number = {key: self.dictionary[f"cia402.{key}"].number() for key in _LIMIT_KEYS}
        current = number["max_current"] / 1000.0 * number["rated_current"] / 1000.0 * 2.0**0.5
        torque = number["max_torque"] / 1000.0 * number["rated_torque"] / 1000.0
        for name, limit in (
            ("motor.I_max_apk", max(current, 1e-3)),
            ("governor.I_transient_apk", max(current, 1e-3)),
            ("speed.tau_max_nm", torque),
            ("motor.n_max_rpm", max(number["max_speed"], 1.0)),
        ):
            if limit < image.get(name):
                image.set(name, limit)
        self.hardware.take_parameters(image.pack())

    def _changed(self, entry: Entry) -> None:
        if entry.row.index != _CONFIGURATION_INDEX:
            self._forget_configuration()

    def _forget_configuration(self) -> None:
        """Zero 0x1020: what it dated is no longer what the drive holds."""
        for key in ("configuration.date", "configuration.time"):
            self.dictionary[key].put(0)

    def stored_values(self, group: Group) -> Stored:
        """Return what a store of the group keeps now."""
        values = {
            entry.row.index << 8 | entry.row.sub: entry.value
            for entry in self.dictionary
            if entry.row.stored and entry.row.index in group.indices
        }
        if group is Group.PARAMETER_SET:
            values[storing.IMAGE_KEY] = self.parameters.active.pack()
            values[storing.SIGNATURE_KEY] = self.dictionary["parameter_set.signature"].value
        return values

    def store_finished(self, code: int | None) -> None:
        """A store of 0x1010 or 0x1011 is complete, or was given up with an abort code."""
        if code is None:
            self._note_stored_set()
        else:
            self.report_damage()
        self.sdo.finish(code)

    def _note_stored_set(self) -> None:
        image = self.store.stored.get(storing.IMAGE_KEY)
        self.parameters.stored_crc = 0 if image is None else crc32(image)

    # ---- NMT -----------------------------------------------------------------------------------

    def boot(self) -> None:
        """Send the boot-up message and enter PRE-OPERATIONAL."""
        self.hardware.send(0x700 + self.hardware.node_id, b"\0")
        self.enter_silently()
        if self._set_lost:
            self.emergency.raise_error(SET_LOST)

    def enter_silently(self) -> None:
        """Enter PRE-OPERATIONAL as a drive that has been running before anybody listened."""
        self.nmt = NmtState.PRE_OPERATIONAL
        self.heartbeat.start()

    def report_damage(self) -> None:
        """The memory held nothing valid although it was written before, or cannot be written."""
        self.emergency.raise_error(MEMORY_DAMAGED)

    def _is_operational(self) -> bool:
        return self.nmt is NmtState.OPERATIONAL

    def is_energised(self) -> bool:
        """Whether the power stage may drive current."""
        return self.power.state.energised

    def command_nmt(self, command: int) -> None:
        """Obey an NMT command."""
        if command == NmtCommand.RESET_NODE:
            self.hardware.reset()
        elif command == NmtCommand.RESET_COMMUNICATION:
            self._reset_communication()
        elif command == NmtCommand.START and self.nmt is not NmtState.OPERATIONAL:
            self.nmt = NmtState.OPERATIONAL
            self.pdo.start()
        elif command == NmtCommand.STOP:
            self._stop()
            self.power.connection_ended()
        elif command == NmtCommand.PRE_OPERATIONAL:
            self.nmt = NmtState.PRE_OPERATIONAL

    def _stop(self) -> None:
        self.nmt = NmtState.STOPPED
        self.sdo.reset()

    def _reset_communication(self) -> None:
        """Give 0x1000 to 0x1FFF their power-on values; the application does what object 0x6007 says."""
        if self.hardware.next_node_id != self.hardware.node_id:
            self.hardware.reset()  # identifiers of the whole dictionary follow the node id
            return
        self.power.connection_ended()
        self.nmt = NmtState.INITIALISING
        self.sdo.reset()
        self.lss = self._make_lss()  # it is waiting again
        fresh = Dictionary(self.hardware.node_id)
        if self.hardware.face is not None:
            self.hardware.face.dress(fresh)
        for entry in self.dictionary:
            if entry.row.index in Group.COMMUNICATION.indices and entry.row.stored:
                entry.value = fresh.find(entry.row.index, entry.row.sub).value
        self._recall(Group.COMMUNICATION.indices)
        self.pdo.configure()
        self.schedule.after(RESET_COMMUNICATION_S, self.boot)

    def send_state(self) -> None:
        """Send a heartbeat."""
        if self.nmt is not NmtState.INITIALISING:
            self.hardware.send(0x700 + self.hardware.node_id, bytes((self.nmt,)))

    def _heartbeat_lost(self, node: int) -> None:
        self.power.connection_lost(node)
        behaviour = self.dictionary["error.behaviour"].integer()
        if behaviour == 0 and self.nmt is NmtState.OPERATIONAL:
            self.nmt = NmtState.PRE_OPERATIONAL
        elif behaviour == 2:
            self._stop()

    def _send_emergency(self, can_id: int, data: bytes) -> None:
        if self.nmt in (NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL):  # CiA 301, 7.3.2.2.5: not in STOPPED
            self.hardware.send(can_id, data)

    def _send_sdo(self, frame: bytes) -> None:
        self.hardware.send(0x580 + self.hardware.node_id, frame)

    def _withdraw_sdo(self) -> None:
        self.hardware.withdraw(0x580 + self.hardware.node_id)

    # ---- frames and time -----------------------------------------------------------------------

    def receive(self, can_id: int, data: bytes) -> None:
        """Take a frame of the line."""
        if self.nmt is NmtState.INITIALISING:
            if can_id == REQUEST_ID:
                self.lss.receive(data)
            return
        if can_id == 0x600 + self.hardware.node_id:
            if self.nmt is not NmtState.STOPPED:
                self.sdo.receive(data)
        elif can_id == 0:
            if len(data) == 2 and data[1] in (0, self.hardware.node_id):
                self.command_nmt(data[0])
        elif 0x700 < can_id <= 0x77F:
            self.consumer.heard(can_id - 0x700)
        elif can_id == REQUEST_ID:
            self.lss.receive(data)
        elif can_id == self.dictionary["sync.cob_id"].integer():
            self.pdo.sync()
        else:
            self.pdo.receive(can_id, data)

    def asked(self) -> None:
        """Take a remote frame for the node's state."""
        if self.guarding is not None and self.nmt is not NmtState.INITIALISING:
            self.guarding.asked()

    def answer_guarding(self, toggle: int) -> None:
        """Answer a remote frame with the NMT state."""
        self.hardware.send(0x700 + self.hardware.node_id, bytes((self.nmt | toggle,)))

    def attend(self) -> None:
        """Look after what happened in the core since the last time."""
        self.attending = True
        try:
            self.power.check_trip()  # before the excitation, which a trip aborts, too
            self.power.check_position()
            self.measurement.attend()
            self.pdo.changed()
        finally:
            self.attending = False

    def is_lively(self) -> bool:
        """Whether the core must be looked after: a trip, an excitation or the recorder may need a report."""
        return self.power.state is not State.FAULT or self.nmt is NmtState.OPERATIONAL


_LIMIT_KEYS = ("max_current", "rated_current", "max_torque", "rated_torque", "max_speed")
