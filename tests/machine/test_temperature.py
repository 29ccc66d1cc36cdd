# SPDX-License-Identifier: MIT
"""The temperature coefficients have one home; who needs a default takes it from there."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from pathlib import Path

import pytest

import pmsmtool
from pmsmtool.estimators.estimate import SensorTolerance, total_half_width
from pmsmtool.estimators.flux.linkage import normalised
from pmsmtool.machine.parameters import Estimate, MachineParameters
from pmsmtool.machine.temperature import COPPER_ALPHA_PER_K, MAGNET_ALPHA_PER_K, magnet_tolerance_per_k
from pmsmtool.params.catalogue import BY_NAME

PACKAGE = Path(pmsmtool.__file__).parent
HOME = PACKAGE / "machine" / "temperature.py"
COEFFICIENTS = (COPPER_ALPHA_PER_K, -MAGNET_ALPHA_PER_K)
"""Signless: a minus is an operator of its own."""


def numbers(path: Path) -> set[float]:
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        constants = (node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Constant))
        return {float(value) for value in constants if isinstance(value, int | float)}
    return {float(number) for number in re.findall(r"\b\d+\.\d+(?:[eE][+-]?\d+)?", re.sub(r"//.*|/\*.*?\*/", "", text))}


@pytest.mark.chain
def test_no_other_file_of_the_package_writes_a_coefficient_down() -> None:
    """The catalogue had a copy of both: a default that is corrected in one place only."""
    assert numbers(HOME) >= set(COEFFICIENTS)
    files = [path for kind in ("py", "c", "h", "toml") for path in PACKAGE.rglob(f"*.{kind}") if path != HOME]
    assert len(files) > 200
    assert [str(path.relative_to(PACKAGE)) for path in files if numbers(path) & set(COEFFICIENTS)] == []


def test_the_drive_starts_with_them() -> None:
    """Copper gains 0.393 %/K, magnets of sintered NdFeB lose 0.12 %/K."""
    held = {name: BY_NAME[name].default for name in ("motor.alpha_R_per_k", "motor.alpha_psi_per_k")}
    assert held == {"motor.alpha_R_per_k": 0.00393, "motor.alpha_psi_per_k": -0.0012}


def test_the_magnets_coefficient_is_stated_or_has_the_range_of_magnets() -> None:
    """A ferrite magnet at 60 degC read with the default coefficient was 3.4 % off, 11 times its interval."""
    assumed = MachineParameters(3, 3.6, 0.036, 0.051, 0.545)
    assert magnet_tolerance_per_k(replace(assumed, alpha_psi_per_k=-0.002)) == 0.0
    assert magnet_tolerance_per_k(replace(assumed, alpha_psi_tolerance_per_k=1e-4)) == 1e-4
    per_k = magnet_tolerance_per_k(assumed)
    for true in (-0.0003, -0.002):  # samarium-cobalt and ferrite
        shown = Estimate(0.545 * (1.0 + true * 40.0), 1e-4, 0.005, "Wb", T_c=60.0)
        found = normalised(shown, 20.0, assumed.alpha_psi_per_k, SensorTolerance(magnet_per_k=per_k))
        assert abs(found.value - 0.545) < total_half_width(found)
        alone = normalised(shown, 20.0, assumed.alpha_psi_per_k, SensorTolerance())
        assert alone.value == found.value and abs(alone.value - 0.545) > 2.0 * total_half_width(alone)
