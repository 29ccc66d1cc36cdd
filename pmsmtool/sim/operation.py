# SPDX-License-Identifier: MIT
"""A served drive in operation: a program of its own runs the machine through speeds and loads, nobody on the bus does.

As in a plant: whoever joins may look, and may stop it. After a stop or a fault it stays off until it is served again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from pmsmtool.cia402 import Mode, State, command_towards_enabled
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.sim.closed_loop import image_of
from pmsmtool.sim.drive_kernel import KernelCore
from pmsmtool.sim.line import Line
from pmsmtool.sim.node.node import Node
from pmsmtool.sim.node.parameter_set import ParameterImage

POINTS = ((0.38, 0.13), (0.95, 0.74), (-0.64, -0.4), (0.57, 0.27), (-0.95, 0.74), (0.76, 0.54))
"""Speeds of the rated one, loads of the rated torque (one of them drives the shaft): currents and speeds large and
small, which R and psi_f need. `track` tells R of interior-2k2 within 2.1 % (one standard deviation) after 20 s; without
the driving load 2.5 %, and large loads at low speed are refused."""
POINT_S = 1.5
"""Each of them lasts this long."""
TICK_S = 0.01
MRPM = 1000.0
START_S = 1.0
"""A drive that does not run by then never will: a fault on purpose keeps it from it. Measured 0.06 s."""
FALLBACK_SHARE = 0.5
"""Speed of the largest where the machine file names no rated one."""
Say = Callable[[str], None]


def operate(line: Line, machine_file: MachineFile, say: Say = lambda text: None) -> None:
    """Set every drive of a line going, and let it boot and start before anybody joins: nobody sees it reset.

    Raises ConfigError, DesignInfeasible: as :class:`Operation`.
    """
    operations = [Operation(node, machine_file, say) for node in line.nodes]
    last = line.clock.now() + START_S
    while line.clock.now() < last and not all(operation.ran for operation in operations):
        line.clock.wait(TICK_S)


class Operation:
    """Runs one drive until it is stopped.

    Raises ConfigError: the drive has another face, or the machine cannot be run; DesignInfeasible: there is no design
    for it.

    Parameters
    ----------
    node : Node
        The reference drive with volatile memory; it is reset to hold a design for its machine.
    machine_file : MachineFile
        What the drive drives.
    say : callable
        Told when somebody ends the operation.

    Attributes
    ----------
    ran : bool
        Whether it has been in operation.
    """

    def __init__(self, node: Node, machine_file: MachineFile, say: Say = lambda text: None) -> None:
        machine = machine_file.machine
        n_rpm = machine.n_nom_rpm or FALLBACK_SHARE * (machine.n_max_rpm or 0.0)
        torque = abs(machine.torque_nm(0.0, machine.I_nom_apk or 0.0))
        if node.face is not None or not isinstance(node.core, KernelCore):
            raise ConfigError(
                "only the reference drive runs by itself",
                where=f"node {node.node_id}",
                hint="leave drive= and level= out of the channel",
            )
        if not (n_rpm and torque and machine.J_kgm2):
            raise ConfigError(
                "the machine cannot be run: its rated current, speed or inertia is not known",
                where=machine_file.name,
                hint="give I_nom_apk, n_nom_rpm and J_kgm2 in the machine file",
            )
        self._node, self._core, self._say = node, node.core, say
        self._points = [(MRPM * speed * n_rpm, load * torque) for speed, load in POINTS]
        self._since_s = 0.0
        self.ran = self._ended = False
        design = tune(replace(machine_file, simulation={}), TuneRequest())
        node.factory = ParameterImage.of_bytes(image_of(machine_file, design.parameter_set()))
        node.reset()
        node.line.clock.every(TICK_S, self._tick)

    def _tick(self) -> None:
        session = self._node.session
        if session is None or self._ended:
            return  # it boots
        state = session.power.state
        if state is State.OPERATION_ENABLED:
            self._run()
        elif self.ran:
            self._end(state)
        else:
            word = command_towards_enabled(state)
            if word is not None:
                self._write("cia402.mode", Mode.PROFILE_VELOCITY)
                self._write("cia402.controlword", word)

    def _run(self) -> None:
        now_s = self._node.line.clock.now()
        if not self.ran:
            self.ran, self._since_s = True, now_s
        speed_mrpm, load_nm = self._points[int((now_s - self._since_s) / POINT_S) % len(self._points)]
        self._load(load_nm)
        self._write("cia402.target_velocity", round(speed_mrpm))

    def _end(self, state: State) -> None:
        """Take the load away with the torque: what is left of the motion coasts."""
        self._ended = True
        self._load(0.0)
        self._say(f"node {self._node.node_id}: {state.name.lower().replace('_', ' ')}, the operation is over")

    def _load(self, load_nm: float) -> None:
        self._node.look()
        simulation = self._core.simulation
        simulation.library.pmsm_sim_set_load(simulation.sim, load_nm)

    def _write(self, key: str, number: float) -> None:
        session = self._node.session
        if session is None:
            return
        entry = session.dictionary[key]
        session.dictionary.write(entry, entry.encode(number))
