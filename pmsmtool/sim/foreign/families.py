# SPDX-License-Identifier: MIT
"""The makers' own objects, family by family: each law with its source or ``assumed``.

Where no public source says whether a current is peak or rms, one reading is taken and marked ``assumed``; the tool must
not know which. A law says what an object means to the machine behind it: unit, set-up value, what is shown, what acts.

This is the simulated drive's own decoding. It shares nothing with the drive maps of the tool, so that a map with a
wrong unit meets a drive that takes its bytes for something else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pmsmtool.sim.foreign.behind import Behind, SetUp, stored_gains
from pmsmtool.sim.foreign.file_rows import MakersObjects

ASSUMED = "assumed"
STANDARD = "CiA 402-2"
PROFILE_SHARE, PROFILE_RPS2 = 0.2, 40.0
"""Speed of a move over the largest one, and its acceleration (turns/s2), where the file leaves them blank."""


@dataclass(frozen=True, slots=True)
class Law:
    """What one object means."""

    index: int
    sub: int
    """The object."""
    source: str
    """Where it is stated, or ``assumed``."""
    set_up: float | None = None
    """What the maker's set-up tool leaves in it, in counts; None: what the file says stays."""
    show: Callable[[Behind], float] | None = None
    """Returns the counts it shows."""
    act: Callable[[Behind, float], None] | None = None
    """Takes the counts that are written."""
    commutates: bool = False
    """Whether the drive commutates by it, so that no other number will do."""


TENTH_OF_DEGREE, RPM, RPS = 0xFF41, 0xB447, 0xB403
_DEGREE, _REVOLUTION, _MINUTE, _SECOND = 0x41, 0xB4, 0x47, 0x03
_ANGLES = {0x10: 2.0 * math.pi, _DEGREE: 360.0, 0x42: 360.0 * 60.0, 0x43: 360.0 * 3600.0, _REVOLUTION: 1.0}
"""Units of an angle per turn, by CiA 303-2: radian, degree, minute and second of arc, revolution."""
DECIMAL_PREFIX = {0x00: 0, 0xFF: -1, 0xFE: -2, 0xFD: -3, 0xFC: -4, 0xFB: -5, 0xFA: -6, 0x01: 1, 0x02: 2, 0x03: 3}


def _unit(word: int) -> tuple[float, int, int]:
    """Return factor, numerator and denominator of an SI unit object (CiA 303-2: prefix, numerator, denominator)."""
    prefix, numerator, denominator = word >> 24 & 0xFF, word >> 16 & 0xFF, word >> 8 & 0xFF
    return 10.0 ** DECIMAL_PREFIX.get(prefix, 0), numerator, denominator


def position_units(objects: MakersObjects, counts: int) -> float:
    """Return the units of 0x6064 per turn of the motor."""
    factor, numerator, _ = _unit(objects.stored(0x60A8))
    gear = max(1, objects.stored(0x6091, 1)) / max(1, objects.stored(0x6091, 2))
    if numerator in _ANGLES:
        return _ANGLES[numerator] / factor / gear
    feed, shaft = objects.stored(0x6092, 1), max(1, objects.stored(0x6092, 2))
    if feed > 1:
        return feed / shaft / gear
    scale = max(1, objects.stored(0x6093, 1)) / max(1, objects.stored(0x6093, 2))  # increments per unit (CiA 402, 2002)
    return encoder_resolution(objects, counts) / max(1, objects.stored(0x608F, 2)) / scale


def encoder_resolution(objects: MakersObjects, counts: int) -> float:
    """Return what 0x608F:01 holds once the motor is entered, as near as its type and the file's limits let it.

    A file's own number stays where the object cannot be written, and where position has other units anyway.
    """
    row, wanted = objects.rows.get((0x608F, 1)), wanted_resolution(objects, counts)
    if row is None or not row.data_type.letter or row.access != "rw":
        return wanted
    low, high = row.bounds
    return float(round(min(max(wanted, low, 1.0), high)))


def wanted_resolution(objects: MakersObjects, counts: int) -> float:
    """Return what 0x608F:01 should hold with the motor: the file's own number where it is fixed."""
    row, stated = objects.rows.get((0x608F, 1)), objects.stored(0x608F, 1)
    fixed = stated > 1 and (row is None or row.access != "rw")
    return float(stated if fixed else counts * max(1, objects.stored(0x608F, 2)))


def speed_units(objects: MakersObjects, per_turn: float) -> tuple[float, str]:
    """Return the units of 0x606C and 0x60FF per turn per second, and where that is stated."""
    factor, numerator, denominator = _unit(objects.stored(0x60A9))
    if numerator == _REVOLUTION and denominator in (_MINUTE, _SECOND):
        return (60.0 if denominator == _MINUTE else 1.0) / factor, "0x60A9 of the file"
    return per_turn, f"{ASSUMED}: units of position per second"


def standard_laws(objects: MakersObjects, set_up: SetUp, per_turn: float, per_rps: float, speed: str) -> Iterator[Law]:
    """Yield what CiA 402 says of its own objects, with the motor in them.

    Rated current is taken as rms (``assumed``: the standard leaves it open).
    """
    i_rms_ma = 1000.0 * set_up.i_nom_apk / math.sqrt(2.0)
    torque = set_up.torque_nm
    yield Law(0x6075, 0, f"{STANDARD}, mA; rms {ASSUMED}", set_up=i_rms_ma)
    yield Law(0x6076, 0, f"{STANDARD}, mN m", set_up=1000.0 * torque)
    most = 1000.0 * set_up.i_max_apk / set_up.i_nom_apk
    yield Law(
        0x6073, 0, f"{STANDARD}, permille of 0x6075", set_up=most if objects.stored(0x6073) == 0 else None,
        act=lambda behind, n: behind.limit_current(1e-3 * n * set_up.i_nom_apk),
    )  # fmt: skip
    unset = objects.stored(0x6072) == 0
    yield Law(
        0x6072, 0, f"{STANDARD}, permille of the rated torque", set_up=1000.0 if unset else None,
        act=lambda behind, n: behind.limit_torque(1e-3 * n * torque),
    )  # fmt: skip
    yield Law(0x6080, 0, f"{STANDARD}, rpm", set_up=set_up.n_max_rpm, act=lambda behind, n: behind.limit_speed(n))
    yield Law(
        0x6071, 0, f"{STANDARD}, permille of the rated torque",
        act=lambda behind, n: behind.command_torque(1e-3 * n * torque),
    )  # fmt: skip
    yield Law(0x60EA, 0, f"{STANDARD}, 65536 a turn", set_up=0.0, act=lambda behind, n: behind.command_angle(n))
    if objects.stored(0x6087):  # 0: the file does not say; no slope is assumed
        yield Law(0x6087, 0, f"{STANDARD}, permille/s", act=lambda behind, n: behind.torque_slope(n))
    yield Law(
        0x6074, 0, f"{STANDARD}, permille of the rated torque",
        show=lambda behind: 1000.0 * behind.i_q_asked_a() * set_up.torque_constant / torque,
    )  # fmt: skip
    yield Law(0x6077, 0, STANDARD, show=lambda behind: 1000.0 * behind.torque_nm() / torque)
    yield Law(0x6078, 0, STANDARD, show=lambda behind: 1000.0 * behind.i_q_a() / set_up.i_nom_apk)
    yield Law(0x6079, 0, f"{STANDARD}, mV", show=lambda behind: 1000.0 * behind.U_dc_v())
    # CiA 402-2: bits 7 and 6 of the polarity turn position and speed, not torque
    turned = -1.0 if objects.stored(0x607E) & 0x80 else 1.0
    back = -1.0 if objects.stored(0x607E) & 0x40 else 1.0
    yield Law(0x6064, 0, STANDARD, show=lambda behind: behind.position(turned * per_turn))
    yield Law(0x606C, 0, speed, show=lambda behind: back * per_rps * behind.turns_per_s())
    yield Law(0x60FF, 0, speed, act=lambda behind, n: behind.command_speed(back * n / per_rps))
    for index, turns in (
        (0x6081, PROFILE_SHARE * set_up.n_max_rpm / 60.0), (0x6083, PROFILE_RPS2), (0x6084, PROFILE_RPS2),
    ):  # fmt: skip
        if objects.stored(index) == 0:
            yield Law(index, 0, f"{speed}; of a move {ASSUMED}", set_up=per_rps * turns)
    yield Law(0x608F, 1, STANDARD, set_up=wanted_resolution(objects, set_up.counts))


PEAK_ASSUMED = f"mA; peak {ASSUMED}"
RMS = math.sqrt(0.5)
Laws = Callable[[MakersObjects, SetUp], Iterator[Law]]


@dataclass(frozen=True, slots=True)
class Family:
    """One maker's way to keep a motor."""

    name: str
    """For people."""
    marks: tuple[tuple[int, int], ...]
    """Objects by which it is recognised. Tuple of (index, sub)."""
    laws: Laws
    """Its own laws; they stand before the standard's."""
    identity: tuple[int, int] = (0, 0)
    """Vendor and product where the file leaves them blank (``assumed``)."""
    modes: int = 0
    """0x6502 where the file leaves it blank (``assumed``)."""
    own_modes: tuple[int, ...] = ()
    """Modes of the maker's own, which 0x6502 does not announce."""
    speed_per_rps: float | None = None
    """Units of 0x606C per turn per second where the maker fixes them."""
    speed_source: str = ""
    """Where that is stated."""
    per_turn: int = 0
    """Units of position per turn where the maker fixes them; 0: the encoder's counts."""
    loop_s: float = 1e-3
    """Period of its position loop (s; ``assumed`` where it is a millisecond)."""
    serial: tuple[int, ...] = ()
    """Where the maker keeps the serial number beside 0x1018:04; empty: nowhere else."""


def _current(index: int, sub: int, per_apk: float, source: str) -> Law:
    return Law(index, sub, source, show=lambda behind: per_apk * behind.i_q_a())


def _asked_current(index: int, per_apk: float, source: str) -> Law:
    return Law(index, 0, source, show=lambda behind: per_apk * behind.i_q_asked_a())


def _limit(index: int, sub: int, per_apk: float, apk: float, source: str) -> Law:
    def act(behind: Behind, counts: float) -> None:
        behind.limit_current(counts / per_apk)

    return Law(index, sub, source, set_up=per_apk * apk, act=act)


Counted = tuple[int, int, float]
"""Index and sub-index of a gain, and the amperes (peak) of one count."""


def _position_pid(P: Counted, integral: Counted, D: Counted, motor: SetUp) -> Iterator[Law]:
    """Gains of the position in amperes, as its maker's tool leaves them."""
    pid = stored_gains(motor.J_kgm2 + motor.J_load_kgm2).pid or [0.0, 0.0, 0.0]

    def taking(place: int, ampere: float) -> Callable[[Behind, float], None]:
        def act(behind: Behind, counts: float) -> None:
            if behind.position_gains.pid is not None:
                behind.position_gains.pid[place] = ampere * counts * motor.torque_constant

        return act

    for place, (index, sub, ampere) in enumerate((P, integral, D)):
        counts = pid[place] / (ampere * motor.torque_constant)
        yield Law(index, sub, "current per angle", set_up=counts, act=taking(place, ampere))


def _forward(friction: Counted, inertia: Counted, motor: SetUp) -> Iterator[Law]:
    """Feed-forward of speed and acceleration as currents."""

    def of_speed(behind: Behind, counts: float) -> None:
        behind.position_gains.friction_ff = friction[2] * counts * motor.torque_constant

    def of_acceleration(behind: Behind, counts: float) -> None:
        behind.position_gains.inertia_ff = inertia[2] * counts * motor.torque_constant

    yield Law(*friction[:2], "current per speed", set_up=0.0, act=of_speed)
    yield Law(*inertia[:2], "current per acceleration", set_up=0.0, act=of_acceleration)


def _epos4(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    """Nominal current x torque constant is the rated torque, in uN m (a published DCF holds exactly that)."""
    rated_ma, constant = round(1000.0 * motor.i_nom_apk), round(1e6 * motor.torque_constant)
    yield Law(0x3001, 1, PEAK_ASSUMED, set_up=rated_ma)
    yield _limit(0x3001, 2, 1000.0, motor.i_max_apk, PEAK_ASSUMED)
    yield Law(0x3001, 3, "pole pairs", set_up=motor.pole_pairs, commutates=True)
    yield Law(0x3001, 5, "uN m/A", set_up=constant)
    yield Law(0x3010, 1, "pulses, four counts each", set_up=motor.counts / 4.0)
    yield Law(0x6076, 0, "uN m", set_up=rated_ma * constant / 1000.0)
    yield from _position_pid((0x30A1, 1, 1e-6), (0x30A1, 2, 1e-6), (0x30A1, 3, 1e-6), motor)
    yield from _forward((0x30A1, 4, 1e-6), (0x30A1, 5, 1e-6), motor)
    for sub in (1, 2):
        yield _current(0x30D1, sub, 1000.0, PEAK_ASSUMED)
    yield _asked_current(0x30D0, 1000.0, PEAK_ASSUMED)
    yield Law(0x2200, 1, "0.1 V: giafranchini/eposx_hardware", show=lambda behind: 10.0 * behind.U_dc_v())
    yield Law(
        0x30A0, 1, "uV/A", set_up=1e6 * motor.K_p_v_per_a,
        act=lambda behind, n: behind.set_gains(K_p_v_per_a=1e-6 * n),
    )  # fmt: skip
    yield Law(
        0x30A0, 2, "uV/(A ms)", set_up=1e3 * motor.K_i_v_per_as,
        act=lambda behind, n: behind.set_gains(K_i_v_per_as=1e-3 * n),
    )  # fmt: skip


def _epos2(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    """Current mode -3 takes 0x2030; currents are mA, not shares of a rated one."""
    yield Law(0x6410, 1, PEAK_ASSUMED, set_up=1000.0 * motor.i_nom_apk)
    yield _limit(0x6410, 2, 1000.0, motor.i_max_apk, PEAK_ASSUMED)
    yield Law(0x6410, 3, "pole pairs", set_up=motor.pole_pairs, commutates=True)
    yield Law(0x6410, 4, "rpm", set_up=motor.n_max_rpm, act=lambda behind, n: behind.limit_speed(n))
    yield Law(0x2210, 1, "pulses, four counts each", set_up=motor.counts / 4.0)
    yield _current(0x6078, 0, 1000.0, PEAK_ASSUMED)
    yield _current(0x2027, 0, 1000.0, PEAK_ASSUMED)
    yield _asked_current(0x2031, 1000.0, PEAK_ASSUMED)
    yield from _position_pid((0x60FB, 1, 1e-2), (0x60FB, 2, 78e-3), (0x60FB, 3, 80e-6), motor)
    yield from _forward((0x60FB, 4, 1e-6), (0x60FB, 5, 1e-6), motor)

    def push(behind: Behind, counts: float) -> None:
        behind.command_torque(1e-3 * counts * motor.torque_constant)

    yield Law(0x2030, 0, PEAK_ASSUMED, act=push)


def _copley(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    """Counts of 0.01 A peak; winding data between two lines (CME 2 user guide)."""
    source = "Copley Motion Libraries; CME 2 user guide"
    yield _limit(0x2110, 0, 100.0, motor.i_max_apk, source)
    yield Law(0x2111, 0, source, set_up=100.0 * motor.i_nom_apk)
    yield Law(0x2112, 0, source, set_up=1000.0)
    yield Law(0x6410, 2, source, set_up=motor.pole_pairs, commutates=True)
    yield Law(0x6410, 7, source, set_up=2.0 * motor.R_s_ohm / 0.01)
    yield Law(0x6410, 8, source, set_up=2.0 * motor.L_q_h / 1e-5)
    yield Law(0x6410, 12, source, set_up=motor.torque_constant / 1e-5)
    yield Law(0x6410, 23, source, set_up=motor.counts)
    for index in (0x221C, 0x2215):
        yield _current(index, 0, 100.0, source)
    yield _asked_current(0x221D, 100.0, source)
    yield Law(0x2214, 0, source, show=lambda behind: 100.0 * behind.i_d_a())
    yield Law(0x2201, 0, source, show=lambda behind: 10.0 * behind.U_dc_v())


def _nanotec(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    source = f"mA; rms {ASSUMED}"
    yield Law(0x2030, 0, "pole pairs", set_up=motor.pole_pairs, commutates=True)
    yield _limit(0x2031, 0, 1000.0 * RMS, motor.i_max_apk, source)
    yield Law(0x203B, 1, source, set_up=1000.0 * RMS * motor.i_nom_apk)
    yield Law(0x2039, 1, source, show=lambda behind: 1000.0 * RMS * behind.i_d_a())
    yield _current(0x2039, 2, 1000.0 * RMS, source)
    yield Law(0x4014, 1, "mV: the file's own name of it", show=lambda behind: 1000.0 * behind.U_dc_v())


def _faulhaber(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    yield Law(0x2333, 1, PEAK_ASSUMED, set_up=1000.0 * motor.i_nom_apk)
    yield _limit(0x2333, 2, 1000.0, motor.i_max_apk, PEAK_ASSUMED)
    yield _current(0x6078, 0, 1000.0, PEAK_ASSUMED)
    yield Law(0x2350, 3, "poles", set_up=2.0 * motor.pole_pairs, commutates=True)


def _none(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    return iter(())


FAMILIES: Sequence[Family] = (
    Family(
        "EPOS4", ((0x3001, 5), (0x30A0, 1)), _epos4, (0xFB, 0x61500000), 0x0000_0225, loop_s=4e-4, serial=(0x2100, 1)
    ),
    Family(
        "EPOS2", ((0x2030, 0), (0x6410, 5), (0x60F6, 1)), _epos2, (0xFB, 0x63220000), 0x0000_0065, (-3, -2, -1),
        60.0, "rpm: its largest profile velocity is 25000",
    ),
    Family("Copley", ((0x2110, 0), (0x2111, 0), (0x6410, 34)), _copley, (0xAB, 0x20B), serial=(0x6510, 1)),
    Family("Nanotec", ((0x2030, 0), (0x2031, 0), (0x203B, 1)), _nanotec),
    Family(
        "Faulhaber", ((0x2333, 1), (0x2333, 2)), _faulhaber, speed_per_rps=60.0,
        speed_source="rpm: its largest profile velocity is 30000",
    ),
    Family("ZeroErr", ((0x2240, 0), (0x2241, 0), (0x3B69, 0)), _none, per_turn=524_288),
    Family("Elmo Gold", ((0x2F45, 1), (0x60E0, 0)), _none, (0x9A, 0x30923), 0x0000_03ED),
)  # fmt: skip
OTHER = Family("CiA 402", (), _none)


def family_of(objects: MakersObjects) -> Family:
    """Return the family whose objects the file has, else one that keeps to CiA 402."""
    return next((family for family in FAMILIES if objects.has(*family.marks)), OTHER)


def units_of(objects: MakersObjects, motor: SetUp) -> tuple[float, float, str]:
    """Return units of position per turn, of speed per turn per second, and where the latter is stated."""
    family = family_of(objects)
    per_turn = family.per_turn or position_units(objects, motor.counts)
    per_rps, speed = speed_units(objects, per_turn)
    if family.name == "Copley":
        per_rps, speed = 10.0 * per_turn, "0.1 counts per second (CML)"
    if family.speed_per_rps is not None:
        per_rps, speed = family.speed_per_rps, family.speed_source
    return per_turn, per_rps, speed


def laws_of(objects: MakersObjects, motor: SetUp) -> dict[tuple[int, int], Law]:
    """Return the law of every object that has one and that the file has; the maker's before the standard's."""
    family = family_of(objects)
    per_turn, per_rps, speed = units_of(objects, motor)
    laws = {(law.index, law.sub): law for law in standard_laws(objects, motor, per_turn, per_rps, speed)}
    laws |= {(law.index, law.sub): law for law in family.laws(objects, motor)}
    return {at: law for at, law in laws.items() if at in objects.rows and objects.rows[at].data_type.letter}


BY_OBJECTS = {1: (0x607A, 0x6081), 3: (0x606C, 0x60FF), 4: (0x6071,), 8: (0x607A, 0x60B0), 9: (0x60B1,), 10: (0x60B2,)}
"""Modes of operation that a file does not announce, and the objects of each by which it is assumed all the same."""


def assumed_modes(objects: MakersObjects) -> int:
    """Return 0x6502 as the objects suggest, where the file leaves it blank; 0 where file or family state it."""
    if objects.stored(0x6502) or family_of(objects).modes:
        return 0
    has = {mode: objects.has(*((index, 0) for index in needed)) for mode, needed in BY_OBJECTS.items()}
    return sum(1 << mode - 1 for mode, there in has.items() if there)


def modes_of(objects: MakersObjects) -> tuple[int, ...]:
    """Return the modes of operation the drive takes: what 0x6502 announces, and the maker's own."""
    family = family_of(objects)
    announced = objects.stored(0x6502) or family.modes or assumed_modes(objects)
    return (*(bit + 1 for bit in range(16) if announced >> bit & 1), *family.own_modes)
