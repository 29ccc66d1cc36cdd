# SPDX-License-Identifier: MIT
"""What a drive can give: quantity x method x expected interval x what is missing, decided from map and drive.

The map states what a family can do, the drive itself must confirm it: supported modes (0x6502) and objects that answer.
Expected intervals are those measured on simulated nodes of the level (:data:`WAYS`); where nothing was measured,
nothing is said.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TypeVar

from pmsmtool.cia402 import Mode
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.heartbeat import expects_pdos
from pmsmtool.drive.motion_objects import (
    LEAST_TURNS,
    NO_RATED,
    first_of_axes,
    limited_speed,
    limits_current,
    limits_speed,
    position_turns,
    position_units,
    rated_apk,
    shown_current,
    torque_target,
    undecided,
    watched_by_tool,
)
from pmsmtool.drive.objects import CONSUMER_HEARTBEAT, GUARD_TIME_MS, LIFE_TIME_FACTOR, SUPPORTED_MODES, DriveObject
from pmsmtool.drive.port import Identity
from pmsmtool.drive.recorder_drives import records_pushes
from pmsmtool.drive.recorders.choice import described
from pmsmtool.drive.set_point import FOLLOWING_ERROR, POSITION_DEMAND, TARGET_POSITION
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.motion_objects import blank_map
from pmsmtool.drive_maps.shipped_maps import GENERIC, UNKNOWN_VENDOR, family_of, load_family
from pmsmtool.drive_maps.vendor_tuning import OS_COMMAND, OS_COMMAND_MODE
from pmsmtool.errors import NotAvailable, SdoAbort
from pmsmtool.flash.map_gate import map_on
from pmsmtool.identification.request import Method
from pmsmtool.identification.value_verdict import NOT_TOLD
from pmsmtool.machine.parameters import HallCommutation
from pmsmtool.params.catalogue import BY_NAME
from pmsmtool.plain_text import by_reason

T = TypeVar("T")


class CapabilityLevel(StrEnum):
    """How much a drive gives, from most to least."""

    FULL = "full"
    INJECT = "inject"
    RECORDER = "recorder"
    STANDARD = "standard"
    VENDOR = "vendor"
    MANUAL = "manual"


FEATURES: Mapping[str, str] = {
    "heartbeat": "consumer heartbeat (0x1016)",
    "abort option": "abort connection option (0x6007)",
    "quick stop": "quick stop option (0x605A)",
    "limits": "its own current and speed limit (0x6073, 0x6075, 0x6080; or in a map: the maker's objects)",
    "supervision": "consumer heartbeat (0x1016), or node guarding (0x100C, 0x100D), or an expected PDO (0x1400:05)",
    "rated current": NO_RATED,
    "set-points": "current set-points for d and q",
    "excitation": "voltage or current injection",
    "averages": "averages inside the drive",
    "recorder": "a recorder of currents and voltages that this program reads",
    "torque mode": "torque mode (0x6502 bit 3 or 9; 0x6071, in permille to the rated current)",
    "push": "torque mode (0x6502 bit 3 or 9; 0x6071, in permille to the rated current), or a velocity mode whose unit "
    "a map states, with a current limit",
    "position": "position in units of a known number per turn (0x6064 with 0x608F, no gear or factor in 0x6091 and "
    "0x6093, or in a map: an object, or a number)",
    "range": f"a position of {LEAST_TURNS} turns or more before it begins again (32 bits in 0x6064, and 0x607B)",
    "encoder": "an encoder: between two edges of Hall sensors (hall.commutation) the angle is not measured",
    "frame": "a frame that turns with the rotor: not six steps (hall.commutation 3; 2 for this time)",
    "commutation angle": "mode 11 with commutation angle (0x6502 bit 10, 0x60EA)",
    **dict.fromkeys(
        ("vendor R", "vendor L", "vendor psi", "vendor poles"),
        "the maker's identification of it, with its result, in a map that names this drive",
    ),
    "line voltage": "the DC link (0x6079), or the machine's voltage in the drive map",
    "current": "its current (0x6078) or torque (0x6077) in a known unit",
    "bench supply": "a bench supply whose power a person reads (`pmsmtool identify R --supply`)",
}
"""What methods need, as a person reads it."""

_SAFE = ("heartbeat", "abort option", "quick stop", "limits")
"""What the reference drive must have for any motion."""
_INJECT = ("set-points", "excitation", "recorder")
_BOUNDED = ("supervision", "rated current")
"""What is safe where every command is a current that this program bounds: it replaces limits that the drive lacks."""
_ON_PLATE = {"rated current": "rated_current", "position": "counts_per_turn"}
"""What a number of a drive's name plate gives, and the row of a map that takes it."""
_TURNING = (*_INJECT, "frame")
_ANGLE = (*_TURNING, "encoder")
"""What every sample of the angle is needed for."""
_SEEN = ("position", "range")
"""What shows the speed."""
_STANDARD = (*_BOUNDED, *_SEEN, "commutation angle")
_RECORD = (*_BOUNDED, *_SEEN, "current", "torque mode", "recorder")
_PUSH = (*_BOUNDED, "push", *_SEEN, "current")
_MOVES = (*_BOUNDED, *_SEEN, "current", "profile position")
"""What a move by the drive's own position loop needs: its current is watched."""
_WATCHED = ("supervision", "abort option", "limits", *_SEEN, "current")
"""What the guard needs while the drive runs by itself: it bounds no current then, so the drive's own limits must."""


@dataclass(frozen=True, slots=True)
class Expected:
    """An interval measured on simulated drives."""

    name: str
    """Key of the estimate."""
    half_width: float
    unit: str
    """90 % of the drives had a total 95 % half width up to this (% of the value, or deg)."""
    drives: int
    """Accepted drives behind it."""
    program: str
    """Command that measured it."""
    given: str = ""
    """What must be given for it besides the drive; empty: nothing."""

    def __str__(self) -> str:
        with_what = f" with {self.given}" if self.given else ""
        return f"{self.name} +-{self.half_width:.2g} {self.unit}{with_what}"


@dataclass(frozen=True, slots=True)
class Way:
    """A method of a quantity."""

    needs: tuple[str, ...] = ()
    """Keys of :data:`FEATURES`."""
    expected: tuple[Expected, ...] = ()
    """Total 95 % half widths that 90 % of random simulated drives kept to, with sensors of 1 %."""
    note: str = ""
    """What limits it."""
    from_records: tuple[Expected, ...] = ()
    """The same on drives without averages, whose means are made from records."""


@dataclass(frozen=True, slots=True)
class Row:
    """One way to one quantity."""

    quantity: str
    method: Method
    """What and how."""
    missing: tuple[str, ...]
    """What the drive lacks, in words; empty: available."""
    expected: tuple[Expected, ...] = ()
    """What to expect; empty: not measured."""
    note: str = ""
    """What limits it."""

    @property
    def available(self) -> bool:
        """Whether the drive gives it."""
        return not self.missing

    @property
    def waits_for_person(self) -> bool:
        """Whether it lacks only what a person brings."""
        return self.missing == (FEATURES["bench supply"],)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What one drive gives."""

    identity: Identity
    """Of the drive."""
    drive_map: DriveMap
    """The map used, less the rows that this drive lacks."""
    map_is_drives: bool
    """Whether that map names this identity; without, nothing is written through it."""
    features: frozenset[str]
    """Keys of :data:`FEATURES` it has."""
    recorder: str = ""
    """What a maker's recorder takes, or why it is not read; empty where the map names none."""
    replaced: tuple[str, ...] = ()
    """Limits that the drive does not keep by itself, and what replaces them."""
    current_undecided: bool = False
    """Whether no source says if its amperes are peak or rms."""

    @property
    def level(self) -> CapabilityLevel:
        """The highest level whose needs are met."""
        for level, needs in _LEVELS:
            if self.features >= {*needs, *self._always}:
                return level
        return (
            CapabilityLevel.VENDOR
            if any(self.row(name, Method.VENDOR).available for name in WAYS)
            else CapabilityLevel.MANUAL
        )

    @property
    def unsafe(self) -> bool:
        """Whether the full level lacks only what makes motion safe: such a drive is refused, it is no lower level."""
        missing = {*dict(_LEVELS)[CapabilityLevel.FULL], *self._always} - self.features
        return bool(missing) and missing <= set(_SAFE)

    def rows(self) -> tuple[Row, ...]:
        """Return every quantity by every method."""
        return tuple(self.row(quantity, method) for quantity in WAYS for method in WAYS[quantity])

    def row(self, quantity: str, method: Method) -> Row:
        """Return one way to one quantity."""
        way = WAYS[quantity].get(method)
        if way is None:
            return Row(quantity, method, (f"another method: {quantity} has no {method} method",))
        needs = dict.fromkeys((*self._always, *way.needs)) if way.needs else ()
        missing = tuple(FEATURES[need] for need in needs if need not in self.features)
        expected, note = way.expected, way.note
        if method is Method.INJECT and "averages" not in self.features:
            expected = way.from_records  # the others come from drives that average by themselves
            note = "; ".join(part for part in (note, "means are made from records") if part)
        if self.current_undecided and (quantity, method) == ("mechanics", Method.STANDARD):
            expected, note = (), f"{note}; {UNDECIDED}"
        if method is Method.RECORDER and not self.drive_map.staging:
            expected = ()  # those were measured with the reference drive's recorder
        return Row(quantity, method, missing, expected, note)

    def best(self, quantity: str) -> Row | None:
        """Return the first measuring method of a quantity that is available."""
        rows = (self.row(quantity, method) for method in WAYS[quantity] if method in MEASURING)
        return next((row for row in rows if row.available), None)

    @property
    def by_moves(self) -> str:
        """What leads on where a drive is not pushed, but moves by its position loop; else empty."""
        moves = self.features >= {*_MOVES} and "push" not in self.features
        return "; `pmsmtool move --identify` finds inertia and friction by moves" if moves else ""

    @property
    def map_to_write(self) -> tuple[str, ...]:
        """The map file whose numbers, from the name plate, let a drive move that no map names; else empty."""
        vendor, product = self.identity.vendor_product
        lacking = [row for need, row in _ON_PLATE.items() if need not in self.features]
        given = self.features | _ON_PLATE.keys()
        moves = given >= {*_PUSH} or given >= {*_MOVES}
        unnamed = self.drive_map.name == GENERIC and vendor != UNKNOWN_VENDOR
        return tuple(blank_map(vendor, product, lacking)) if lacking and moves and unnamed else ()

    @property
    def _always(self) -> tuple[str, ...]:
        """What every motion needs: a reference drive without its own safety is not moved by a lower level either."""
        return _SAFE if self.drive_map.staging else ()

    def choose(
        self, quantities: Sequence[str], method: Method | None
    ) -> tuple[Method, tuple[str, ...], dict[str, str]]:
        """Return the first method that gives all, else any of the quantities; which; and why it leaves others out.

        Raises NotAvailable: none gives any; for every quantity the message names what is missing.
        """
        candidates = [way for way in (MEASURING if method is None else (method,)) if way in MEASURING]
        for least in (len(quantities), 1):
            for way in candidates:
                given = tuple(name for name in quantities if self.row(name, way).available)
                if len(given) >= least:
                    return way, given, {name: self._why_not(name, method) for name in quantities if name not in given}
        raise NotAvailable(
            "\n  - ".join(["this drive cannot measure what was asked for", *self._reasons(quantities, method)]),
            where=f"node {self.identity.node}",
            hint=f"`pmsmtool caps` lists what it can{self.by_moves}; `pmsmtool machine new` takes numbers of a "
            "datasheet or a meter",
        )

    def _reasons(self, quantities: Sequence[str], method: Method | None) -> list[str]:
        """Return one line per reason, with the quantities that it stands in the way of."""
        lines: list[tuple[str, str]] = []
        for quantity in quantities:
            for row in (self.row(quantity, m) for m in (WAYS[quantity] if method is None else (method,))):
                if row.method in MEASURING or method is not None:
                    needs = f"not available: needs {', '.join(row.missing)}" if row.missing else "a number you bring"
                    lines.append((quantity, f" by {row.method}: {needs}"))
        return by_reason(lines, "")

    def _why_not(self, quantity: str, method: Method | None) -> str:
        """Return why a quantity is left out of a run that measures others."""
        other = self.best(quantity)
        if other is not None:
            return f"not by the same method as the others: `pmsmtool identify {quantity} --method {other.method}`"
        ways = [way for way in (WAYS[quantity] if method is None else (method,)) if way in MEASURING]
        lacking = by_reason(((f"by {way}", ", ".join(self.row(quantity, way).missing)) for way in ways), " needs ")
        return f"{NOT_TOLD}: {'; '.join(lacking)}"


CONSUMER = DriveObject(CONSUMER_HEARTBEAT, 1, "I")
_HALL = BY_NAME["hall.commutation"]
HALL_COMMUTATION = DriveObject(_HALL.index, _HALL.sub, "B")
UNDECIDED = "no source says whether its amperes are peak or rms: +-17 % more"
MEASURING = (Method.INJECT, Method.RECORDER, Method.STANDARD, Method.VENDOR)
"""Methods that measure, the best first."""
_LEVELS = (
    (CapabilityLevel.FULL, (*_INJECT, "averages")),
    (CapabilityLevel.INJECT, _INJECT),
    (CapabilityLevel.RECORDER, _RECORD),
    (CapabilityLevel.STANDARD, (*_BOUNDED, "push", *_SEEN)),
)


def with_supply(found: Capabilities) -> Capabilities:
    """Return what a drive gives when a person reads its bench supply."""
    return replace(found, features=found.features | {"bench supply"})


def choose_map(identity: Identity, given: DriveMap | None) -> DriveMap:
    """Return the map for a drive: the one given, the shipped one for its identity, else what CiA 402 says."""
    return given or family_of(*identity.vendor_product) or load_family(GENERIC)


def examine(node: DriveNode, given: DriveMap | None = None, *, may_try: bool = False) -> Capabilities:
    """Ask a drive what it has; only reads, but for what may be tried.

    Parameters
    ----------
    node : DriveNode
        The drive; its map is replaced by the chosen one.
    given : DriveMap, optional
        The map to use; default: by the drive's identity.
    may_try : bool
        Whether what a push writes is written and taken back, to know whether the drive takes it: for a rehearsal.
    """
    node.map, node.may_try = given or node.map, may_try
    identity = node.identity()
    node.map = choose_map(identity, given)
    named = identity.vendor != UNKNOWN_VENDOR and node.map.is_for(*identity.vendor_product)
    node.map = drive_map = map_on(node) if named else node.map
    modes = _modes(node)
    has = {
        "heartbeat": node.has(0x1016, 1) if drive_map.staging else node.takes(CONSUMER),
        "abort option": node.has(0x6007, 0),
        "quick stop": node.has(0x605A, 0),
        "line voltage": _shows_link(node, drive_map) or {"u_d_v", "u_q_v"} <= set(drive_map.signals),
        "commutation angle": drive_map.capabilities.commutation_angle
        and bool(modes & _bit(Mode.CYCLIC_TORQUE_ANGLE))
        and node.has(0x60EA, 0),
    }
    rated = None if drive_map.staging else _told(lambda: rated_apk(node))
    if not drive_map.staging:
        has |= _motion(node, rated) | {"encoder": True, "frame": True}
        has["limits"] = rated is not None and limits_current(node, rated) and limits_speed(node)
        guarding = node.takes(GUARD_TIME_MS) and node.takes(LIFE_TIME_FACTOR)
        has["supervision"] = has["heartbeat"] or guarding or expects_pdos(node)
    else:  # only then these objects are what the reference drive has there
        there = node.has(HALL_COMMUTATION.index, HALL_COMMUTATION.sub)
        halls = node.whole(HALL_COMMUTATION) if there else 0
        torque = bool(modes & (_bit(Mode.PROFILE_TORQUE) | _bit(Mode.CYCLIC_TORQUE))) and node.has(0x6071, 0)
        has["limits"] = all(node.has(index, 0) for index in (0x6073, 0x6075, 0x6080))
        has |= {
            "position": node.has(0x6064, 0) and node.has(0x608F, 1),
            "range": True,
            "current": node.has(0x6078, 0),
            "torque mode": torque,
            "push": torque,
            "supervision": has["heartbeat"],
            "rated current": has["limits"],
            "set-points": node.has(0x2052, 1),
            "excitation": node.has(0x2050, 0x0E),
            "averages": node.has(0x2063, 3),
            "recorder": node.has(0x2060, 8),
            "encoder": halls < HallCommutation.ALONE,
            "frame": halls < HallCommutation.STEPS,
        }
    found = {name for name, there in has.items() if there}
    if named:  # whatever starts a drive's own identification is not tried on another drive
        found |= {f"vendor {name}" for name in _vendor_quantities(node, drive_map)}
        found |= {"recorder"} if records_pushes(node) else set()
    replaced = (*first_of_axes(node), *(() if rated is None else watched_by_tool(node, rated)))
    shown = rated is not None and bool(_told(lambda: undecided(node, rated)))
    return Capabilities(identity, drive_map, named, frozenset(found), described(node), replaced, shown)


def _motion(node: DriveNode, rated: float | None) -> dict[str, bool]:
    """Ask a drive of another maker for what motion needs: the standard's objects, else those its map names."""
    base = rated or 1.0
    target = _told(lambda: torque_target(node, base).quantity)
    counts = math.floor(base / target.per_count) if target is not None else 0
    torque = target is not None and node.takes(target.item, counts, -counts)
    units = _told(lambda: position_units(node)) or 0.0
    return {
        "rated current": rated is not None,
        "position": bool(units),
        "range": _told(lambda: position_turns(node, units)) is not None,
        "current": _told(lambda: shown_current(node, base)) is not None,
        "torque mode": torque,
        "push": torque or _told(lambda: limited_speed(node)) is not None,
        "profile position": bool(_modes(node) & _bit(Mode.PROFILE_POSITION))
        and node.takes(TARGET_POSITION)
        and any(node.held(item) is not None for item in (POSITION_DEMAND, FOLLOWING_ERROR)),
    }


def _told(ask: Callable[[], T]) -> T | None:
    """Return what the drive tells, None where it does not."""
    try:
        return ask()
    except (NotAvailable, SdoAbort):
        return None


def _vendor_quantities(node: DriveNode, drive_map: DriveMap) -> frozenset[str]:
    """Return what the drive's own identification tells; without OS commands it tells nothing.

    The answer of an OS command is not read here: reading it acknowledges it.
    """
    tuning = drive_map.vendor_tuning
    if tuning is None:
        return frozenset()
    there = node.has(OS_COMMAND, 2) and node.has(OS_COMMAND_MODE, 0)
    return tuning.quantities if there else frozenset()


def _shows_link(node: DriveNode, drive_map: DriveMap) -> bool:
    """Whether the drive has an object of its DC link: 0x6079, or the maker's own by its map."""
    own = drive_map.signals.get("U_dc_v")
    return node.has(0x6079, 0) or (own is not None and node.has(own.index, own.sub))


def _bit(mode: Mode) -> int:
    """Return the bit of a mode in object 0x6502."""
    return 1 << (mode - 1)


def _modes(node: DriveNode) -> int:
    return int(node.held(SUPPORTED_MODES) or 0)


def reference_capabilities(identity: Identity) -> Capabilities:
    """Return what the reference drive with everything gives."""
    every = frozenset(_SAFE) | frozenset(_INJECT) | frozenset(_RECORD) | frozenset(_PUSH)
    every |= {"averages", "line voltage", "encoder", "frame"}
    return Capabilities(identity, reference_map(), True, every)


_FULL = "benchmarks.identification_coverage --drives 400 --first 70000"
_MECHANICS = "benchmarks.mechanics_accuracy --drives 240 --first 67000"
_RECORDER_RUN = "benchmarks.level_intervals recorder --drives 200 --first 65302"
_STANDARD_RUN = "benchmarks.level_intervals standard --drives 200 --first 64200 --speed 1.35"

_SUPPLY_RUN = "benchmarks.level_intervals supply --drives 60 --first 65000"
_DEAD_TIME = "a machine file that names the dead time"
_BLIND_RUN = "benchmarks.level_intervals standard --drives 27 --first 5076 --speed 1.35 --no-machine"


def _expected(program: str, drives: int, *rows: tuple[str, float, str], given: str = "") -> tuple[Expected, ...]:
    return tuple(Expected(name, half, unit, drives, program, given) for name, half, unit in rows)


_INJECT_RUN = "benchmarks.level_intervals inject --drives 200 --first 63000"


def _vendor(quantity: str, note: str = "") -> Way:
    return Way((*_WATCHED, f"vendor {quantity}"), note=note)


WAYS: Mapping[str, Mapping[Method, Way]] = {
    "R": {
        Method.INJECT: Way(
            _INJECT, _expected(_FULL, 400, ("R_s_ohm", 4.5, "%")),
            from_records=_expected(_INJECT_RUN, 200, ("R_s_ohm", 4.5, "%")),
        ),
        Method.RECORDER: Way(
            _RECORD, _expected(_RECORDER_RUN, 194, ("R_s_ohm", 7.4, "%")),
            "where the inverter's error does not hide it",
        ),
        Method.STANDARD: Way(
            (*_STANDARD, "bench supply"), _expected(_SUPPLY_RUN, 60, ("R_s_ohm", 3.0, "%")),
            "the loop, at the temperature of the run",
        ),
        Method.VENDOR: _vendor("R"),
        Method.MANUAL: Way(),
    },
    "L": {
        Method.INJECT: Way(
            _INJECT, _expected(_FULL, 400, ("L_d_h", 1.5, "%"), ("L_q_h", 1.5, "%")),
            from_records=_expected(_INJECT_RUN, 200, ("L_d_h", 1.5, "%"), ("L_q_h", 1.5, "%")),
        ),
        Method.RECORDER: Way(
            _RECORD, _expected(_RECORDER_RUN, 195, ("L_q_app_h", 6.9, "%")), "L_q at running currents only"
        ),
        Method.VENDOR: _vendor("L", "one inductance for both axes, unless the map has a result for each"),
        Method.MANUAL: Way(),
    },
    "psi": {
        Method.INJECT: Way(
            _TURNING, _expected(_FULL, 400, ("psi_f_wb", 1.1, "%")),
            from_records=_expected(_INJECT_RUN, 200, ("psi_f_wb", 1.2, "%")),
        ),
        Method.RECORDER: Way(
            (*_RECORD, "frame"), _expected(_RECORDER_RUN, 200, ("psi_f_wb", 1.2, "%")),
            "the drive must commutate already",
        ),
        Method.STANDARD: Way(
            (*_PUSH, "line voltage"),
            (
                *_expected(_BLIND_RUN, 26, ("psi_f_wb", 6.4, "%")),
                *_expected(_STANDARD_RUN, 194, ("psi_f_wb", 3.7, "%"), given=_DEAD_TIME),
            ),
            "where the voltage limit is within the speed limit, or the drive shows its voltage",
        ),
        Method.VENDOR: _vendor("psi"),
        Method.MANUAL: Way(),
    },
    "map": {Method.INJECT: Way(_ANGLE)},
    "inverter": {Method.INJECT: Way(_INJECT)},
    "encoder": {
        Method.INJECT: Way(
            _TURNING, _expected(_FULL, 400, ("offset_rad", 0.04, "deg")),
            from_records=_expected(_INJECT_RUN, 200, ("offset_rad", 0.05, "deg")),
        ),
        Method.STANDARD: Way(_STANDARD, _expected(_STANDARD_RUN, 200, ("offset_rad", 0.4, "deg"))),
    },
    "poles": {
        Method.INJECT: Way(_INJECT),
        Method.STANDARD: Way(_STANDARD, _expected(_STANDARD_RUN, 200, ("pole_pairs", 0.1, "%"))),
        Method.VENDOR: _vendor("poles"),
        Method.MANUAL: Way(),
    },
    "mechanics": {
        Method.INJECT: Way(
            _ANGLE, _expected(_MECHANICS, 70, ("J_kgm2", 1.5, "%")),
            from_records=_expected(_INJECT_RUN, 200, ("J_kgm2", 1.5, "%")),
        ),
        Method.RECORDER: Way(
            (*_RECORD, "encoder"),
            _expected(_RECORDER_RUN, 200, ("J_per_psi", 1.5, "%"), ("tau_c_per_psi", 21.0, "%")),
            "J/psi and tau_c/psi",
        ),
        Method.STANDARD: Way(
            (*_PUSH, "encoder"), _expected(_STANDARD_RUN, 200, ("J_per_psi", 1.5, "%"), ("tau_c_per_psi", 30.0, "%")),
            "J/psi and tau_c/psi; over the torque constant where the pole pairs are not known",
        ),
        Method.MANUAL: Way(),
    },
    "frf": {Method.INJECT: Way(_ANGLE)},
    "cogging": {Method.INJECT: Way(_ANGLE)},
    "harmonics": {Method.INJECT: Way(_ANGLE)},
}  # fmt: skip
"""Methods of each quantity: what the drive must have, what to expect, what limits it."""
QUANTITIES = tuple(WAYS)
