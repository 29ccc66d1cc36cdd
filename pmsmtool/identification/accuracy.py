# SPDX-License-Identifier: MIT
"""Whether the accuracy that was asked for is reached: statistical and misfit part of R, L and psi, relative, 95 %."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pmsmtool.estimators.estimate import statistical_half_width
from pmsmtool.identification.prediction import NAMES
from pmsmtool.machine.parameters import Estimate

KEYS: Mapping[str, tuple[str, ...]] = {"R": ("R_s_ohm",), "L": ("L_d_h", "L_q_h"), "psi": ("psi_f_wb",)}
"""Machine-file keys of the quantities that an accuracy can be asked of."""


def accuracy_facts(
    asked: float | None, quantities: Iterable[str], found: Mapping[str, Estimate]
) -> dict[str, dict[str, Any]]:
    """Return for every value that was asked for its half width (None: no value) and whether it is small enough.

    Parameters
    ----------
    asked : float or None
        Relative half width (1); None: nothing is returned.
    quantities : iterable of str
        What was asked for, ``R L psi ...``.
    found : mapping of str to Estimate
        By machine-file key.
    """
    if asked is None:
        return {}
    facts = {}
    for key in (key for quantity in quantities for key in KEYS.get(quantity, ())):
        estimate = found.get(key)
        half = None
        if estimate is not None and estimate.value:
            half = statistical_half_width(estimate) / abs(estimate.value)
        facts[key] = {"asked": asked, "statistical_95": half, "reached": half is not None and half <= asked}
    return facts


def accuracy_told(values: Sequence[Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Return the facts that the values of a stage keep as ``accuracy``; empty where none was asked for."""
    return {value["name"]: value["accuracy"] for value in values if "accuracy" in value}


def accuracy_line(facts: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the facts as a person reads them; empty without any."""
    if not facts:
        return ""
    parts, missed = [], []
    for key, fact in facts.items():
        half = fact["statistical_95"]
        parts.append(f"{NAMES[key]} {'no value' if half is None else f'{100.0 * half:.2g} %'}")
        if not fact["reached"]:
            missed.append(NAMES[key])
    asked = next(iter(facts.values()))["asked"]
    verdict = f"not reached: {', '.join(missed)}" if missed else "reached"
    return f"accuracy {100.0 * asked:.3g} % (95 %, without the sensors' part): {', '.join(parts)}; {verdict}"
