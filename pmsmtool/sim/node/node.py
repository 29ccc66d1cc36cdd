# SPDX-License-Identifier: MIT
"""The simulated drive as hardware on the line: power, reset, identity, memory, and its machine running behind it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from pmsmtool.bus.clock import Schedule, VirtualClock
from pmsmtool.sim.faults import Absence
from pmsmtool.sim.node import memory as storing
from pmsmtool.sim.node.dictionary import DriveFace
from pmsmtool.sim.node.drive_core import DriveCore
from pmsmtool.sim.node.lss import UNCONFIGURED
from pmsmtool.sim.node.memory import Memory, Store
from pmsmtool.sim.node.parameter_set import ParameterImage
from pmsmtool.sim.node.session import Session

VENDOR = 0x706D736D
PRODUCT = 0x00000001
REVISION = 0x00010000
BOOT_S = 0.03
"""From reset or power-on to the boot-up message."""
REMOTE = 2
"""Flag of a remote frame, as ``sim/line.py`` gives it."""
GUARDED_ID = 0x700
LAG_NS = 1_000_000
"""The machine may lag this far behind the clock while nobody looks at it, as behind a 1 ms background task."""


class Medium(Protocol):
    """The line a node is connected to."""

    clock: VirtualClock
    bitrate: int | None

    def transmit(self, sender: Node, can_id: int, data: bytes) -> None:
        """Queue a frame of a node for the wire."""

    def withdraw(self, sender: Node, can_id: int | None) -> None:
        """Take back a node's queued frames of one identifier, of all with None."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What distinguishes one drive from another of its kind."""

    node_id: int
    """Node id while LSS has stored none; 255: unconfigured."""
    serial: int
    """Serial number."""
    name: str
    """Device name, object 0x1008."""
    factory: ParameterImage
    """Parameters of a drive that has never stored any."""
    rated_current_ma: int
    rated_torque_mnm: int
    """Factory values of 0x6075 (rms) and 0x6076."""
    fixed_node_id: bool = False
    """Whether ``node_id`` outranks one stored by LSS (a switch on the drive)."""
    face: DriveFace | None = None
    """What it shows instead of the reference drive's own dictionary."""
    set_point_filter_s: float = 0.0
    """Time constant of the filter behind its torque slope, 0 without (s)."""
    pdo_jitter_s: float = 0.0
    """How late a process data object is sent at most (s)."""
    seed: int = 0
    """Seed of how late they are."""


class Node:
    """One drive.

    Attributes
    ----------
    session : Session or None
        The running firmware; None without power and while booting.
    plugged : bool
        False while the bus connector is pulled: the drive runs, nobody hears it, it hears nobody.
    store_scale, on_store_step
        Fault injection: factor on the time of a store; called after every write step of the memory.
    """

    def __init__(self, line: Medium, core: DriveCore, memory: Memory, settings: Settings) -> None:
        self.line = line
        self.core = core
        self.memory = memory
        self.factory = settings.factory
        self.face = settings.face
        family = (VENDOR, PRODUCT) if self.face is None else self.face.vendor_product
        self.identity = (*family, REVISION, settings.serial)
        self.name = settings.name
        self.set_point_filter_s = settings.set_point_filter_s
        self.pdo_lateness: Iterator[float] = _lateness(settings)
        self.rated_current_ma = settings.rated_current_ma
        self.rated_torque_mnm = settings.rated_torque_mnm
        self.bitrate = line.bitrate
        self.session: Session | None = None
        self.plugged = True
        self.store_scale = 1.0
        self.on_store_step: Callable[[], None] = lambda: None
        self._distort: Callable[[int, int, bytes], tuple[int, bytes]] | None = None
        self._refuse: Callable[[int, int], int | None] | None = None
        self._absent: tuple[Absence, ...] = ()
        self._settings = settings
        self.node_id = self.next_node_id = self._power_on_id()
        self._powered = True
        self._period_ns = core.period_ns
        self._plant_ns = line.clock.now_ns
        self._generation = 0
        line.clock.runners.append(self.catch_up)
        self._build()
        if self.session is not None and self.node_id != UNCONFIGURED:
            self.session.enter_silently()
            if memory.is_damaged():
                self.session.report_damage()

    # ---- power, reset --------------------------------------------------------------------------

    def _power_on_id(self) -> int:
        settings = self._settings
        if settings.fixed_node_id:
            return settings.node_id
        content = self.memory.load()
        stored = {} if content is None else storing.decode(content)
        return stored.get(storing.NODE_ID_KEY, bytes((settings.node_id,)))[0]

    def _build(self) -> None:
        self._generation += 1
        self.node_id = self.next_node_id
        self.session = Session(self, Schedule(self.line.clock))
        self._spoil(self.session)

    def _drop(self) -> None:
        self._generation += 1
        if self.session is not None:
            self.session.schedule.close()
            self.session = None
        self.line.withdraw(self, None)

    def reset(self) -> None:
        """Reset the firmware: gates off, silence, boot-up after ``BOOT_S``."""
        self.look()
        self._drop()
        self.core.restart()
        self._boot_later()

    def _boot_later(self) -> None:
        generation = self._generation

        def boot() -> None:
            if generation == self._generation:
                self._build()
                self.start()

        self.line.clock.after(BOOT_S, boot)

    def start(self) -> None:
        """Announce the node, if it has an id."""
        session = self.session
        if session is None or self.next_node_id == UNCONFIGURED:
            return
        if self.node_id != self.next_node_id:
            self._drop()
            self._build()
            session = self.session
        if session is not None:
            session.boot()
            if self.memory.is_damaged():
                session.report_damage()

    def power_cut(self) -> None:
        """Take the supply away: everything volatile is gone, an unfinished store too."""
        if self._powered:
            self.look()
            self._drop()
            self.core.restart()
            self._powered = False

    def power_on(self) -> None:
        """Give the supply back."""
        if not self._powered:
            self._powered = True
            self._plant_ns = self.line.clock.now_ns
            self.next_node_id = self._power_on_id()
            self._boot_later()

    def plug_in(self) -> None:
        """Put the bus connector back."""
        self.plugged = True

    @property
    def listens(self) -> bool:
        """Whether its CAN controller takes part in the line (and acknowledges frames)."""
        return self.plugged and self.session is not None

    def set_faults(
        self,
        *,
        refuse: Callable[[int, int], int | None] | None,
        distort: Callable[[int, int, bytes], tuple[int, bytes]] | None,
        store_scale: float,
        absent: Sequence[Absence] = (),
    ) -> None:
        """Fault injection: refused writes, lies about sizes, slow store, missing objects (``sim/faults.py``)."""
        self._refuse, self._distort = refuse, distort
        self.store_scale = store_scale
        self._absent = tuple(absent)
        if self.session is not None:
            self._spoil(self.session)

    def _spoil(self, session: Session) -> None:
        session.sdo.refuse, session.sdo.distort = self._refuse, self._distort
        for absence in self._absent:
            session.dictionary.hide(absence.index, absence.sub)

    def make_store(self, session: Session) -> Store:
        """Return the storing objects of a session."""
        return Store(
            session.dictionary,
            session.schedule,
            self.memory,
            current=session.stored_values,
            energised=session.is_energised,
            finish=session.store_finished,
            scale=lambda: self.store_scale,
            step_done=self._store_step,
        )

    def _store_step(self) -> None:
        self.on_store_step()

    # ---- the machine ---------------------------------------------------------------------------

    def take_parameters(self, image: bytes) -> None:
        """Give a parameter image to the core; the control period may change with it."""
        self.look()
        self.core.load(image)
        self._period_ns = self.core.period_ns

    def parameter(self, name: str) -> float:
        """Return an active parameter."""
        return 0.0 if self.session is None else self.session.parameters.active.get(name)

    def catch_up(self, instant_ns: int) -> int:
        """Let the machine run up to an instant, or stop it early when the node must report something."""
        if not self._powered:
            self._plant_ns = instant_ns
            return instant_ns
        if instant_ns - self._plant_ns < LAG_NS:
            return instant_ns
        if self._run(instant_ns):
            instant_ns = min(instant_ns, max(self._plant_ns, self.line.clock.now_ns))
        session = self.session
        if session is not None and session.is_lively():
            session.schedule.at(instant_ns, session.attend)
        return instant_ns

    def _run(self, instant_ns: int) -> bool:
        """Run the core up to an instant; returns whether it stopped early because something happened."""
        periods = (instant_ns - self._plant_ns) // self._period_ns
        if periods <= 0:
            return False
        ran = self.core.run(periods)
        self._plant_ns += ran * self._period_ns
        return ran < periods

    def look(self) -> None:
        """Bring the machine to the present instant, for somebody who looks at it or acts on it."""
        if not self._powered:
            return
        now_ns = self.line.clock.now_ns
        if now_ns - self._plant_ns < self._period_ns:
            return
        while self._run(now_ns):
            self._attend()
        self._attend()

    def _attend(self) -> None:
        session = self.session
        if session is not None and session.is_lively() and not session.attending:
            session.attend()

    # ---- the line ------------------------------------------------------------------------------

    def receive(self, can_id: int, data: bytes, flags: int) -> None:
        """Take a frame of the line; data frames with 11-bit identifiers, and the remote frames of node guarding."""
        if not self.plugged or self.session is None:
            return
        if not flags:
            self.session.receive(can_id, data)
        elif flags == REMOTE and can_id == GUARDED_ID + self.node_id:
            self.session.asked()

    def send(self, can_id: int, data: bytes) -> None:
        """Transmit a frame."""
        if self.plugged and self._powered:
            self.line.transmit(self, can_id, data)

    def withdraw(self, can_id: int) -> None:
        """Take back frames of an identifier that are not on the wire yet."""
        self.line.withdraw(self, can_id)


def _lateness(settings: Settings) -> Iterator[float]:
    """Yield how late each process data object is sent (s)."""
    if settings.pdo_jitter_s == 0.0:
        yield from itertools.repeat(0.0)
    import numpy as np

    rng = np.random.default_rng(settings.seed)
    while True:
        yield float(rng.uniform(0.0, settings.pdo_jitter_s))
