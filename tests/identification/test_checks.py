# SPDX-License-Identifier: MIT
"""What a second method says beside the first, where what they are apart is in the first one's interval."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pmsmtool.estimators.angle_harmonics import AngleHarmonics, Harmonic
from pmsmtool.estimators.current_sensors import Noise
from pmsmtool.estimators.encoder import EncoderResult
from pmsmtool.estimators.flux.linkage import FluxResult
from pmsmtool.estimators.shaft.mechanics import MechanicsResult
from pmsmtool.identification.evaluate import Evaluation
from pmsmtool.identification.request import IdentifyRequest
from pmsmtool.identification.value_verdict import IF_APART, conditions_of, summary_of, warnings_of
from pmsmtool.machine.parameters import Estimate
from pmsmtool.refusals import refuse

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


def test_why_a_frequency_response_was_refused_is_in_the_line_of_the_stage() -> None:
    """Before, `commission`, which measures it without being asked for it, did not say that there was none."""
    refused = refuse("E_COHERENCE", "12 of 400 lines have a coherence of 0.9, 50 are needed", stage="frf")
    bare = Evaluation(Noise(0.01, 0.0, 0.0))
    without = replace(bare, refused={"frf": refused})
    said = summary_of(without, {}, ("R", "L", "psi"))
    assert said == f"frequency response refused: {refused.what}" and said.count("E_COHERENCE") == 1
    assert summary_of(without, {}, ("R", "frf")) == "", "the verdict on what was asked for says it"
    assert summary_of(bare, {}, ("R",)) == ""


def test_a_disagreement_ends_with_what_to_do() -> None:
    """`L_q_h_apparent DISAGREES with L_q_h` was the whole line."""
    apart = evaluation(0.02, 0.011)
    (line,) = [line for line in warnings_of(apart, IdentifyRequest(("psi",))) if "DISAGREES" in line]
    assert line.endswith(IF_APART["psi_f_wb"]) and "--speed-max" in line
    assert {"psi_f_wb", "L_q_h"} == set(IF_APART) and "`commission --flux-map`" in IF_APART["L_q_h"]


def test_the_encoder_errors_that_are_told_are_those_of_the_machine_file() -> None:
    """0.44 and 0.42 deg were told of a slow turn, and 0.500 and 0.250 deg kept of the coasting; elsewhere none told."""
    turned = tuple(Harmonic(k, math.radians(off), 0.0, 1e-6) for k, off in ((1, 0.44), (2, 0.42)))
    coasted = tuple(Harmonic(k, math.radians(off), 0.0, 1e-6) for k, off in ((1, 0.5), (2, 0.25)))
    one = Estimate(1.0, 0.01, 0.0, "1")
    encoder = EncoderResult(one, 1, one, 0.0, turned)
    mechanics = MechanicsResult(one, one, one, (0.0, 0.0, 0.0), 0.0, 1.0, False, AngleHarmonics(coasted))
    asked = IdentifyRequest(("mechanics",))
    for found, told in ((Evaluation(Noise(0.01, 0.0, 0.0), encoder=encoder), ("0.44", "0.42")),
                        (Evaluation(Noise(0.01, 0.0, 0.0), encoder=encoder, mechanics=mechanics), ("0.5", "0.25")),
                        (Evaluation(Noise(0.01, 0.0, 0.0), mechanics=mechanics), ("0.5", "0.25"))):  # fmt: skip
        lines = [line for line in warnings_of(found, asked) if "the encoder is off by" in line]
        for line, deg, often in zip(lines, told, ("once", "twice"), strict=True):
            assert f"off by {deg} deg (mechanical) {often} per turn" in line
            assert math.degrees(conditions_of(found, asked)[f"encoder_{often}_rad"]) == pytest.approx(float(deg))
