# SPDX-License-Identifier: MIT
"""The DC link at the largest speed: full braking, a supply that is cut off, and a trip, on every shipped profile.

    python -m benchmarks.link_events [--profile NAME] [--list]

The simulated drive has the design that `tune` makes of the profile, its whole application included, at the largest
speed of that design (n_max), which a load machine holds all the time. The supply feeds the link but takes nothing back.
The capacitor of the link is assumed: it holds as much energy as HOLD_S of the largest apparent power, 3/2 V_max I_max.
So is the chopper's resistor: it takes the largest current that the machine can rectify, 3/pi psi/L_d, and a fifth more.
Magnets at 0 degC, where their flux is largest. Events, each from the largest braking torque, from none and from the
largest motoring torque: the torque falls to full braking; the supply is cut off; the drive trips. Printed per profile:
what a fault does, the largest voltage of the link over the nominal one in each event, and the most negative i_d with
the limit of the machine file. Exit code 1 above 1.1.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass

import numpy as np

from pmsmtool.design.design_file import Design
from pmsmtool.design.tune import tune
from pmsmtool.files import data_folder
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from pmsmtool.machine.temperature import magnet_flux_at
from pmsmtool.machine.uncontrolled_generation import COLD_C
from pmsmtool.sim.closed_loop import open_simulation
from pmsmtool.sim.kernel import Part, Truth
from pmsmtool.sim.scenarios import Scenario

ALLOWED = 1.1
"""Largest voltage of the link over the nominal one."""
RECTIFIED = 1.2 * 3.0 / math.pi
"""Mean direct current of a diode bridge over the amplitude of its phase currents, and a fifth for saturation."""
HOLD_S = 0.002
"""Time for which the capacitor holds the largest apparent power."""
START, UP_S = 0.2, 0.3
"""Share of n_max at which the drive is switched on, below uncontrolled generation, and time from there to n_max."""
BEFORE_S, AFTER_S = 0.6, 0.4
TRIP = 3
"""A trip without a cause of its own: overcurrent."""
EVENTS = ("braking", "cut", "trip")
LOADS = (-1.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Largest link voltage (V), most negative i_d (A), latched trip."""

    U_dc_v: float
    i_d_a: float
    trip: int


def run(design: Design, event: str, load: float, hold_s: float = HOLD_S) -> Outcome:
    """Return what an event does to a drive with this design at its n_max; ``load`` is the torque before, of tau_max."""
    source, rpm, tau = design.machine, design["motor.n_max_rpm"], design["speed.tau_max_nm"]
    U = source.inverter.U_dc_v
    power = 1.5 * source.inverter.V_max_v * design["motor.I_max_apk"]
    link = {"U_dc_capacitance_f": 2.0 * power * hold_s / U**2, "T_magnet_c": COLD_C}
    if source.inverter.U_dc_chopper_v is not None:
        machine = source.machine
        most = max(design["motor.I_max_apk"], magnet_flux_at(machine, COLD_C) / machine.L_d_h)
        link["U_dc_chopper_ohm"] = source.inverter.U_dc_chopper_v / (RECTIFIED * most)
    after = -tau if event == "braking" else load * tau
    schedule = {
        "torque_nm": ((0.0, 0.0), (UP_S, 0.0), (BEFORE_S - 0.1, load * tau), (BEFORE_S, load * tau), (BEFORE_S, after)),
        "driven_rpm": ((0.0, START * rpm), (UP_S, rpm)),
        "U_dc_v": ((0.0, U), (BEFORE_S, U), (BEFORE_S, 0.0 if event == "cut" else U)),
    }
    scenario = Scenario(event, BEFORE_S + AFTER_S, "torque", schedule, "driven", START * rpm, simulation=link)
    _, simulation, periods = open_simulation(source, design.parameter_set(), scenario)
    record = simulation.record([Truth.U_DC, Truth.I_D, Truth.TRIP], periods, 1)
    before = round(periods * BEFORE_S / scenario.duration_s)
    simulation.run(before)
    if event == "trip":
        simulation.word(Part.TRIP).value = TRIP
    simulation.run(periods - before)
    U_dc, i_d, trip = np.asarray(record).T
    return Outcome(float(U_dc[before:].max()), float(i_d[before:].min()), int(trip[-1]))


def reaction(design: Design) -> str:
    """Return what a fault does, in a few words."""
    short, chopper = design["protection.n_short_circuit_rpm"], design.machine.inverter.U_dc_chopper_v
    if short:
        return f"short circuit above {short:.0f} rpm"
    return "gates off" if chopper is None else f"gates off, chopper at {chopper:.0f} V"


def main() -> int:
    """Print the table; exit code 1 where the link passes its limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", action="append")
    parser.add_argument("--hold-s", type=float, default=HOLD_S)
    parser.add_argument("--list", action="store_true", help="print every run")
    asked = parser.parse_args()
    failed = False
    for name in asked.profile or sorted(path.stem for path in data_folder("profiles").glob("*.toml")):
        design = tune(load_machine_file(machine_path(name)))
        U, i_d_min = design.machine.inverter.U_dc_v, design.machine.limits.i_d_min_apk
        row, least = [], 0.0
        for event in EVENTS:
            found = [run(design, event, load, asked.hold_s) for load in LOADS]
            row.append(max(one.U_dc_v for one in found) / U)
            least = min(least, *(one.i_d_a for one in found))
            if asked.list:
                print(event, *(f"{load:+g}: {one}" for load, one in zip(LOADS, found, strict=True)))
        failed |= max(row) > ALLOWED
        figures = ", ".join(f"{event} {share:.3f}" for event, share in zip(EVENTS, row, strict=True))
        print(
            f"{name:22s} {design['motor.n_max_rpm']:6.0f} rpm  {reaction(design):28s} U_dc/U_nom: {figures}; "
            f"i_d {least:.4g} of {i_d_min:.4g} A{'' if max(row) <= ALLOWED else '  MISS'}"
        )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
