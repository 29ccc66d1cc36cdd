# SPDX-License-Identifier: MIT
"""The laws of control in polar coordinates by name, and the option bits of the drive (``firmware/core/polar.c``)."""

from __future__ import annotations

from collections.abc import Mapping

LAWS: Mapping[str, int] = {
    "conventional": 1,
    "proposed": 2,
    "linear": 3,
    "linear-printed": 4,
    "regularised": 5,
    "unified": 6,
}
"""``polar.mode`` of the catalogue."""

SURFACE_ONLY = ("conventional", "proposed", "linear", "linear-printed")
"""Laws of the paper: they hold for L_d = L_q."""

ON_MEASUREMENT, NO_ANTI_WINDUP, PREDICT, LINEAR_RANGE = 1, 2, 4, 8
"""Bits of ``polar.options``: P and D on the measurement, (ablation), prediction, switch to the regularised law."""

PHASE_LAWS = ("conventional", "proposed")
"""Laws of section III: the phase is the input for i_q, which needs speed."""
