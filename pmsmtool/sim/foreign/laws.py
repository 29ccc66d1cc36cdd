# SPDX-License-Identifier: MIT
"""What the objects of a maker's drive mean to the machine behind them: unit, set-up value, what is shown, what acts.

This is the simulated drive's own decoding. It shares nothing with the drive maps of the tool, so that a map with a
wrong unit meets a drive that takes its bytes for something else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from pmsmtool.sim.foreign.behind import Behind, SetUp
from pmsmtool.sim.foreign.file_rows import MakersObjects

ASSUMED = "assumed"
STANDARD = "CiA 402-2"
PROFILE_SHARE, PROFILE_RPS2 = 0.2, 40.0
"""Speed of a move over the largest one, and its acceleration (turns/s2), where the file leaves them blank."""


@dataclass(frozen=True, slots=True)
class Law:
    """What one object means.

    Attributes
    ----------
    index, sub : int
        The object.
    source : str
        Where it is stated, or ``assumed``.
    set_up : float or None
        What the maker's set-up tool leaves in it, in counts; None: what the file says stays.
    show : callable or None
        Returns the counts it shows.
    act : callable or None
        Takes the counts that are written.
    """

    index: int
    sub: int
    source: str
    set_up: float | None = None
    show: Callable[[Behind], float] | None = None
    act: Callable[[Behind, float], None] | None = None


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
