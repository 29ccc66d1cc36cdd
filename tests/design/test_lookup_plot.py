# SPDX-License-Identifier: MIT
"""What the three panels of a table's figure show: read back from the artists, against the table's own arrays."""

from __future__ import annotations

import numpy as np
import pytest

from pmsmtool.design.lookup.table import loci, speed_table
from pmsmtool.design.operating_machine import OperatingMachine
from pmsmtool.report.plots import lookup_figure

I_MAX = 150.0
V_MAX = 60.0
MACHINE = OperatingMachine(4, 0.01, 1e-3, 2.5e-3, 0.1)


def test_the_figure_shows_the_whole_current_circle_the_loci_and_the_margins() -> None:
    torque, speed = [0.0, 60.0, 120.0], [50.0, 1000.0, 3000.0]
    table = speed_table(MACHINE, torque_nm=torque, speed_rpm=speed, V_max_v=[V_MAX], I_max_apk=I_MAX)
    lines = loci(table, 21)
    plane, envelope, margin = lookup_figure(table, lines).axes[:3]
    for low, high in (plane.get_xlim(), plane.get_ylim()):
        assert low == pytest.approx(-1.05 * I_MAX)
        assert high == pytest.approx(1.05 * I_MAX)
    drawn = {str(line.get_label()): line.get_xydata() for line in plane.get_lines()}
    np.testing.assert_allclose(np.hypot(*drawn["I_max"].T), I_MAX)
    assert [text.get_text() for text in plane.texts] == ["750 rpm", "1500 rpm", "2250 rpm", "3000 rpm"]
    for axes in (plane, envelope):  # clear of what is drawn
        assert axes.get_legend().get_bbox_to_anchor().x0 >= axes.bbox.x1 - 1e-9
    np.testing.assert_array_equal(drawn["mtpa"], np.column_stack([lines["mtpa"].i_d_a, lines["mtpa"].i_q_a]))
    shown = {str(line.get_label()): line.get_xydata() for line in envelope.get_lines()}
    np.testing.assert_array_equal(
        shown["largest"], np.column_stack([lines["largest"].speed_rpm, lines["largest"].torque_nm])
    )
    reach = max(np.abs(lines[name].torque_nm).max() for name in ("largest", "least"))
    assert envelope.get_ylim() == pytest.approx((-1.1 * reach, 1.3 * reach))
    voltage, current = table.margin_v[:, :, 0] / V_MAX, table.margin_i[:, :, 0] / I_MAX
    least = 100.0 * np.maximum(np.minimum(voltage, current), 0.0)
    np.testing.assert_allclose(np.ravel(margin.collections[0].get_array()), least.ravel())
    assert least.max() > 0.0
