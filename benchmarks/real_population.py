# SPDX-License-Identifier: MIT
"""The population of *real* drives: those of ``random_drives.py``, each with four effects of real machines or more.

Every effect of ``benchmarks/real_effects.py`` is drawn by itself from its usual range; a drive
with fewer than ``LEAST_EFFECTS`` is drawn again. A drive follows from its seed alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from benchmarks.random_drives import Block, draw_drive
from benchmarks.real_effects import EFFECTS, truth_of
from pmsmtool.machine.machine_file import MachineFile

LEAST_EFFECTS = 4
MEAN_EFFECTS = 7.0
"""Effects of a drive, on average: each is drawn with the same chance."""
RANGES: Mapping[str, tuple[float, float]] = {
    "cogging %": (0.3, 5.0),
    "emf 5th 7th %": (0.5, 5.0),
    "iron loss %": (2.0, 8.0),
    "eddy branch %": (2.0, 10.0),
    "inertia x": (0.1, 50.0),
    "DC link ripple %": (1.0, 5.0),
    "sensor mismatch %": (0.3, 2.0),
    "elastic J ratio": (0.2, 20.0),
    "drag of tau_c": (0.2, 2.0),
    "heating s": (2.0, 60.0),
    "encoder once deg": (0.02, 0.5),
    "encoder noise steps": (0.3, 3.0),
    "sensor lag us": (1.0, 10.0),
    "encoder age us": (1.0, 50.0),
    "friction %": (0.5, 15.0),
    "R imbalance %": (0.3, 3.0),
    "L imbalance %": (0.3, 3.0),
    "L 6th %": (1.0, 5.0),
    "cogging tolerances %": (0.05, 1.0),
    "Stribeck %": (5.0, 60.0),
    "friction once %": (5.0, 20.0),
    "backlash deg": (0.05, 1.0),
    "sensor cubic %": (0.1, 0.5),
    "sensor drift %/min": (0.1, 0.5),
    "DC link sag %": (2.0, 10.0),
}
"""Usual range of an effect, in the unit of its level; drawn evenly over its logarithm."""
DETAILS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "eddy branch %": {"time_us": (20.0, 200.0)},
    "DC link ripple %": {"hz": (100.0, 360.0)},
    "elastic J ratio": {"hz": (50.0, 800.0), "damping_percent": (0.5, 5.0)},
}
"""Further values of an effect, drawn in the same way."""


def draw_real(seed: int, block: Block = "ideal") -> tuple[MachineFile, dict[str, float]]:
    """Return drive number ``seed`` and its effects with their levels."""
    drive = draw_drive(seed, block)
    rng = np.random.default_rng([20261123, seed])
    while True:
        drawn = {
            effect: math.exp(rng.uniform(math.log(low), math.log(high)))
            for effect, (low, high) in RANGES.items()
            if rng.random() < MEAN_EFFECTS / len(RANGES)
        }
        if len(drawn) >= LEAST_EFFECTS:
            break
    # what is a share of the inertia follows it, and play follows the shaft
    for effect in sorted(drawn, key=lambda name: (name != "inertia x", name == "backlash deg")):
        details = {
            name: math.exp(rng.uniform(math.log(low), math.log(high)))
            for name, (low, high) in DETAILS.get(effect, {}).items()
        }
        changes = EFFECTS[effect][0](drive, drawn[effect], **details)
        drive = replace(drive, simulation={**drive.simulation, **changes})
    J, J_load = (truth_of(drive, name) for name in ("J_kgm2", "J_load_kgm2"))
    drive = replace(drive, simulation={**drive.simulation, "J_kgm2": J})
    return replace(drive, machine=replace(drive.machine, J_kgm2=J + J_load)), drawn
