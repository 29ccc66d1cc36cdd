# SPDX-License-Identifier: MIT
"""A simulated drive with the object dictionary of a maker's file, over plant and CANopen server of ``sim/node``.

Objects that the file lacks do not exist. Objects with a law (``families``) show and command the simulated
machine in the maker's units; all others keep what is written within the file's limits. The motor is entered as the
maker's set-up tool would have done it; everything else holds what the file says.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.errors import ConfigError, NotAvailable
from pmsmtool.sim.foreign.behind import POSITION_MODES, Behind, SetUp, set_up_of
from pmsmtool.sim.foreign.drawn_gains import DrawnGains
from pmsmtool.sim.foreign.families import (
    Law,
    assumed_modes,
    encoder_resolution,
    family_of,
    laws_of,
    modes_of,
    units_of,
)
from pmsmtool.sim.foreign.file_rows import MAPPINGS, MakersObjects, read_makers_objects
from pmsmtool.sim.foreign.position import PositionLoop
from pmsmtool.sim.foreign.trace import MARKS as TRACE_MARKS
from pmsmtool.sim.foreign.trace import RowTrace
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.error_control import NodeGuarding, guarding_of
from pmsmtool.sim.node.factory import SET_UP_BANDWIDTH
from pmsmtool.sim.node.node import VENDOR

if TYPE_CHECKING:
    from pmsmtool.bus.clock import Schedule
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.sim.node.power_drive import Plant, PowerDrive
    from pmsmtool.sim.node.session import Session

COMMUNICATION = frozenset((*range(0x1000, 0x1200), *range(0x1400, 0x1C00)))
"""Objects whose stored value the node's own server takes over; those of the SDO keep the server's."""
LAST_COMMUNICATION = 0x2000
PASSED_ON = (0x603F, 0x6040, 0x6041, 0x6007, 0x605A, 0x605E)
"""State machine and option codes: numbers of the standard, whoever the maker is."""
RATED = ((0x3001, 1), (0x6075, 0))
"""Rated current, of which a torque command is a share."""
HELD = (0x6072, 0x6073, 0x6087)
"""Limits whose stored value acts from the start."""
PDO_OFF = 1 << 31
REVISION = 3
"""Sub-index of the identity object that the file gives; vendor and product it may leave blank."""
PID_MARKS = {(0x30A1, 3), (0x60FB, 3)}
"""Gain of the derivative, by which one controller of the position is known."""
SERIAL = (0x1018, 4)
ENCODER = (0x608F, 1)


class ForeignDrive:
    """What a simulated drive shows instead of its own dictionary: a maker's.

    Parameters
    ----------
    objects : MakersObjects
        Of the file.
    set_up : SetUp
        The motor.
    gains : DrawnGains, optional
        What the objects of the gains mean; without it they mean nothing, and the loops are tuned by their maker.

    Attributes
    ----------
    vendor_product : tuple of int
        Identity; where the file leaves it blank, that of the family it is recognised as.
    assumed : tuple of str
        What the simulated drive does that neither file nor standard says.
    unheld : tuple of str
        What of the motor the file's own limits do not let be entered, one line each.
    too_few_poles : str
        Why the drive cannot commutate the motor: the object of the poles and its limits; empty where it can.
    set_up : SetUp
        The motor, with no more rated current than the drive's object of it holds.
    behind : Behind or None
        The machine behind, while the drive runs; for tests.
    """

    def __init__(self, objects: MakersObjects, set_up: SetUp, gains: DrawnGains | None = None) -> None:
        self.objects = objects
        self.gains = gains
        stated_motor, set_up = set_up, _within(objects, set_up)
        self.laws = laws_of(objects, set_up)
        if gains is not None:
            self.laws |= {(law.index, law.sub): law for law in gains.laws(self.laws)}
        self.set_up = set_up
        family = family_of(objects)
        stated = objects.stored(0x1018, 1), objects.stored(0x1018, 2)
        self.vendor_product = (stated[0] or family.identity[0], stated[1] or family.identity[1])
        self.label = f"simulated {objects.name}"
        own = [f"0x{law.index:04X}:{law.sub:02X} {law.source}" for law in self.laws.values() if "assumed" in law.source]
        blank = [] if all(stated) else [f"0x1018 blank in the file: taken as {self.vendor_product}"]
        reaction = [] if objects.has((0x6007, 0)) else ["no 0x6007: a lost master is a fault (0x605E), voltage off"]
        outside = {law: line for law in self.laws.values() if (line := _outside(objects, law))}
        self.too_few_poles = next((line for law, line in outside.items() if law.commutates), "")
        unheld = [line for law, line in outside.items() if not law.commutates and (law.index, law.sub) != ENCODER]
        if not _holds_encoder(objects, set_up):
            counted = f"{encoder_resolution(objects, set_up.counts):.0f} / {max(1, objects.stored(0x608F, 2))}"
            unheld.append(
                f"0x608F stays {counted}, this motor's encoder has {set_up.counts}: the motor is rehearsed with the "
                "encoder of the drive, and that is not compared"
            )
        if set_up != stated_motor:
            unheld.append(
                f"rated current cut from {stated_motor.i_nom_apk:.4g} to {set_up.i_nom_apk:.4g} A peak, the largest "
                "rated current that this drive holds"
            )
        self.unheld = tuple(unheld)
        self.assumed = (*objects.assumed, *own, *blank, *reaction, *unheld)
        self.behind: Behind | None = None

    def dress(self, dictionary: Dictionary) -> None:
        """Put the maker's objects into a dictionary whose application is not hooked up yet."""
        server = {(entry.row.index, entry.row.sub): entry for entry in dictionary}
        for index in {index for index, _ in server}:
            dictionary.hide(index)
            if index in COMMUNICATION and 0x1400 <= index and index not in MAPPINGS:
                server[index, 1].put(PDO_OFF)  # one that the file lacks
        serial = dictionary["identity.serial"].integer()
        own_serial = family_of(self.objects).serial
        for (index, sub), row in self.objects.rows.items():
            kept = server.get((index, sub))
            if index < LAST_COMMUNICATION and kept is not None and kept.row.type == row.type:
                known = row.default or index in MAPPINGS  # a blank entry of a mapping names nothing
                if index in COMMUNICATION and (index != 0x1018 or sub == REVISION) and known:
                    kept.value = row.default_bytes(dictionary.node)
                kept.row = replace(kept.row, stored=row.stored)
                kept.readable, kept.writable = row.access != "wo", row.access in ("rw", "wo")
                dictionary.show(kept)
                continue
            entry = Entry(row, dictionary.node)
            law = self.laws.get((index, sub))
            if law is not None and law.set_up is not None:
                low, high = row.bounds
                entry.value = entry.encode(min(max(law.set_up, low), high))  # no more than the drive can give
            if (index, sub) in (SERIAL, own_serial) and entry.code is not None:
                entry.value = entry.encode(serial)
            dictionary.show(entry)
        dictionary.find(0x6502, 0).value = self._modes_word(dictionary)
        if not self.objects.has((0x6007, 0)):
            dictionary["cia402.abort_connection"].put(1)
            if not self.objects.has((0x605E, 0)):
                dictionary["cia402.fault_reaction"].put(0)

    def _modes_word(self, dictionary: Dictionary) -> bytes:
        modes = sum(1 << mode - 1 for mode in modes_of(self.objects) if mode > 0)
        return dictionary.find(0x6502, 0).encode(modes)

    def attach(self, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
        """Let the objects show and command the running machine, and what they hold take effect."""
        self.behind = behind = Behind(dictionary, plant, power, self.set_up)
        inner = {(e.row.index, e.row.sub): e for e in dictionary.by_key.values() if e.row.index in PASSED_ON}
        for (index, sub), entry in inner.items():
            if self.objects.has((index, sub)):
                _pass_on(dictionary, dictionary.find(index, sub), entry)
        behind.tune_speed_loop()
        drawn = self.gains is not None and self.gains.position is not None
        if drawn or not PID_MARKS & set(self.laws):
            behind.position_gains.pid = None  # a position gain on the speed controller (assumed)
        for law in self.laws.values():
            _obey(law, dictionary.find(law.index, law.sub), behind)
        if self.gains is not None:
            behind.sample_speed(self.gains.filter_hz, self.gains.decimation)
            if self.gains.current is None:  # else its own counts have set them
                behind.speed_current_loops(self.gains.current_bandwidth / SET_UP_BANDWIDTH)
        self._hook_modes(dictionary, behind)
        if self.objects.has(*TRACE_MARKS):
            RowTrace(self.objects, dictionary, behind)
        if any(mode in POSITION_MODES for mode in modes_of(self.objects)):
            per_turn, per_rps, _ = units_of(self.objects, self.set_up)
            period_s = family_of(self.objects).loop_s
            loop = PositionLoop(behind, dictionary, power, schedule, per_turn, per_rps, period_s)
            loop.hook(lambda: dictionary.find(0x6060, 0).integer())

    def _hook_modes(self, dictionary: Dictionary, behind: Behind) -> None:
        mode, display = dictionary.find(0x6060, 0), dictionary.find(0x6061, 0)
        modes = modes_of(self.objects)

        def choose(data: bytes) -> None:
            number = int.from_bytes(data[:1], "little", signed=True)
            if number and number not in modes:
                raise Refused(AbortCode.VALUE)
            behind.command_mode(4 if number == -3 else 3 if number == -2 else number)
            mode.value = bytes(data)

        mode.sink = choose
        display.source = lambda: mode.value
        with contextlib.suppress(Refused):
            choose(mode.value)

    def guarding(self, session: Session) -> NodeGuarding | None:
        """Return node guarding where the file has its objects."""
        return guarding_of(session)


def assumptions_of(file: str, machine_file: MachineFile | None = None) -> tuple[str, ...]:
    """Return what a rehearsal with a file (path, or ``TABLE.csv#FAMILY``) assumes of the drive, one line each.

    That is the modes of operation, where the file does not announce them, and what of a motor its limits cannot hold;
    before them stands how odd lines of the file are read.

    Raises ConfigError: as ``file_rows.read_makers_objects``; or, with a motor, the file is that of the reference drive,
    which is simulated itself; NotAvailable: the drive's own object of the poles does not hold the motor's.
    """
    objects = read_makers_objects(file)
    if machine_file is not None and objects.stored(0x1018, 1) == VENDOR:
        raise ConfigError(
            "the file is that of the reference drive, no other maker's", where=file,
            hint="give MACHINE as --sim MACHINE: that is the reference drive with this motor",
        )  # fmt: skip
    assumed = assumed_modes(objects)
    modes = ", ".join(str(bit + 1) for bit in range(16) if assumed >> bit & 1)
    lines = objects.odd + (
        (f"0x6502 is blank: modes {modes} are assumed by its objects; a real drive reports its own",) if assumed else ()
    )
    if machine_file is None:
        return tuple(lines)
    drive = ForeignDrive(objects, set_up_of(machine_file))
    if drive.too_few_poles:
        raise NotAvailable(
            f"this drive cannot commutate this motor of {set_up_of(machine_file).pole_pairs} pole pairs: "
            f"{drive.too_few_poles}",
            where=file,
            likely="the drive is made for other motors, or pole_pairs of MACHINE counts poles",
            hint="take the file of another drive, or correct pole_pairs in MACHINE",
        )
    return (*lines, *drive.unheld)


def rehearsed_motor(path: Path, file: str | None) -> MachineFile:
    """Return a machine file, without the encoder where the drive of a file cannot be set up for it: it has its own."""
    from pmsmtool.machine.machine_file import load_machine_file

    motor = load_machine_file(path)
    if file is None or _holds_encoder(read_makers_objects(file), set_up_of(motor)):
        return motor
    return replace(motor, encoder=replace(motor.encoder, bits=None))


def _holds_encoder(objects: MakersObjects, set_up: SetUp) -> bool:
    """Whether the drive counts the encoder that the motor has."""
    counts = encoder_resolution(objects, set_up.counts) / max(1, objects.stored(0x608F, 2))
    return not objects.has((0x608F, 1)) or counts == set_up.counts


def _outside(objects: MakersObjects, law: Law) -> str:
    """Say what an object takes and the motor needs, by the maker's own name of it; nothing where it holds that."""
    row = objects.rows[law.index, law.sub]
    low, high = row.bounds
    if law.set_up is None or low <= law.set_up <= high:
        return ""
    named = f"0x{law.index:04X}:{law.sub:02X} ({row.name}) takes {low:.0f} to {high:.0f}, this motor needs "
    if law.commutates:
        return f"{named}{law.set_up:.0f}"
    size = "smaller" if law.set_up > high else "larger"
    return f"{named}{law.set_up:.0f}: {min(max(law.set_up, low), high):.0f} is set, likely a drive for {size} motors"


def _within(objects: MakersObjects, set_up: SetUp) -> SetUp:
    """Return the motor with no more rated current than the drive's own object of it holds, and so much less torque."""
    shares = [
        float(objects.rows[law.index, law.sub].bounds[1] or math.inf) / law.set_up
        for law in laws_of(objects, set_up).values()
        if (law.index, law.sub) in RATED and law.set_up
    ]
    share = min([1.0, *shares])
    return replace(set_up, i_nom_apk=share * set_up.i_nom_apk, torque_nm=share * set_up.torque_nm)


def _pass_on(dictionary: Dictionary, shown: Entry, inner: Entry) -> None:
    """Let a maker's object be the application's own, number for number."""
    if shown.readable and inner.source is not None:
        shown.shows(inner.number)
        if not shown.writable:
            return
    if inner.writable and shown.writable:
        take = _taken(shown, lambda number: bool(dictionary.write(inner, inner.encode(number))))
        with contextlib.suppress(Refused):
            if shown.row.index != 0x6040 and shown.row.default:
                take(shown.value)
        shown.sink = take


def _obey(law: Law, entry: Entry, behind: Behind) -> None:
    show, act = law.show, law.act
    if show is not None:
        entry.shows(lambda: show(behind))
    if act is not None:
        entry.sink = _taken(entry, lambda number: bool(act(behind, number)))
        if law.set_up is not None or law.index in HELD:
            with contextlib.suppress(Refused):  # a stored value beyond what the machine behind takes
                act(behind, entry.number())


def _taken(entry: Entry, act: Callable[[float], object]) -> Callable[[bytes], None]:
    def sink(data: bytes) -> None:
        before, entry.value = entry.value, bytes(data)
        try:
            act(float(entry.decode(data)))
        except Refused:
            entry.value = before
            raise

    return sink
