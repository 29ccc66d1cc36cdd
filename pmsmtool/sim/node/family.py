# SPDX-License-Identifier: MIT
"""The same simulated drive behind the object dictionary of another family: scaled integers, quantised gains.

A face hides the reference drive's own objects and shows those a drive map names (``firmware-params/<family>``). What
is written there is what counts: the bytes are kept, and the drive works with the SI value they mean. Modes the family
does not have are refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.clock import Schedule
from pmsmtool.cia402 import Mode
from pmsmtool.data_types import SHORT
from pmsmtool.drive_maps.drive_map import REFERENCE_PRODUCT, REFERENCE_VENDOR, Cell, DriveMap, SignalCell
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.wire_units import WireUnit, wire_unit
from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import BY_NAME, TORQUE_PER_AMPERE
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Guarding, Refused
from pmsmtool.sim.node.error_control import guarding_of
from pmsmtool.sim.node.makers_recorders import Monitor, Rings, TraceRows
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.own_measurements import OsCommands
from pmsmtool.sim.node.position_modes import INCREMENTS, PID, PROFILE, SPEED, PositionSide, pid_of
from pmsmtool.sim.node.power_drive import Plant, PowerDrive
from pmsmtool.units import RAD_S_PER_MRPM

if TYPE_CHECKING:
    from pmsmtool.sim.node.session import Session

OWN = range(0x2000, 0x6000)
"""Indices of the reference drive's own objects."""
STANDARD = range(0x6000, 0x6800)
"""Indices of the standard's objects of one axis."""
DATA_SHEET = (0x1021, 0x1022)
"""Stored data sheet: the reference drive's would describe another drive."""
ONE_FOR_BOTH_AXES = {
    "current.K_p_q_v_per_a": ("current.K_p_d_v_per_a",),
    "current.K_i_q_v_per_as": ("current.K_i_d_v_per_as",),
    "motor.L_q_h": ("motor.L_d_h", "motor.L_q_app_h", "motor.L_d_app_h"),
}
"""Where a family has one object only, its value acts on these as well."""
MODE_BITS = {
    Mode.PROFILE_POSITION: 0,
    Mode.PROFILE_VELOCITY: 2,
    Mode.PROFILE_TORQUE: 3,
    Mode.CYCLIC_VELOCITY: 8,
    Mode.CYCLIC_TORQUE: 9,
    Mode.CYCLIC_TORQUE_ANGLE: 10,
}
"""Bits of object 0x6502."""
COMMUTATION_ANGLE = 0x60EA
ANGLE_COUNT_RAD = 2.0 * math.pi / 65536.0
LACKS: Mapping[str, tuple[int, ...]] = {
    "copley": (
        0x1011, 0x1016, 0x1029, 0x6007, 0x605E, 0x6072, 0x6073, 0x6075, 0x6078, 0x6079, 0x607F, 0x6080, 0x608F, 0x6402,
    ),
    "elmo": (0x1015, 0x6079, 0x60B2),
    "epos2": (
        0x1015, 0x1029, 0x605A, 0x6072, 0x6073, 0x6074, 0x6075, 0x6076, 0x6077, 0x6079, 0x6080, 0x6087, 0x608F, 0x60B2,
        0x60FD, 0x6403, 0x6404,
    ),
    "epos4": (
        0x1015, 0x6072, 0x6073, 0x6074, 0x6075, 0x6078, 0x6079, 0x607C, 0x6087, 0x608F, 0x6403, 0x6404,
    ),
    "faulhaber": (
        0x1015, 0x6007, 0x605A, 0x605E, 0x6065, 0x6072, 0x6073, 0x6074, 0x6075, 0x6076, 0x6077, 0x6079, 0x6080, 0x6087,
        0x60B2, 0x60C2, 0x6402, 0x6403, 0x6404,
    ),
    "nanotec": (0x1015, 0x6076, 0x6078, 0x6079, 0x6402, 0x6403, 0x6404),
    "zeroerr": (0x1011, 0x1015, 0x6007, 0x605A, 0x6072, 0x6073, 0x6402, 0x6403, 0x6404),
}  # fmt: skip
"""Objects of CiA 301 and CiA 402 that no public EDS of a maker has (the files that its map names as ``eds``), of those
that others' have. ZeroErr has no 0x608F either, which stays: the simulated encoder is not its own."""
GUARDING = (0x100C, "UNSIGNED16", "Guard time"), (0x100D, "UNSIGNED8", "Life time factor")
"""Of a drive without consumer heartbeat."""
LEVEL_HIDES = {"inject": (0x2063, 0x2064), "recorder": (0x2050, 0x2051, 0x2052, 0x2063, 0x2064)}
"""What a reduced reference drive does not have: window averages; the excitation and current set-points too."""
RECORDERS: Mapping[str, Callable[[DriveMap, Dictionary, Plant], object]] = {
    "index": Monitor,
    "rows": TraceRows,
    "rings": Rings,
}
"""Makers' recorders by the kind a map says."""
BEHIND = {
    "rated_current": "cia402.rated_current",
    "current_limit": "cia402.max_current",
    "target_current": "cia402.target_torque",
    "asked_current": "cia402.torque_demand",
    "current": "live.i_q_a",
    "counts_per_turn": "cia402.encoder_counts",
}
"""What acts behind a maker's own object, by row of [motion]."""
_LIVE = {
    "position_rad": "live.theta_m_rad",
    "i_q_a": "live.i_q_a",
    "i_d_a": "live.i_d_a",
    "u_q_v": "live.u_q_v",
    "u_d_v": "live.u_d_v",
    "U_dc_v": "live.U_dc_v",
}


@dataclass(frozen=True, slots=True)
class Face:
    """What a simulated drive shows instead of its own dictionary."""

    drive_map: DriveMap
    """The family."""

    @property
    def vendor_product(self) -> tuple[int, int]:
        """Identity that the family's map names."""
        return self.drive_map.vendor, self.drive_map.product

    @property
    def label(self) -> str:
        """Beginning of the device name."""
        return f"simulated {self.drive_map.name}"

    @property
    def modes(self) -> tuple[Mode, ...]:
        """Modes of operation the family has."""
        has = self.drive_map.capabilities
        torque = (Mode.PROFILE_TORQUE, Mode.CYCLIC_TORQUE) if has.torque_mode else ()
        velocity = (Mode.PROFILE_VELOCITY, Mode.CYCLIC_VELOCITY) if has.velocity_mode else ()
        return (
            Mode.PROFILE_POSITION,
            *velocity,
            *torque,
            *((Mode.CYCLIC_TORQUE_ANGLE,) if has.commutation_angle else ()),
        )

    def dress(self, dictionary: Dictionary) -> None:
        """Put the family's objects into a dictionary whose application is not hooked up yet."""
        hidden = {entry.row.index for entry in dictionary if entry.row.index in OWN or entry.row.index in DATA_SHEET}
        if not self.drive_map.capabilities.torque_mode:
            hidden |= {0x6071, 0x6074, 0x6087, 0x60B2}
        if not self.drive_map.capabilities.velocity_mode:
            hidden |= {0x60FF}
        own = {name: row for name, row in self.drive_map.motion.items() if name in BEHIND and row.index}
        hidden.update(LACKS.get(self.drive_map.name, ()))
        for index in hidden:
            dictionary.hide(index)
        if 0x1016 in hidden:
            for index, wire, name in GUARDING:
                dictionary.show(_entry(index, 0, wire, name, "rw", "0", True))
        if 0x6007 in hidden:  # a lost master is a fault then, and takes the voltage away
            dictionary["cia402.abort_connection"].put(1)
            if 0x605E in hidden:
                dictionary["cia402.fault_reaction"].put(0)
        for name, signal in self.drive_map.signals.items():
            dictionary.show(_signal_entry(name, signal, dictionary))
        for name, row in own.items():
            dictionary.show(_motion_entry(name, row, dictionary))
        revisions = self.drive_map.identity.revisions
        if revisions:
            dictionary["identity.revision"].put(revisions[-1] << 16)
        tuning = self.drive_map.vendor_tuning
        modes = {} if tuning is None else {tuning.mode: Mode.IDENTIFICATION}
        modes |= {row.mode: Mode.CYCLIC_TORQUE for name, row in own.items() if name == "target_current"}
        parameters = _Parameters(self.drive_map, dictionary)
        for entry in (*_modes(self.modes, dictionary, modes, parameters.choose), *parameters.entries()):
            dictionary.show(entry)

    def attach(self, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
        """Put the family's own functions over the running application, and what it kept of a move in effect."""
        for cell in self.drive_map.cells.values():
            kept = dictionary.find(cell.index, cell.sub)
            if cell.name in PROFILE and kept.value:
                dictionary.write(kept, kept.value)
        kind = RECORDERS.get(self.drive_map.capabilities.recorder)
        if kind is not None:
            kind(self.drive_map, dictionary, plant)
        if self.drive_map.vendor_tuning is not None:
            OsCommands(self.drive_map.vendor_tuning, dictionary, plant, power, schedule)

    def guarding(self, session: Session) -> Guarding | None:
        """Return node guarding where the family has it."""
        return guarding_of(session)


@dataclass(frozen=True, slots=True)
class Reduced:
    """The reference drive without a part of its own objects: what a lower level leaves."""

    level: str
    """Key of :data:`LEVEL_HIDES`."""

    @property
    def vendor_product(self) -> tuple[int, int]:
        """The reference drive's: its identity does not tell what it lacks."""
        return REFERENCE_VENDOR, REFERENCE_PRODUCT

    @property
    def label(self) -> str:
        """Beginning of the device name."""
        return "pmsmsim"

    def attach(self, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
        """Do nothing: the application is the reference drive's."""

    def guarding(self, session: object) -> None:
        """Return none."""

    def dress(self, dictionary: Dictionary) -> None:
        """Hide what the level does not have."""
        for index in LEVEL_HIDES[self.level]:
            dictionary.hide(index)
        if self.level == "recorder":
            modes = [mode for mode in MODE_BITS if mode is not Mode.CYCLIC_TORQUE_ANGLE]
            for entry in _modes(modes, dictionary):
                dictionary.show(entry)


def _modes(
    modes: Sequence[Mode],
    dictionary: Dictionary,
    own: Mapping[int, Mode] = MappingProxyType({}),
    chosen: Callable[[], None] = lambda: None,
) -> Iterator[Entry]:
    """Yield the objects of the modes of operation, without those the drive does not have.

    Torque with the master's commutation angle is the reference drive's current set-point at a fixed angle; a mode of
    the maker's ``own`` is one of the reference drive's (identification: without any set-point). ``chosen`` is told of
    every choice.
    """
    inner = dictionary["cia402.mode"]
    shown = _entry(0x6060, 0, "INTEGER8", "Modes of operation", "rw", "R", True)
    display = _entry(0x6061, 0, "INTEGER8", "Modes of operation display", "ro", "T", False)

    def sink(data: bytes) -> None:
        mode = int.from_bytes(data, "little", signed=True)
        if mode not in (Mode.NONE, *modes, *own):
            raise Refused(AbortCode.VALUE)
        behind = own.get(mode, Mode.IDENTIFICATION if mode == Mode.CYCLIC_TORQUE_ANGLE else mode)
        dictionary.write(inner, inner.encode(behind))
        shown.value = data
        chosen()

    shown.sink = sink
    display.source = lambda: shown.value
    yield from (shown, display)
    dictionary["cia402.supported_modes"].put(sum(1 << MODE_BITS[mode] for mode in modes))
    if Mode.CYCLIC_TORQUE_ANGLE in modes:
        yield from _commutation(shown, dictionary)


def _commutation(mode: Entry, dictionary: Dictionary) -> Iterator[Entry]:
    """Yield 0x60EA, and a target torque that is a current at that angle while mode 11 is chosen."""
    angle = _entry(COMMUTATION_ANGLE, 0, "UNSIGNED16", "Commutation angle", "rw", "R", False)
    torque = _entry(0x6071, 0, "INTEGER16", "Target torque", "rw", "R", False)
    fixed, current = dictionary["set_point.fixed_angle_rad"], dictionary["set_point.i_q_a"]
    own = dictionary["cia402.target_torque"]

    def turn(data: bytes) -> None:
        angle.value = data
        dictionary.write(fixed, fixed.encode(angle.integer() * ANGLE_COUNT_RAD))

    def push(data: bytes) -> None:
        torque.value = data
        if mode.integer() == Mode.CYCLIC_TORQUE_ANGLE:
            rated_apk = 1e-3 * math.sqrt(2.0) * dictionary["cia402.rated_current"].number()
            dictionary.write(current, current.encode(1e-3 * torque.integer() * rated_apk))
        else:
            dictionary.write(own, data)

    angle.sink, torque.sink = turn, push
    yield from (angle, torque)


class _Parameters:
    """The mapped parameters of one session: bytes as the family keeps them, SI values for the drive behind."""

    def __init__(self, drive_map: DriveMap, dictionary: Dictionary) -> None:
        self._map = drive_map
        self._dictionary = dictionary
        self._shown: dict[str, Entry] = {}
        self._side = PositionSide(dictionary, self._held) if PID[0] in drive_map.cells else None

    def choose(self) -> None:
        """Let the gains of a mode act that was chosen."""
        if self._side is not None:
            self._side.apply()

    def _held(self, name: str) -> float:
        """Return what the family's object holds (SI)."""
        cell = self._map.cells[name]
        values = {cell.gain: self._number(cell.gain)} if cell.gain else {}
        return float(cell.decode(self._source(cell)(), values))

    def entries(self) -> Iterator[Entry]:
        """Make the entries."""
        for cell in self._map.cells.values():
            if cell.index in STANDARD and self._has(cell) and cell.name not in PROFILE:
                continue  # works as the standard says, for every family
            parameter = BY_NAME[cell.name]
            pdo = "R" if parameter.live else "0"
            entry = _entry(cell.index, cell.sub, cell.wire, parameter.meaning, "rw", pdo, True)
            entry.value = b""  # not taken from the factory's set yet
            entry.source, entry.sink = self._source(cell), self._sink(cell)
            self._shown[cell.name] = entry
            yield entry

    def _has(self, cell: Cell) -> bool:
        """Whether the drive itself has the object, in the type of the map."""
        return any(
            (entry.row.index, entry.row.sub, entry.row.type) == (cell.index, cell.sub, SHORT[cell.wire])
            for entry in self._dictionary
        )

    def _source(self, cell: Cell) -> Callable[[], bytes]:
        def read() -> bytes:
            shown = self._shown[cell.name]
            if not shown.value:
                shown.value = self._counted(cell, shown)
            return shown.value

        return read

    def _counted(self, cell: Cell, shown: Entry) -> bytes:
        """Return the factory's value as this family would keep it, cut to what its type holds."""
        values = {name: self._number(name) for name in (cell.name, cell.gain) if name}
        counts = cell.counts(values[cell.name], values)
        return shown.encode(counts if math.isfinite(counts) else math.copysign(1e30, counts))

    def _number(self, name: str) -> float:
        """Return a value of the drive behind (SI); what that has no object for is as its maker's tool leaves it."""
        if name in self._dictionary.by_key:
            return self._dictionary[name].number()
        if name in PROFILE:
            return self._dictionary[PROFILE[name]].number() / self._per_rpm()
        if name == INCREMENTS:
            return self._dictionary["cia402.encoder_counts"].number()
        if name in PID:
            return pid_of(*(self._dictionary[key].number() for key in (*SPEED, "position.K_p_per_s")))[name]
        if name == TORQUE_PER_AMPERE:  # amperes are rms here, as those of the rated current
            poles, flux = (self._dictionary[f"motor.{key}"].number() for key in ("pole_pairs", "psi_f_wb"))
            return 1.5 * math.sqrt(2.0) * poles * flux
        return BY_NAME[name].default

    def _per_rpm(self) -> float:
        """Return increments per second of 1 rpm."""
        return self._dictionary["cia402.encoder_counts"].number() / 60.0

    def _sink(self, cell: Cell) -> Callable[[bytes], None]:
        def write(data: bytes) -> None:
            self._act(cell, data)
            self._shown[cell.name].value = bytes(data)
            if cell.name in (*PID, *SPEED):
                self.choose()
            for other in self._map.cells.values():
                if other.gain == cell.name and other.name in self._shown and self._shown[other.name].value:
                    self._follow(other)

        return write

    def _follow(self, cell: Cell) -> None:
        """An integral time stays what it is when its gain changes; the integral gain follows, as far as it may."""
        try:
            self._act(cell, self._shown[cell.name].value)
        except Refused:
            return

    def _act(self, cell: Cell, data: bytes) -> None:
        values = {cell.gain: self._number(cell.gain)} if cell.gain else {}
        try:
            value = cell.decode(data, values)
        except ConfigError as error:
            raise Refused(AbortCode.VALUE) from error
        if not math.isfinite(value):
            raise Refused(AbortCode.VALUE)
        others = [name for name in ONE_FOR_BOTH_AXES.get(cell.name, ()) if name not in self._map.cells]
        if cell.name in PROFILE:
            inner = self._dictionary[PROFILE[cell.name]]
            self._dictionary.write(inner, inner.encode(value * self._per_rpm()))
            return
        if cell.name in SPEED and self._side is not None:
            return  # acts with its mode
        for name in (cell.name, *others):
            if name not in self._dictionary.by_key:
                continue  # kept for the family, without effect on the drive behind
            inner = self._dictionary[name]
            self._dictionary.write(inner, inner.encode(value))


def _motion_entry(name: str, row: MotionObject, dictionary: Dictionary) -> Entry:
    """Return the maker's own object of a current or of the encoder's counts.

    Amperes that no source says to be peak or rms are rms, as those of the rated current; torque counts as current.
    """
    takes = name in ("rated_current", "current_limit", "target_current")
    entry = _entry(row.index, row.sub, row.wire, name, "rw" if takes else "ro", "R" if takes else "T", False)
    base, rated = dictionary[BEHIND[name]], dictionary["cia402.rated_current"]

    def per_count() -> float:
        """Return what one count of the standard's object is worth, as the row counts (A peak, counts of a turn)."""
        if name in ("current", "counts_per_turn"):
            return 1.0
        return 1e-3 * math.sqrt(2.0) * (1.0 if name == "rated_current" else 1e-3 * rated.number())

    kept: dict[bytes, bytes] = {}

    def sink(data: bytes) -> None:
        dictionary.write(base, base.encode(entry.decode(data) * row.per_count / per_count()))
        kept.clear()
        kept[base.value] = bytes(data)

    def source() -> bytes:
        held = base.number() * per_count()
        if name == "current_limit":  # as the maker's tool leaves it: that of the motor
            held = min(held, dictionary["motor.I_max_apk"].number())
        return kept.get(base.value) or entry.encode(held / row.per_count)

    entry.source = source
    if takes:
        entry.sink = sink
    return entry


def _signal_entry(name: str, signal: SignalCell, dictionary: Dictionary) -> Entry:
    """Return the entry of a live quantity or a reference in the family's counts."""
    unit = wire_unit(signal.unit)
    target = name.startswith("target_")
    entry = _entry(signal.index, signal.sub, signal.wire, name, "rw" if target else "ro", "R" if target else "T", False)

    def scale() -> float:
        return _scale(unit, dictionary)

    entry.shows(lambda: _quantity(name, dictionary) / scale())
    if target:

        def sink(data: bytes) -> None:
            inner, per_count = _target(name, dictionary)
            dictionary.write(inner, inner.encode(entry.decode(data) * scale() / per_count))

        entry.sink = sink
    return entry


def _scale(unit: WireUnit, dictionary: Dictionary) -> float:
    """Return one count in SI; relative ones by the rated current (mA rms, here as peak) or torque (mN m)."""
    if unit.relative_to == 0x6075:
        return unit.scale * 1e-3 * dictionary["cia402.rated_current"].number() * math.sqrt(2.0)
    if unit.relative_to == 0x6076:
        return unit.scale * 1e-3 * dictionary["cia402.rated_torque"].number()
    return unit.scale


def _quantity(name: str, dictionary: Dictionary) -> float:
    if name in _LIVE:
        return dictionary[_LIVE[name]].number()
    if name in ("target_torque_nm", "target_omega_M_rad_s"):
        inner, per_count = _target(name, dictionary)
        return inner.number() * per_count
    if name == "torque_nm":
        return dictionary["cia402.torque"].number() * 1e-6 * dictionary["cia402.rated_torque"].number()
    return dictionary["cia402.velocity"].number() * RAD_S_PER_MRPM


def _target(name: str, dictionary: Dictionary) -> tuple[Entry, float]:
    """Return the reference drive's object of a reference, and its SI value per count."""
    if name == "target_torque_nm":
        return dictionary["cia402.target_torque"], 1e-6 * dictionary["cia402.rated_torque"].number()
    return dictionary["cia402.target_velocity"], RAD_S_PER_MRPM


def _entry(index: int, sub: int, wire: str, name: str, access: str, pdo: str, stored: bool) -> Entry:
    return Entry(ObjectRow(index, sub, "", name, SHORT[wire], access, pdo, default="0", stored=stored))
