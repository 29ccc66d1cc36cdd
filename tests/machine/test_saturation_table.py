# SPDX-License-Identifier: MIT
"""The few nodes of a flux map that a drive carries."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.analytic_saturation import saturated_pmsyrm_map
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.saturation_table import saturation_table

FLUX_WB = 0.015
"""Distance from the map's flux (Wb), of 1.2 Wb; measured 0.0123, 1 % of the largest."""


def test_a_strongly_saturated_map_is_met_within_a_hundredth_of_its_flux() -> None:
    flux_map = saturated_pmsyrm_map()
    table = saturation_table(flux_map, 20.0)
    assert table is not None and table.nodes.nbytes // 2 == 784  # binary32 in the drive
    assert table.flux_error_wb < FLUX_WB
    i_d, i_q = np.array([-8.7, -8.7, 3.0]), np.array([8.9, -8.9, 0.0])
    assert np.allclose(table.flux(i_d, i_q), flux_map.flux(i_d, i_q), rtol=0.0, atol=FLUX_WB)
    corner = table.nodes[2, 3]
    jacobian = flux_map.incremental_inductance(table.i_d_a[2], table.i_q_a[3])
    assert corner[2:] == pytest.approx([jacobian[0, 0], jacobian[1, 1]])


def test_the_table_stays_on_a_small_map_and_on_one_of_half_a_plane() -> None:
    whole = saturated_pmsyrm_map()
    half = whole.i_q_a >= 0.0
    for part in (
        FluxMap(whole.i_d_a, whole.i_q_a[half], whole.psi_d_wb[:, half], whole.psi_q_wb[:, half]),
        FluxMap(whole.i_d_a[10:40], whole.i_q_a[14:39], whole.psi_d_wb[10:40, 14:39], whole.psi_q_wb[10:40, 14:39]),
    ):
        table = saturation_table(part, 20.0)
        assert table is not None
        assert table.i_q_a[-1] == min(22.0, part.i_q_a[-1]) and table.i_d_a[0] == max(-22.0, part.i_d_a[0])
        assert np.allclose(table.nodes[0, 3, 0], whole.flux(table.i_d_a[0], table.i_q_a[3])[0], atol=1e-3)


def test_a_map_that_falls_somewhere_gives_no_table() -> None:
    whole = saturated_pmsyrm_map()
    folded = FluxMap(whole.i_d_a, whole.i_q_a, whole.psi_d_wb, np.sin(whole.i_q_a / 8.0) + 0.0 * whole.psi_q_wb)
    assert saturation_table(folded, 20.0) is None
