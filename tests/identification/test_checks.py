# SPDX-License-Identifier: MIT
"""What a second method says beside the first, where what they are apart is in the first one's interval."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.noise import Noise
from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.machine.parameters import Estimate

PSI = 0.1


def evaluation(apart: float, systematic: float) -> Evaluation:
    """A flux linkage whose second method is a share off, beyond the 0.01 % that either says of itself."""
    psi = Estimate(PSI, PSI * math.hypot(1e-4, apart), systematic * PSI, "Wb")
    driven = Estimate(PSI * (1.0 + apart), 1e-4 * PSI, systematic * PSI, "Wb")
    flux = FluxResult(
        psi, psi, psi, driven, 0.0, psi, 0.0, PSI, 0.0, 0.0, np.zeros(1), np.zeros(1), None, apart * PSI
    )  # fmt: skip
    return Evaluation(Noise(0.01, 0.0, 0.0), flux=flux)


@pytest.mark.parametrize(
    ("apart", "systematic", "agrees"),
    [(0.0007, 0.011, True), (0.02, 0.011, False), (0.0007, 0.0005, False)],
)
def test_a_second_method_alarms_where_it_makes_another_interval(apart: float, systematic: float, agrees: bool) -> None:
    """0.07 % beside 1.1 % of the sensors changes nothing that a reader stands on, and was an alarm."""
    (check,) = evaluation(apart, systematic).checks
    assert check.difference == pytest.approx(apart)
    assert check.agrees == agrees
