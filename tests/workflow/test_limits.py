"""What the experiments may use must leave something."""

from __future__ import annotations

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.workflow.limits import Limits

GIVEN = {"I_nom_apk": 5.0, "i_max_apk": 6.0, "omega_max_rad_s": 300.0, "V_max_v": 28.0}


@pytest.mark.parametrize("name", GIVEN)
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_a_limit_that_leaves_nothing_is_refused_before_anything_moves(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match="nothing can be measured"):
        Limits(**{**GIVEN, name: value})


def test_the_test_current_stays_within_the_envelope() -> None:
    assert Limits(**GIVEN).I_test_apk == 5.0
    assert Limits(**{**GIVEN, "i_max_apk": 4.4}).I_test_apk == pytest.approx(4.0)
