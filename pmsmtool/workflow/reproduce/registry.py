"""The figures ``pmsmtool reproduce`` knows. To add one: write its function in a module here and add a row.

A row is all that ``--list`` reads; the module is imported when its figure is asked for.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from pmsmtool.errors import ConfigError
from pmsmtool.machine.key import did_you_mean
from pmsmtool.workflow.reproduce.figure import Reproduction

JERCIC = "Jercic et al. 2017, DOI 10.1080/00051144.2018.1453441"
MIYAJIMA = "Miyajima, Fujimoto, Fujitsuna 2013"


@dataclass(frozen=True, slots=True)
class Row:
    """One figure.

    Attributes
    ----------
    name : str
        What is typed; kebab-case.
    target : str
        ``module:function`` in this package; the function is called with the seed.
    title : str
        One line.
    source : str
        Paper; ours where the figure is not printed there.
    run_s : float
        Time it takes on one core of about 2020 (s), roughly.
    """

    name: str
    target: str
    title: str
    source: str
    run_s: float


FIGURES: tuple[Row, ...] = ()


def find(name: str) -> Row:
    """Return the row of a figure.

    Raises
    ------
    ConfigError
        No figure has that name.
    """
    for row in FIGURES:
        if row.name == name:
            return row
    names = [row.name for row in FIGURES]
    raise ConfigError(f"there is no figure {name!r}{did_you_mean(name, names)}", hint="`pmsmtool reproduce --list`")


def reproduce(row: Row, seed: int) -> Reproduction:
    """Compute a figure."""
    module, _, name = row.target.partition(":")
    function: Callable[[int], Reproduction] = getattr(importlib.import_module(f"{__package__}.{module}"), name)
    return function(seed)
