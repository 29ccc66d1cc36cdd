# SPDX-License-Identifier: MIT
"""The makers' own objects, family by family: recognised by what the file has, each law with its source or ``assumed``.

Where no public source says whether a current is peak or rms, one reading is taken and marked ``assumed``; the tool must
not know which.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from pmsmtool.sim.foreign.behind import Behind, SetUp, stored_gains
from pmsmtool.sim.foreign.file_rows import MakersObjects
from pmsmtool.sim.foreign.laws import ASSUMED, Law, position_units, speed_units, standard_laws

PEAK_ASSUMED = f"mA; peak {ASSUMED}"
RMS = math.sqrt(0.5)
Laws = Callable[[MakersObjects, SetUp], Iterator[Law]]


@dataclass(frozen=True, slots=True)
class Family:
    """One maker's way to keep a motor.

    Attributes
    ----------
    name : str
        For people.
    marks : tuple of (index, sub)
        Objects by which it is recognised.
    laws : callable
        Its own laws; they stand before the standard's.
    identity : tuple of int
        Vendor and product where the file leaves them blank (``assumed``).
    modes : int
        0x6502 where the file leaves it blank (``assumed``).
    own_modes : tuple of int
        Modes of the maker's own, which 0x6502 does not announce.
    speed_per_rps : float or None
        Units of 0x606C per turn per second where the maker fixes them.
    speed_source : str
        Where that is stated.
    per_turn : int
        Units of position per turn where the maker fixes them; 0: the encoder's counts.
    loop_s : float
        Period of its position loop (s; ``assumed`` where it is a millisecond).
    serial : tuple of int
        Where the maker keeps the serial number beside 0x1018:04; empty: nowhere else.
    """

    name: str
    marks: tuple[tuple[int, int], ...]
    laws: Laws
    identity: tuple[int, int] = (0, 0)
    modes: int = 0
    own_modes: tuple[int, ...] = ()
    speed_per_rps: float | None = None
    speed_source: str = ""
    per_turn: int = 0
    loop_s: float = 1e-3
    serial: tuple[int, ...] = ()


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
    yield Law(0x3001, 3, "pole pairs", set_up=motor.pole_pairs)
    yield Law(0x3001, 5, "uN m/A", set_up=constant)
    yield Law(0x3010, 1, "pulses, four counts each", set_up=motor.counts / 4.0)
    yield Law(0x6076, 0, "uN m", set_up=rated_ma * constant / 1000.0)
    yield from _position_pid((0x30A1, 1, 1e-6), (0x30A1, 2, 1e-6), (0x30A1, 3, 1e-6), motor)
    yield from _forward((0x30A1, 4, 1e-6), (0x30A1, 5, 1e-6), motor)
    for sub in (1, 2):
        yield _current(0x30D1, sub, 1000.0, PEAK_ASSUMED)
    yield _asked_current(0x30D0, 1000.0, PEAK_ASSUMED)
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
    yield Law(0x6410, 3, "pole pairs", set_up=motor.pole_pairs)
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
    yield Law(0x6410, 2, source, set_up=motor.pole_pairs)
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
    yield Law(0x2030, 0, "pole pairs", set_up=motor.pole_pairs)
    yield _limit(0x2031, 0, 1000.0 * RMS, motor.i_max_apk, source)
    yield Law(0x203B, 1, source, set_up=1000.0 * RMS * motor.i_nom_apk)
    yield Law(0x2039, 1, source, show=lambda behind: 1000.0 * RMS * behind.i_d_a())
    yield _current(0x2039, 2, 1000.0 * RMS, source)
    yield Law(0x4014, 1, "mV: the file's own name of it", show=lambda behind: 1000.0 * behind.U_dc_v())


def _faulhaber(objects: MakersObjects, motor: SetUp) -> Iterator[Law]:
    yield Law(0x2333, 1, PEAK_ASSUMED, set_up=1000.0 * motor.i_nom_apk)
    yield _limit(0x2333, 2, 1000.0, motor.i_max_apk, PEAK_ASSUMED)
    yield _current(0x6078, 0, 1000.0, PEAK_ASSUMED)
    yield Law(0x2350, 3, "poles", set_up=2.0 * motor.pole_pairs)


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
