# SPDX-License-Identifier: MIT
"""The parameter set: canonical text, content hash, bounds, differences."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pmsmtool.errors import ConfigError
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE
from pmsmtool.params.parameter_set import ParameterSet, compare, default_set, parse_parameter_set

LUT = {
    "lut.axis_x": (0.0, 5.0, 10.0),
    "lut.axis_y": (100.0, 200.0),
    "lut.axis_z": (48.0,),
    "lut.i_d_a": (0.0, -1.0, -2.0, -3.0, -4.0, math.nan),
    "lut.i_q_a": (0.0, 1.0, 2.0, 3.0, 4.0, math.nan),
}
DESCRIPTOR = {"lut.format": 1, "lut.n_x": 3, "lut.n_y": 2, "lut.n_z": 1}


def test_defaults_are_within_their_bounds() -> None:
    assert default_set().violations() == ()


def test_text_is_canonical_whatever_the_order_of_entry() -> None:
    forward = {row.name: row.default for row in CATALOGUE}
    backward = dict(reversed(forward.items()))
    assert ParameterSet(forward).to_toml() == ParameterSet(backward).to_toml()


def test_round_trip_with_tables_and_provenance() -> None:
    first = ParameterSet(
        {**default_set().values, **DESCRIPTOR}, LUT, {"motor.R_s_ohm": 'dc_levels "a"\\b', "x": "y"}, "née"
    )
    again = parse_parameter_set(first.to_toml())
    assert again.to_toml() == first.to_toml()
    assert again.content_hash() == first.content_hash()
    assert again.violations() == ()
    assert again.provenance == first.provenance and again.name == "née"


@pytest.mark.chain
@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.sampled_from(sorted(BY_NAME)), st.floats(allow_nan=False, allow_infinity=False), min_size=1))
@example({"current.options": 2.0**63})  # beyond the whole numbers of TOML: it was written as one, and not read
def test_every_number_survives_the_text(values: dict[str, float]) -> None:
    assert parse_parameter_set(ParameterSet(values).to_toml()).values == ParameterSet(values).values


@pytest.mark.chain
@settings(max_examples=300, deadline=None)
@given(st.text())
def test_any_text_is_a_set_or_a_config_error(text: str) -> None:
    for body in (text, 'schema = "pmsmtool.params/1"\n' + text):
        try:
            parse_parameter_set(body)
        except ConfigError:
            pass


def test_edited_file_is_refused_until_the_hash_line_is_deleted() -> None:
    text = ParameterSet({"motor.R_s_ohm": 0.137}).to_toml().replace("0.137", "0.147")
    with pytest.raises(ConfigError, match="edited or cut"):
        parse_parameter_set(text)
    kept = "".join(line for line in text.splitlines(keepends=True) if not line.startswith("content"))
    assert parse_parameter_set(kept).values == {"motor.R_s_ohm": 0.147}


def test_all_that_is_wrong_is_listed_with_a_suggestion() -> None:
    text = 'schema = "pmsmtool.params/1"\n[motor]\nR_s = 0.1\nL_d_h = "2 mH"\n[mottor]\nx = 1\n'
    with pytest.raises(ConfigError) as caught:
        parse_parameter_set(text, "a.toml")
    message = str(caught.value)
    assert "did you mean motor.R_s_ohm" in message and "motor.L_d_h: '2 mH'" in message and "mottor.x" in message


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"motor.R_s_ohm": -1.0}, "outside"),
        ({"motor.pole_pairs": 4.5}, "not an integer"),
        ({"motor.L_d_h": math.inf}, "not finite"),
        ({"motor.pole_pairs": 65}, "outside"),
    ],
)
def test_violations(values: dict[str, float], complaint: str) -> None:
    found = ParameterSet(values).violations()
    assert len(found) == 1 and complaint in found[0]


def test_bound_that_is_no_binary32_accepts_its_own_image() -> None:
    assert ParameterSet({"motor.alpha_psi_per_k": -0.009999999776482582}).violations() == ()
    assert ParameterSet({"motor.alpha_psi_per_k": -0.01000000001}).violations() == ()


def test_tables_must_fit_their_descriptor() -> None:
    assert ParameterSet(DESCRIPTOR, LUT).violations() == ()
    assert "descriptor says 6" in ParameterSet(DESCRIPTOR, {**LUT, "lut.i_d_a": (0.0,)}).violations()[0]
    assert "no table" in ParameterSet({**DESCRIPTOR, "lut.format": 0}, LUT).violations()[0]
    assert "rise" in ParameterSet(DESCRIPTOR, {**LUT, "lut.axis_x": (0.0, 5.0, 5.0)}).violations()[0]
    assert "without their descriptor" in ParameterSet({}, LUT).violations()[0]


def test_difference_lists_scalars_and_counts_table_cells() -> None:
    old = ParameterSet({"motor.R_s_ohm": 0.1, "motor.L_d_h": 0.002}, LUT)
    new = ParameterSet(
        {"motor.R_s_ohm": 0.2, "motor.L_q_h": 0.002}, {**LUT, "lut.i_d_a": (9.0, -1.0, -2.0, -3.0, 9.0, math.nan)}
    )
    found = {d.name: d for d in compare(old, new)}
    assert found["motor.R_s_ohm"].relative == pytest.approx(1.0)
    assert found["motor.L_d_h"].new is None and found["motor.L_q_h"].old is None
    assert found["lut.i_d_a"].cells == 2 and (found["lut.i_d_a"].old, found["lut.i_d_a"].new) == (0.0, 9.0)
    assert [d.name for d in compare(old, new, common_only=True)] == ["motor.R_s_ohm", "lut.i_d_a"]
