# SPDX-License-Identifier: MIT
"""The speed of uncontrolled generation, and the reaction to a fault that follows from it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.errors import DesignInfeasible
from pmsmtool.machine.parameters import MachineParameters
from pmsmtool.machine.uncontrolled_generation import COLD_C, SPEED_ROOM, fault_reaction, generation_rpm
from pmsmtool.units import rpm_from_rad_s
from tests.firmware.linear_plant import LinearPlant

MACHINE = MachineParameters(4, 0.02, 2.3e-3, 2.1e-3, 0.41)
PSI_COLD = 0.41 * (1.0 + 0.0012 * (MACHINE.T_ref_c - COLD_C))
U_NOM, U_MAX = 210.0, 262.5


def test_line_voltage_reaches_the_limit_at_that_speed() -> None:
    omega_e = generation_rpm(MACHINE, U_MAX) * math.pi / 30.0 * 4
    assert math.sqrt(3.0) * omega_e * PSI_COLD == pytest.approx(U_MAX)
    assert math.isinf(generation_rpm(MachineParameters(4, 0.02, 2.3e-3, 2.1e-3, 0.0), U_MAX))


def test_the_peak_of_a_short_circuit_bounds_that_of_the_plant() -> None:
    """From every current at the voltage limit, at the speed of uncontrolled generation and above."""
    n = generation_rpm(MACHINE, U_MAX)
    told = fault_reaction(MACHINE, U_NOM, U_MAX, 2.0 * n, -1e3)
    n = told.short_from_rpm
    assert n == pytest.approx(generation_rpm(MACHINE, U_NOM)) and not told.note and math.isinf(told.n_most_rpm)
    bound = -2.0 * PSI_COLD / 2.3e-3
    assert f"{bound:.4g} A at most" in told.how
    lowest = 0.0
    for share in (1.0, 1.5):
        omega = share * n * math.pi / 30.0 * 4
        for angle in np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False):
            psi = U_NOM / math.sqrt(3.0) / omega * np.array([math.cos(angle), math.sin(angle)])
            plant = LinearPlant(0.02, 2.3e-3, 2.1e-3, PSI_COLD, 1e-4, omega, False)
            plant.i = (psi - np.array([PSI_COLD, 0.0])) / np.array([2.3e-3, 2.1e-3])
            for _ in range(150):
                plant.advance(0.0, 0.0)
                lowest = min(lowest, float(plant.i[0]))
    assert bound <= lowest <= 0.8 * bound


def test_a_magnet_that_does_not_stand_it_keeps_the_gates_off_and_says_so() -> None:
    n = generation_rpm(MACHINE, U_MAX)
    told = fault_reaction(MACHINE, U_NOM, U_MAX, 1.01 * n, -56.0)
    assert told.short_from_rpm == 0.0 and "chopper" in told.note and f"{n:.4g} rpm" in told.note
    assert told.generation_rpm == pytest.approx(rpm_from_rad_s(U_MAX / (math.sqrt(3.0) * 4 * PSI_COLD)))
    assert told.trip_most_rpm == pytest.approx(n) and told.n_most_rpm == pytest.approx(n / SPEED_ROOM)
    stated = fault_reaction(MACHINE, U_NOM, U_MAX, 1.01 * n, -56.0, "chopper")
    assert stated.short_from_rpm == 0.0 and "chopper" in stated.how and math.isinf(stated.trip_most_rpm)
    assert f"i_d can reach {-PSI_COLD / 2.3e-3:.4g} A, beyond the -56 A allowed" in stated.note
    assert fault_reaction(MACHINE, U_NOM, U_MAX, 1.01 * n, -1e3, "chopper").short_from_rpm == 0.0
    fed = fault_reaction(MACHINE, U_NOM, U_MAX, 1.01 * n, -1e3, "battery")
    assert fed.short_from_rpm == 0.0 and "battery" in fed.how and math.isinf(fed.trip_most_rpm)
    assert f"up to {PSI_COLD / 2.3e-3:.4g} Apk of rectified current into the battery" in fed.note
    with pytest.raises(DesignInfeasible, match="i_d to .* beyond the -56 A allowed"):
        fault_reaction(MACHINE, U_NOM, U_MAX, 1.01 * n, -56.0, "short-circuit")
    quiet = fault_reaction(MACHINE, U_NOM, U_MAX, 0.99 * n, -56.0)
    assert quiet.short_from_rpm == 0.0 and not quiet.note


def test_a_rated_speed_that_nothing_protects_is_refused() -> None:
    """It got a note in the design, and every run at rated speed was one fault from 1.1 U_dc_max."""
    n = generation_rpm(MACHINE, U_MAX)
    rated = replace(MACHINE, n_nom_rpm=1.1 * n)
    with pytest.raises(DesignInfeasible) as refused:
        fault_reaction(rated, U_NOM, U_MAX, 1.4 * n, -56.0)
    assert "--overspeed-protection chopper" in refused.value.hint
    assert not fault_reaction(rated, U_NOM, U_MAX, 1.4 * n, -190.0, "chopper").note
    assert fault_reaction(rated, U_NOM, U_MAX, 1.4 * n, -1e3).short_from_rpm > 0.0


@pytest.mark.parametrize(("psi_f_wb", "named"), [(0.41, False), (410.0, True)])
def test_a_flux_linkage_in_milliwebers_is_named(psi_f_wb: float, named: bool) -> None:
    machine = replace(MACHINE, psi_f_wb=psi_f_wb, n_nom_rpm=900.0)
    with pytest.raises(DesignInfeasible) as told:
        fault_reaction(machine, U_NOM, U_MAX, 1500.0, -1.0)
    assert ("psi_f_wb in another unit" in told.value.likely) == named
