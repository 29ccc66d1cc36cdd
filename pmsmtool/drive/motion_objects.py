# SPDX-License-Identifier: MIT
"""How a drive of another maker is commanded, limited and watched: CiA 402's objects where they are, else the maker's.

Every question is put to the live drive; the maker's own objects are those of a map that names its identity. Where no
source says whether a current is peak or rms, it is taken as rms: the smaller physical current for limits and commands,
the larger one for what is watched.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

from pmsmtool.cia402 import Mode
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive_maps.drive_map import LETTERS
from pmsmtool.drive_maps.motion_objects import MotionObject
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.errors import NotAvailable, SdoAbort
from pmsmtool.units import RPM_PER_RAD_S, format_current

ENCODER_COUNTS = DriveObject(0x608F, 1, "I")
MOTOR_TURNS = DriveObject(0x608F, 2, "I")
POSITION = DriveObject(0x6064, 0, "i")
MAX_TORQUE_PERMILLE = DriveObject(0x6072, 0, "H")
TORQUE_PERMILLE = DriveObject(0x6077, 0, "h")
ASKED_PERMILLE = DriveObject(0x6074, 0, "h")
"""Torque demand: what the current loop is asked for, in the unit of 0x6077 (CiA 402-2)."""
POLARITY = DriveObject(0x607E, 0, "B")
GEAR_MOTOR, GEAR_SHAFT = DriveObject(0x6091, 1, "I"), DriveObject(0x6091, 2, "I")
FEED, FEED_TURNS = DriveObject(0x6092, 1, "I"), DriveObject(0x6092, 2, "I")
FACTOR, FACTOR_DIVISOR = DriveObject(0x6093, 1, "I"), DriveObject(0x6093, 2, "I")
"""Increments of the encoder per unit of position (CiA 402 of 2002; its later editions leave it out)."""
STATE_UNITS = "or state the units of a turn in a map (`counts_per_turn`)"
POSITION_UNIT, SPEED_UNIT = DriveObject(0x60A8, 0, "I"), DriveObject(0x60A9, 0, "I")
SPEED_SHOWN = DriveObject(0x606C, 0, "i")
PER_S = {0x03: 1.0, 0x47: 1.0 / 60.0}
"""One over a second, and over a minute, by the denominator of a unit of speed (CiA 303-2)."""
PERIOD_VALUE, PERIOD_EXPONENT = DriveObject(0x60C2, 1, "B"), DriveObject(0x60C2, 2, "b")
"""Time between two targets of a cyclic mode, value times 10^exponent s (CiA 402-2, interpolation time period)."""
POSITION_TURNED = 0x80
"""Bit of the polarity that turns position against torque (CiA 402-2, 0x607E)."""
FEW_COUNTS = 64.0
"""Counts per electrical turn below which the steps of the angle disturb the current: runs at rated speed ended at the
current limit with 23 and 43, and none with 85."""
TURN_IN = {0x10: 2.0 * math.pi, 0x41: 360.0, 0x42: 21_600.0, 0x43: 1_296_000.0, 0xB4: 1.0}
"""A turn in radians, degrees, minutes and seconds of arc, and revolutions, by the unit's numerator (CiA 303-2)."""
INCREMENTS = (0x00, 0xB5)
"""Numerators of units of the encoder; others, as metres, say nothing of a turn without the feed (0x6092)."""
RATED_RMS = 1e-3 * math.sqrt(2.0)
"""A peak per count of 0x6075, taken as mA rms: the larger of the two readings."""
SAME_RATED = 0.01
"""Two statements of one rated current differ by less: the step of a maker's own is 10 mA; peak and rms are 1.41."""
MOST_RATED_MA = 1e7
"""Largest rated current of a motor (mA). 0 and 0xFFFFFFFF are drives without a motor's data; a REAL32 reads as 1e9."""
SAME_UNITS = 1e-6
"""Two statements of the units of a turn, whole numbers and ratios of them, that differ by less are one."""
RANGE_LIMIT = DriveObject(0x607B, 1, "i"), DriveObject(0x607B, 2, "i")
"""Ends of the position, behind which it begins again; both 0: those of its type (CiA 402-2)."""
LEAST_TURNS = 16
"""Fewest turns between these ends: half of them within the 50 ms between two looks at the speed is 1000 rad/s."""
LEAST_UNITS = 24
"""Fewest units of position per turn: one within the 50 ms between two looks at the speed is 5 rad/s then. Files of
makers say 1 where nothing was set up."""
NO_RATED = (
    "its rated current (0x6075, or in a map that names this drive: the maker's object, or the name plate's number)"
)
NO_COUNTS = "how many increments its encoder has per turn (0x608F, or in a map: the maker's object, or a number)"
OVER_SPEED_TRIP, TRIP_RATIO = "protection.n_trip_rpm", 1.5
"""Speed at which a drive that has such a trip removes the voltage by itself, whatever commands it, over the envelope's:
above what the tool's own look sees first, so that the limit is named."""
TRIP_LEAST = 0.25
"""Smallest speed for it, of the trip that the drive holds: a rotor that aligns with a vector is fast for a moment."""
TORQUE_SLOPE = DriveObject(0x6087, 0, "I")
LENT_SLOPE = 100_000
"""Permille per second that a drive is lent where its own slope is slow: a tenth of the rated torque per ms, as this
program ramps what has no slope (bench safety: no command rises faster)."""
LOW_LIMIT = 0.9
"""Own current limit, of the drive's rated current, below which it is named: it decides what is identified."""
SLOW_SLOPE_S = 0.5
"""Time to the rated torque from which a slope of the drive's own leaves nothing of a push: the shortest lasts 40 ms. As
stored, one maker's drive takes 10 s; others take no time (0), or 0.1 ms."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity in an object of the live drive."""

    item: DriveObject
    """Where."""
    per_count: float
    """A peak, rpm or rad/s, per count."""
    undecided: bool = False
    """Whether no source says if a current is peak or rms."""

    def __str__(self) -> str:
        return f"0x{self.item.index:04X}" + (f":{self.item.sub:02X}" if self.item.sub else "")


@dataclass(frozen=True, slots=True)
class TorqueTarget:
    """The object that takes a torque current, and the mode of operation in which it acts."""

    quantity: Quantity
    mode: int

    @property
    def cyclic(self) -> bool:
        """Whether the drive takes every value at once: it has no slope of its own (0x6087) in this mode."""
        return self.mode == Mode.CYCLIC_TORQUE


@dataclass(frozen=True, slots=True)
class LimitedSpeed:
    """The object that takes a speed (rad/s per count), the current limit (A peak per count), and the mode."""

    speed: Quantity
    limit: Quantity
    mode: int


def _own(node: DriveNode, name: str) -> Quantity | None:
    """Return the maker's own object of the map; a fixed number is none."""
    row: MotionObject | None = node.map.motion.get(name)
    if row is None or not row.index:
        return None
    return Quantity(DriveObject(row.index, row.sub, LETTERS[row.wire]), row.per_count, row.undecided)


def rated_ma(node: DriveNode) -> float | None:
    """Return what 0x6075 holds; None where the drive has none, or a number that no motor has: it was never set."""
    held = node.held(objects.RATED_CURRENT_MA)
    return held if held is not None and 0.0 < held <= MOST_RATED_MA else None


def rated_current(node: DriveNode) -> Quantity | None:
    """Return where the rated current stands; None where nobody knows.

    A maker's own object of the same current, whose kind of ampere is known, tells that of 0x6075.
    """
    own, stated = _own(node, "rated_current"), rated_ma(node)
    if own is None or stated is None:
        return own if stated is None else _stated_rated(node)
    apk = 0.0 if own.undecided else own.per_count * (node.held(own.item) or 0.0)
    same = any(math.isclose(apk, per_count * stated, rel_tol=SAME_RATED) for per_count in (1e-3, RATED_RMS))
    return own if same else _stated_rated(node)


def _stated_rated(node: DriveNode) -> Quantity:
    """Return 0x6075 as a map states it; without such a row nobody says whether it is peak or rms."""
    own = _own(node, "rated_current")
    standard = objects.RATED_CURRENT_MA
    if own is not None and (own.item.index, own.item.sub) == (standard.index, standard.sub):
        return own
    return Quantity(standard, RATED_RMS, undecided=True)


def rated_apk(node: DriveNode) -> float:
    """Return the rated current (A peak; the larger reading where it is not known to be peak or rms).

    Raises NotAvailable: the drive does not say.
    """
    stands = rated_current(node)
    row = node.map.motion.get("rated_current")
    if stands is None and row is not None and row.number:  # no object holds it: its owner wrote it into the map
        return row.per_count * row.number
    found = None if stands is None else node.held(stands.item)
    if stands is None or found is None:
        raise NotAvailable(
            f"the drive does not report {NO_RATED}", where=f"node {node.node}",
            hint="`pmsmtool caps` lists what this drive can measure",
        )  # fmt: skip
    if stands.per_count * found > RATED_RMS * MOST_RATED_MA:
        raise NotAvailable(
            f"no motor has the rated current that the drive reports: {format_current(stands.per_count * found)}",
            where=f"node {node.node}, {stands}", likely="the object is a REAL32, or was never set",
            hint="compare its type with the drive's manual, and state it in a map (`rated_current`)",
        )  # fmt: skip
    return stands.per_count * found


def shown_current(node: DriveNode, rated: float) -> Quantity:
    """Return where the torque current is shown, in A peak per count; torque counts as current where nothing else does.

    Raises NotAvailable: the drive shows neither.
    """
    own = _own(node, "current")
    if own is not None and node.held(own.item) is not None:
        return own
    if _permille(node, objects.CURRENT_PERMILLE):
        return Quantity(objects.CURRENT_PERMILLE, 1e-3 * rated)
    signal = node.map.signals.get("i_q_a")
    if signal is not None and not wire_unit(signal.unit).relative_to:
        return Quantity(DriveObject(signal.index, signal.sub, LETTERS[signal.wire]), wire_unit(signal.unit).scale)
    if _permille(node, TORQUE_PERMILLE):
        return Quantity(TORQUE_PERMILLE, 1e-3 * rated)
    raise NotAvailable(
        "the drive shows neither current (0x6078) nor torque (0x6077) in a unit that is known",
        where=f"node {node.node}",
    )


def asked_current(node: DriveNode, shown: Quantity) -> tuple[DriveObject, ...]:
    """Return where the drive shows the current that its current loop is asked for, and what that gives, in one unit.

    Empty where it does not: of the map's own objects both are needed, else those of CiA 402.
    """
    own = _own(node, "asked_current")
    if own is not None and own.per_count == shown.per_count and node.held(own.item) is not None:
        return own.item, shown.item
    if node.held(ASKED_PERMILLE) is not None and node.held(TORQUE_PERMILLE) is not None:
        return ASKED_PERMILLE, TORQUE_PERMILLE
    return ()


def undecided(node: DriveNode, rated: float) -> bool:
    """Return whether no source says if the current that is shown is peak or rms; it is read as rms."""
    shown = shown_current(node, rated)
    if shown.item in (objects.CURRENT_PERMILLE, TORQUE_PERMILLE) and not shown.undecided:
        base = rated_current(node)
        return base is not None and base.undecided
    return shown.undecided


def _permille(node: DriveNode, item: DriveObject) -> bool:
    """Whether a torque or current is there and counts permille of the rated one, as CiA 402 has it.

    In 32 bits, of a drive without a rated current (0x6075) to be a share of, nothing states its unit.
    """
    held = node.held(item) is not None
    return held and (node.typed(item).size <= item.size or node.held(objects.RATED_CURRENT_MA) is not None)


def torque_target(node: DriveNode, rated: float) -> TorqueTarget:
    """Return what takes a torque current: mode 4, else 10, as 0x6502 announces, else the maker's own.

    A drive whose own slope (0x6087) is too slow for a push takes it in mode 10, if it has that: this program ramps it.

    Raises NotAvailable: the drive has no such mode, or no target in it.
    """
    modes = int(node.held(objects.SUPPORTED_MODES) or 0)
    if node.map.capabilities.torque_mode is not False and _permille(node, objects.TARGET_TORQUE_PERMILLE):
        order = (Mode.PROFILE_TORQUE, Mode.CYCLIC_TORQUE)
        for mode in reversed(order) if slow_slope_s(node) else order:
            if modes >> mode - 1 & 1:
                return TorqueTarget(Quantity(objects.TARGET_TORQUE_PERMILLE, 1e-3 * rated), mode)
    own = _own(node, "target_current")
    if own is not None and node.held(own.item) is not None:
        return TorqueTarget(own, node.map.motion["target_current"].mode)
    wide = node.held(objects.TARGET_TORQUE_PERMILLE) is not None and not _permille(node, objects.TARGET_TORQUE_PERMILLE)
    raise NotAvailable(
        f"the drive has no torque mode that pmsmtool supports (0x6502 = {modes:#x})", where=f"node {node.node}",
        likely="0x6071 has 32 bits and there is no 0x6075: its unit is the maker's, not permille" if wide else "",
        hint="state it in a map (`target_current`)" if wide else "`pmsmtool caps` lists what this drive can measure",
    )  # fmt: skip


def cyclic_period_s(node: DriveNode, wanted_s: float) -> float:
    """Ask for a time between two targets of a cyclic mode (s, whole milliseconds); return what the drive holds.

    A drive fills a longer time than the targets really take by going from one to the next: it would follow late.
    """
    if node.held(PERIOD_VALUE) is None:
        return wanted_s
    for item, number in ((PERIOD_EXPONENT, -3), (PERIOD_VALUE, round(1e3 * wanted_s))):
        with contextlib.suppress(SdoAbort):
            if node.get(item) != number:
                node.put(item, number)
    exponent = node.held(PERIOD_EXPONENT)
    return node.get(PERIOD_VALUE) * 10.0 ** (-3 if exponent is None else exponent)


def quicken_slope(node: DriveNode) -> None:
    """Lend the drive a slope for its torque that leaves something of a push, where its own does not.

    Raises NotAvailable: the drive keeps its slow one: a push would take seconds, and turn the shaft on and on.
    """
    if not slow_slope_s(node):
        return
    with contextlib.suppress(SdoAbort):
        node.put(TORQUE_SLOPE, LENT_SLOPE)
    slow_s = slow_slope_s(node)
    if slow_s:
        raise NotAvailable(
            f"the drive takes {slow_s:.3g} s to its rated torque, and refuses a faster slope",
            where=f"node {node.node}, 0x6087", hint="raise 0x6087 with the maker's software",
        )  # fmt: skip


def slow_slope_s(node: DriveNode) -> float:
    """Return the time (s) that the drive's slope takes to its rated torque where it is too long for a push, else 0."""
    slope = node.held(TORQUE_SLOPE) or math.inf  # permille per second; 0 is none
    return 1000.0 / slope if 1000.0 / slope > SLOW_SLOPE_S else 0.0


def shown_speed(node: DriveNode) -> Quantity | None:
    """Return where the speed of the motor is shown in a unit that is stated (rad/s per count): by a map, or 0x60A9."""
    signal = node.map.signals.get("omega_M_rad_s")
    if signal is not None:
        return Quantity(DriveObject(signal.index, signal.sub, LETTERS[signal.wire]), wire_unit(signal.unit).scale)
    unit = int(node.held(SPEED_UNIT) or 0)
    turn, per_s = TURN_IN.get(unit >> 16 & 0xFF), PER_S.get(unit >> 8 & 0xFF)
    if turn is None or per_s is None or node.held(SPEED_SHOWN) is None:
        return None
    return Quantity(SPEED_SHOWN, 2.0 * math.pi / turn * per_s * _decimal(unit))


def _decimal(unit: int) -> float:
    """Return the prefix of a unit (CiA 303-2): a power of ten."""
    exponent = unit >> 24
    return 10.0 ** (exponent - 256 if exponent > 127 else exponent)


def limited_speed(node: DriveNode) -> LimitedSpeed:
    """Return a velocity mode of known unit whose current limit this program may set.

    Raises NotAvailable: the drive has no such mode, its map does not state its unit of speed, or it has no current
    limit.
    """
    own, row = _own(node, "target_speed"), node.map.motion.get("target_speed")
    limit = _own(node, "current_limit")  # the one that its map names: what it does in this mode is the maker's matter
    modes = int(node.held(objects.SUPPORTED_MODES) or 0)
    there = own is not None and limit is not None and None not in (node.held(own.item), node.held(limit.item))
    if own is None or row is None or limit is None or not there or not modes >> row.mode - 1 & 1:
        raise NotAvailable(
            f"the drive has neither a torque mode nor a velocity mode whose unit its map states (0x6502 = {modes:#x})",
            where=f"node {node.node}",
        )
    return LimitedSpeed(own, limit, row.mode)


def position_units(node: DriveNode) -> float:
    """Return the units of 0x6064 per turn of the motor, negative where its polarity (0x607E) turns it.

    Where the drive's objects do not tell, the number that its owner states in a map does.

    Raises NotAvailable: nothing tells, a gear (0x6091) or a factor (0x6093) stands between and nothing says in which
    units, or a turn has too few of them.
    """
    if node.held(POSITION) is None:
        raise NotAvailable("the drive shows no position", where=f"node {node.node}, 0x6064")
    sign = -1.0 if int(node.held(POLARITY) or 0) & POSITION_TURNED else 1.0
    row = node.map.motion.get("counts_per_turn")
    try:
        return sign * _position_units(node)
    except NotAvailable:
        if row is None or not row.number:
            raise
    return sign * _fine_enough(node, row.number)


def position_turns(node: DriveNode, units: float) -> float:
    """Return after how many turns of so many units the position begins again.

    Raises NotAvailable: after so few that the speed seen between two looks could be a wrong one.
    """
    size = 8 * node.typed(POSITION).size
    least, most = (node.held(item) or 0.0 for item in RANGE_LIMIT)
    limited = most > least
    turns = (most - least + 1.0 if limited else 2.0**size) / abs(units) if units else math.inf
    if turns < LEAST_TURNS:
        raise NotAvailable(
            f"the position begins again after {turns:.3g} turns, {LEAST_TURNS} are needed to see a speed",
            where=f"node {node.node}, {'0x607B' if limited else '0x6064'}",
            likely="a rotary axis whose position is kept within a turn" if limited else f"a position of {size} bits",
            hint="set both ends of 0x607B to 0, or to all of its type, with the maker's software",
        )
    return turns


def unlike_stated(node: DriveNode) -> list[str]:
    """Say where the position units of a turn that a map states are not the drive's own; one line, or none."""
    row = node.map.motion.get("counts_per_turn")
    try:
        own = _position_units(node) if row is not None and row.number else 0.0
    except NotAvailable:
        return []
    if row is None or not own or math.isclose(row.number, own, rel_tol=SAME_UNITS):
        return []
    return [
        f"position  {own:.9g} units per turn by the drive's objects (0x608F, 0x6092), which count; {row.number:.9g} by "
        "the map (counts_per_turn): remove that row, or set the drive with its maker's software"
    ]


def _fine_enough(node: DriveNode, units: float) -> float:
    if not units >= LEAST_UNITS:
        raise NotAvailable(
            f"a turn of the motor has {units:.4g} units of position, {LEAST_UNITS} are needed to see its speed",
            where=f"node {node.node}, 0x608F or 0x6092",
            likely="the encoder's resolution or the feed was never set",
            hint=f"set it with the maker's software, {STATE_UNITS}",
        )
    return units


def _position_units(node: DriveNode) -> float:
    units = _fine_enough(node, _shown_units(node))
    factor = max(1.0, node.held(FACTOR) or 1.0) / max(1.0, node.held(FACTOR_DIVISOR) or 1.0)
    counts = (node.held(ENCODER_COUNTS) or 0.0) / max(1.0, node.held(MOTOR_TURNS) or 1.0)
    if factor != 1.0 and not math.isclose(units * factor, counts, rel_tol=SAME_UNITS):
        raise NotAvailable(
            f"a position factor of {factor:.4g} is set (0x6093), and nothing says what the position counts",
            where=f"node {node.node}, 0x6093", hint=f"set it to 1:1 with the maker's software, {STATE_UNITS}",
        )  # fmt: skip
    return units


def _shown_units(node: DriveNode) -> float:
    gear = max(1.0, node.held(GEAR_MOTOR) or 1.0) / max(1.0, node.held(GEAR_SHAFT) or 1.0)
    unit = int(node.held(POSITION_UNIT) or 0)
    numerator = unit >> 16 & 0xFF
    if numerator in TURN_IN:
        return TURN_IN[numerator] / _decimal(unit) / gear
    feed = node.held(FEED) or 1.0
    if feed > 1.0:
        return feed / max(1.0, node.held(FEED_TURNS) or 1.0) / gear
    if numerator not in INCREMENTS:
        raise NotAvailable(
            f"the position is in a unit that says nothing of a turn (0x60A8 = {unit:#010x}), and no feed is set",
            where=f"node {node.node}, 0x60A8",
            hint=f"set the feed (0x6092), or the unit, with the maker's software, {STATE_UNITS}",
        )  # fmt: skip
    if gear != 1.0:
        raise NotAvailable(
            f"a gear of {gear:.4g} is set (0x6091), and the position may be of the motor or behind it",
            where=f"node {node.node}, 0x6091",
            hint=f"set it to 1:1, or the feed (0x6092), with the maker's software, {STATE_UNITS}",
        )  # fmt: skip
    counts = encoder_counts(node)
    if counts is None:
        raise NotAvailable(f"the drive does not report {NO_COUNTS}", where=f"node {node.node}")
    return counts


def few_counts(counts: float | None, pole_pairs: float) -> str:
    """Return what an encoder of few counts per electrical turn does to the current; empty where it has enough."""
    if counts is None or not counts < FEW_COUNTS * pole_pairs:
        return ""
    each = counts / pole_pairs
    return f"the encoder has {each:.3g} counts per electrical turn: each turns the voltage by {360.0 / each:.2g} deg"


def encoder_counts(node: DriveNode) -> float | None:
    """Return the increments of a turn: 0x608F, else the maker's own object; None where the drive has neither."""
    counts = node.held(ENCODER_COUNTS)
    if counts is not None:
        return counts / max(1.0, node.held(MOTOR_TURNS) or 1.0)
    own = _own(node, "counts_per_turn")
    held = None if own is None else node.held(own.item)
    return None if own is None or held is None else own.per_count * held


def current_limits(node: DriveNode, rated: float) -> Iterator[Quantity]:
    """Yield the objects that may limit the current, best first; the drive may lack them.

    0x6072 limits torque, which counts as current: both are shares of the rated one.
    """
    yield Quantity(objects.MAX_CURRENT_PERMILLE, 1e-3 * rated)
    own = _own(node, "current_limit")
    if own is not None:
        yield own
    yield Quantity(MAX_TORQUE_PERMILLE, 1e-3 * rated)


def speed_limits(node: DriveNode) -> Iterator[Quantity]:
    """Yield the objects that may limit the speed, in rpm per count; the drive may lack them."""
    yield Quantity(objects.MAX_SPEED_RPM, 1.0)
    own = _own(node, "speed_limit")
    if own is not None:
        yield Quantity(own.item, own.per_count * RPM_PER_RAD_S)


def trips_itself(node: DriveNode) -> bool:
    """Return whether the drive removes the voltage by itself at a speed that is set, in every mode."""
    return OVER_SPEED_TRIP in node.map.cells


def lowered_trip(held_rpm: float, speed_max_rpm: float) -> float:
    """Return that speed (rpm) for a drive that is lent: never above what it holds."""
    return min(held_rpm, TRIP_RATIO * max(speed_max_rpm, TRIP_LEAST * held_rpm))


def allowed(node: DriveNode, limits: Iterator[Quantity]) -> tuple[Quantity, float] | None:
    """Return the first limit that the drive has, and what it now allows (A peak or rpm)."""
    for limit in limits:
        found = node.held(limit.item)
        if found is not None:
            return limit, limit.per_count * found
    return None


def limits_current(node: DriveNode, rated: float) -> bool:
    """Whether the drive has a limit of the current of its own."""
    return allowed(node, current_limits(node, rated)) is not None


def limits_speed(node: DriveNode) -> bool:
    """Whether the drive has a limit of the speed of its own."""
    return allowed(node, speed_limits(node)) is not None


def held_current_limits(node: DriveNode, rated: float) -> list[tuple[Quantity, float]]:
    """Return the limits of the current that the drive has, with what they now allow (A peak)."""
    found = (allowed(node, iter((limit,))) for limit in current_limits(node, rated))
    return [one for one in found if one is not None]


def low_limits(node: DriveNode, rated: float) -> list[str]:
    """Return the limits of the current that the drive holds far below its rated current, one line each."""
    return [
        f"current   the drive itself gives {format_current(apk)}, {100.0 * apk / rated:.3g} % of its rated current "
        f"({limit}): raise it with the maker's software where the motor may carry more"
        for limit, apk in held_current_limits(node, rated)
        if 0.0 < apk < LOW_LIMIT * rated
    ]


def first_of_axes(node: DriveNode) -> list[str]:
    """Say of a device with several axes which one is meant; one line, or none."""
    axes = 1 + len(node.other_axes())
    told = f"axis      the first of {axes} (0x6041, 0x6841): all is read, moved and written there; `stop` stops all"
    return [told] if axes > 1 else []


def watched_by_tool(node: DriveNode, rated: float) -> list[str]:
    """Return the limits that the drive lacks, or holds far below its rated current, one line each with what to do.

    Units of a turn that the map states otherwise than the drive's objects are told with them.
    """
    lines = [*unlike_stated(node), *low_limits(node, rated)]
    if not limits_current(node, rated):
        lines.append(
            "current   no limit in the drive (0x6073, 0x6072, or the maker's own): no command asks for more, and this"
            " program looks"
        )
    if not limits_speed(node):
        lines.append(
            "speed     no limit in the drive (0x6080): this program looks every 50 ms and removes the voltage at the "
            "limit itself"
        )
    slope_s = slow_slope_s(node)
    if slope_s:
        cyclic = bool(int(node.held(objects.SUPPORTED_MODES) or 0) >> Mode.CYCLIC_TORQUE - 1 & 1)
        told = "mode 10 ignores it, and this program ramps" if cyclic else "raised for the pulses, and restored"
        lines.append(f"slope     {slope_s:.3g} s to the rated torque in mode 4 (0x6087): {told}")
    return lines
