# SPDX-License-Identifier: MIT
"""The population of *real* drives: those of ``random_drives.py``, each with four effects of real machines or more.

Every effect of ``benchmarks/real_effects.py`` is drawn by itself, with an even chance, from its usual range; a drive
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
CHANCE = 0.5
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
    "sensor lag us": (1.0, 10.0),
    "encoder age us": (1.0, 50.0),
    "friction %": (0.5, 15.0),
}
"""Usual range of an effect, in the unit of its level; drawn evenly over its logarithm."""


def draw_real(seed: int, block: Block = "ideal") -> tuple[MachineFile, dict[str, float]]:
    """Return drive number ``seed`` and its effects with their levels."""
    drive = draw_drive(seed, block)
    rng = np.random.default_rng([20261123, seed])
    while True:
        drawn = {
            effect: math.exp(rng.uniform(math.log(low), math.log(high)))
            for effect, (low, high) in RANGES.items()
            if rng.random() < CHANCE
        }
        if len(drawn) >= LEAST_EFFECTS:
            break
    for effect in sorted(drawn, key="inertia x".__ne__):  # what is a share of the inertia follows it
        changes = EFFECTS[effect][0](drive, drawn[effect])
        drive = replace(drive, simulation={**drive.simulation, **changes})
    J, J_load = (truth_of(drive, name) for name in ("J_kgm2", "J_load_kgm2"))
    drive = replace(drive, simulation={**drive.simulation, "J_kgm2": J})
    return replace(drive, machine=replace(drive.machine, J_kgm2=J + J_load)), drawn
