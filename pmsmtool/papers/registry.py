# SPDX-License-Identifier: MIT
"""The figures ``pmsmtool reproduce`` knows. To add one: write its function in a module here and add a row.

A row is all that ``--list`` reads; the module is imported when its figure is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from pmsmtool.errors import ConfigError
from pmsmtool.machine.key import did_you_mean
from pmsmtool.papers.figure import Reproduction

JERCIC = "Jercic et al. 2017, DOI 10.1080/00051144.2018.1453441"
OURS = "pmsmtool; scenarios of Jercic et al. 2017"
MIYAJIMA = "Miyajima, Fujimoto, Fujitsuna 2013"


@dataclass(frozen=True, slots=True)
class Row:
    """One figure."""

    name: str
    """What is typed; kebab-case."""
    target: str
    """``module:function`` in this package; the function is called with the seed."""
    title: str
    """One line."""
    source: str
    """Paper; ours where the figure is not printed there."""
    run_s: float
    """Time it takes on one core of about 2020 (s), roughly."""


FIGURES: tuple[Row, ...] = (
    Row("jercic-fig10", "current_step:q_steps", "step of i_q by seven laws, against minimum time", JERCIC, 5.0),
    Row("jercic-fig11", "weakening:figure_11", "field weakening on perturbed plants, over time", JERCIC, 1.0),
    Row("jercic-fig12", "weakening:figure_12", "field-weakening sweep; excess voltage on faster ramps", JERCIC, 1.0),
    Row("jercic-experiments", "current_step:figures_b", "figures 10 (b), 12 (b): the whole drive, noise", JERCIC, 2.0),
    Row("jercic-table2", "weakening:table_2", "voltage and torque error on perturbed plants", JERCIC, 1.0),
    Row("jercic-horizon", "timing:horizons", "k_max over tuning, tightening, speed, bounds; matrices", JERCIC, 3.0),
    Row("governor-random-steps", "random_steps:random_steps", "300 reachable steps over minimum time", JERCIC, 5.0),
    Row("governor-unreachable", "random_steps:unreachable_references", "300 unreachable references", JERCIC, 8.0),
    Row("governor-voltage-limit", "random_steps:voltage_limit", "demanded voltage over 1000 steps", JERCIC, 8.0),
    Row("governor-delay", "timing:delay_and_predictor", "computation delay and predictor", JERCIC, 1.0),
    Row("plant-mismatch", "random_steps:plant_mismatch", "300 steps on each of five other plants", JERCIC, 6.0),
    Row("speed-ramp", "speed_rise:speed_ramp", "620 to 900 rpm in 20 ms without field weakening", JERCIC, 2.0),
    Row("speed-steps", "speed_rise:speed_steps", "620 to 900 and 1200 rpm without field weakening", JERCIC, 2.0),
    Row("closed-drive", "closed_drive:closed_drive", "a drive that cannot be reflashed: guarantee, cost", OURS, 5.0),
    Row("miyajima-fig2", "polar_steps:figure_2", "conventional voltage-phase control at 800 rpm", MIYAJIMA, 0.5),
    Row("miyajima-fig3", "polar_steps:figure_3", "proposed phase and amplitude control at 800 rpm", MIYAJIMA, 0.5),
    Row("miyajima-fig4", "polar_steps:figure_4", "conventional control with noise, delay and dead time", MIYAJIMA, 0.5),
    Row("miyajima-fig5", "polar_steps:figure_5", "proposed control with noise, delay and dead time", MIYAJIMA, 0.5),
    Row("miyajima-fig7", "polar_linear:figure_7", "linear range at 0 rpm", MIYAJIMA, 0.5),
    Row("miyajima-fig8", "polar_linear:figure_8", "linear range at 400 rpm", MIYAJIMA, 0.5),
    Row("miyajima-fig9", "polar_linear:figure_9", "linear range at 0 rpm with noise and dead time", MIYAJIMA, 0.5),
    Row("miyajima-fig10", "polar_linear:figure_10", "linear range at 400 rpm with noise and dead time", MIYAJIMA, 0.5),
    Row("polar-steps", "polar_steps:compared", "torque steps at 800 rpm by every law and FOC", MIYAJIMA, 1.0),
    Row("polar-linear", "polar_linear:compared", "linear range by every law and FOC", MIYAJIMA, 1.0),
    Row("polar-noise", "polar_linear:at_zero_voltage", "phase oscillation around zero voltage", MIYAJIMA, 2.0),
    Row("polar-ramps", "polar_sweep:transitions", "transitions on torque and speed ramps", MIYAJIMA, 1.5),
    Row("polar-limit", "polar_limit:modulation_limit", "overmodulation, six-step, torque out of reach", MIYAJIMA, 1.5),
    Row("polar-equilibria", "polar_plane:equilibria", "equilibrium search and linear model", MIYAJIMA, 0.5),
    Row("polar-map", "polar_plane:controllability", "condition number, controllability, true poles", MIYAJIMA, 0.5),
    Row("polar-gains", "polar_plane:gain_schedules", "gains over speed and torque", MIYAJIMA, 0.5),
    Row("polar-sweep", "polar_sweep:sweep", "unified law: speeds, loads, 100 random machines", MIYAJIMA, 3.0),
    Row("polar-salient", "polar_salient:salient", "laws on a machine with L_d != L_q", MIYAJIMA, 1.0),
)


def find(name: str) -> Row:
    """Return the row of a figure. Raises ConfigError: no figure has that name."""
    for row in FIGURES:
        if row.name == name:
            return row
    names = [row.name for row in FIGURES]
    raise ConfigError(f"there is no figure {name!r}{did_you_mean(name, names)}", hint="`pmsmtool reproduce --list`")


def reproduce(name: str, seed: int = 1) -> Reproduction:
    """Compute a figure or a table of the papers.

    Parameters
    ----------
    name : str
        As ``pmsmtool reproduce --list`` names it.
    seed : int
        Of random cases and of noise.

    Raises
    ------
    ConfigError
        No figure has that name.
    """
    row = find(name)
    module, _, function_name = row.target.partition(":")
    function: Callable[[int], Reproduction] = getattr(importlib.import_module(f"{__package__}.{module}"), function_name)
    return function(seed)
