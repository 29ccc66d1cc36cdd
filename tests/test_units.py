# SPDX-License-Identifier: MIT
"""Units: what people write, what comes back, and errors that teach."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pmsmtool.errors import ConfigError
from pmsmtool.machine.machine_keys import machine_file_keys
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.units import (
    DIMENSIONS,
    UNITS,
    check_unit,
    format_current,
    format_estimate,
    format_quantity,
    parse_current,
    parse_quantity,
    unit_of_key,
)


@pytest.mark.parametrize(
    ("text", "dimension", "value"),
    [
        ("800Hz", "frequency", 800.0),
        ("0.8 kHz", "Hz", 800.0),
        ("1.2mH", "inductance", 0.0012),
        ("1.2 mH", "H", 0.0012),
        ("47.9V", "voltage", 47.9),
        ("137mohm", "resistance", 0.137),
        ("137 mΩ", "resistance", 0.137),
        ("250us", "time", 250e-6),
        ("250µs", "time", 250e-6),
        ("250μs", "time", 250e-6),
        ("2us", "ns", 2000.0),
        ("1200rpm", "rpm", 1200.0),
        ("1200 r/min", "angular speed", 125.66370614359172),
        ("90deg", "angle", math.pi / 2),
        ("4.5Nm", "torque", 4.5),
        ("410mVs", "flux linkage", 0.41),
        ("21kgcm2", "inertia", 0.0021),
        ("12 g cm^2", "inertia", 1.2e-6),
        ("-20degC", "temperature", -20.0),
        ("0.95", "ratio", 0.95),
        ("95%", "ratio", 0.95),
        ("0.393%/K", "temperature coefficient", 0.00393),
        ("12Apk", "current", 12.0),
        ("1e-3H", "H", 0.001),
    ],
)
def test_quantities_as_written(text, dimension, value):
    assert parse_quantity(text, dimension) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "dimension", "teaches"),
    [
        ("800", "frequency", "has no unit"),
        ("800H", "frequency", "is a unit of inductance, not of frequency"),
        ("1,2mH", "inductance", "decimal comma"),
        ("12 furlong", "voltage", "is no unit of voltage"),
        ("Hz", "frequency", "not a number"),
        ("", "frequency", "not a number"),
        ("nanHz", "frequency", "not a number"),
        ("1e999V", "voltage", "too large"),
        ("800", "speedd", "unknown unit"),
        ("5mrpm2", "rpm", "no unit of angular speed"),
    ],
)
def test_a_wrong_quantity_says_why(text, dimension, teaches):
    with pytest.raises(ConfigError) as caught:
        parse_quantity(text, dimension)
    assert teaches in str(caught.value)


@pytest.mark.parametrize(("text", "peak"), [("12Apk", 12.0), ("8.5 Arms", 8.5 * math.sqrt(2)), ("500mApk", 0.5)])
def test_current_is_peak(text, peak):
    assert parse_current(text) == pytest.approx(peak, rel=1e-15)


@pytest.mark.parametrize("text", ["12A", "12", "12V", "12mA", "Apk", "12xApk"])
def test_current_without_kind_is_refused(text):
    with pytest.raises(ConfigError):
        parse_current(text)
    with pytest.raises(ConfigError):
        parse_quantity(text, "current")


def test_current_refusal_offers_both_kinds():
    with pytest.raises(ConfigError, match="12Apk or 12Arms"):
        parse_current("12A")


def test_current_echoes_both_kinds():
    assert format_current(12.0) == "12 Apk (8.485 Arms)"


@given(
    st.sampled_from([unit for unit in UNITS.values() if unit.dimension not in ("current", "ratio")]),
    st.floats(-1e9, 1e9, allow_nan=False),
)
def test_every_unit_reads_back_in_itself(unit, value):
    assert parse_quantity(f"{value!r} {unit.symbol}", unit.symbol) == value  # the space matters to 1/K only


@given(st.sampled_from(["p", "n", "u", "m", "k", "M", "G"]), st.decimals(0, 10**6, places=6))
def test_a_prefix_is_exact(prefix, value):
    exponent = {"p": -12, "n": -9, "u": -6, "m": -3, "k": 3, "M": 6, "G": 9}[prefix]
    assert parse_quantity(f"{value}{prefix}V", "voltage") == float(f"{value}e{exponent}")


def test_each_dimension_has_one_si_unit():
    assert {unit.dimension for unit in UNITS.values()} == set(DIMENSIONS)
    for symbol in DIMENSIONS.values():
        assert UNITS[symbol].factor == 1.0
        assert UNITS[symbol].exponent == 0


def test_no_spelling_means_two_things_of_one_dimension():
    for dimension in DIMENSIONS:
        units = [unit for unit in UNITS.values() if unit.dimension == dimension]
        names = [name for unit in units for name in (unit.symbol, *unit.spellings)]
        assert len(names) == len(set(names))


@pytest.mark.parametrize("symbol", sorted({row.unit for row in CATALOGUE} | {key.unit for key in machine_file_keys()}))
def test_units_of_catalogue_and_files_exist(symbol):
    if symbol:
        assert check_unit(symbol).symbol == symbol


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (0.1043, 0.0008, "ohm", "0.1043 +- 0.0008 ohm"),
        (0.000382, 4e-6, "H", "0.382 +- 0.004 mH"),
        (0.000441, 31e-6, "H", "0.441 +- 0.031 mH"),
        (1234.5, 56.0, "rpm", "1230 +- 60 rpm"),
        (0.41, 0.000354, "Wb", "0.41000 +- 0.00035 Wb"),
        (0.41, 0.000356, "Wb", "0.4100 +- 0.0004 Wb"),
        (0.41, 0.00097, "Wb", "0.4100 +- 0.0010 Wb"),
        (3.0, 0.0, "1", "3 (exact)"),
        (5.0, math.nan, "V", "5 V (deviation unknown)"),
        (0.0, 0.01, "rad", "0 +- 10 mrad"),
        (0.0, 4e-6, "s", "0 +- 4 us"),
        (2e-8, 4e-6, "s", "0 +- 4 us"),
        (-1e-4, 1.6e-3, "rad", "-0.1 +- 1.6 mrad"),
    ],
)
def test_estimates_show_what_is_known(value, std, unit, text):
    assert format_estimate(value, std, unit) == text


@given(st.floats(1e-9, 1e9), st.floats(-6, 1))
def test_rounding_costs_less_than_a_sixth_of_the_deviation(value, exponent):
    std = value * 10.0**exponent
    shown, deviation = format_estimate(value, std, "1").split(" +- ")
    assert abs(float(shown) - value) <= 0.51 * std
    assert float(deviation) == pytest.approx(std, rel=0.16)


def test_quantities_take_a_customary_prefix():
    assert format_quantity(0.0023, "H") == "2.3 mH"
    assert format_quantity(12000.0, "Hz") == "12 kHz"
    assert format_quantity(0.137, "ohm") == "0.137 ohm"
    assert format_quantity(0.577, "1") == "0.577"


@pytest.mark.parametrize(
    "text", ["832gcm2", "832 g cm2", "832gcm^2", "832 g\u00b7cm\u00b2", "832 g*cm^2", "8.32e-5kgm^2"]
)
def test_products_and_powers_are_written_in_many_ways(text):
    assert parse_quantity(text, "inertia") == pytest.approx(8.32e-5, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "dimension", "asked"),
    [
        ("0.279mh", "inductance", "did you mean mH?"),
        ("3480RPM", "angular speed", "did you mean rpm?"),
        ("800hz", "frequency", "did you mean Hz?"),
        ("832gm2", "inertia", "did you mean"),
        ("5banana", "voltage", ""),
    ],
)
def test_an_unknown_unit_is_asked_back(text, dimension, asked):
    with pytest.raises(ConfigError) as caught:
        parse_quantity(text, dimension)
    assert caught.value.likely.startswith(asked) and bool(caught.value.likely) == bool(asked)


@pytest.mark.parametrize(
    ("key", "unit"),
    [
        ("generation_rpm", "rpm"), ("closed_drive_slope_nm_per_s", "N m/s"), ("mtpva_i_d_a", "A"),
        ("voltage_overshoot_per_rpm_per_s", "1/(rpm/s)"), ("ramp_that_spends_the_reserve_rpm_per_s", "rpm/s"),
        ("axis_stiffness_nm_per_rads", "N m/(rad s)"), ("axis_K_v_per_s", "1/s"), ("closed_drive_rise_s", "s"),
        ("sag_torque_share_n_max", "1"), ("rpm", "1"),
    ],
)  # fmt: skip
def test_a_key_ends_in_its_unit(key: str, unit: str) -> None:
    assert unit_of_key(key) == unit


def test_the_units_of_keys_agree_with_the_catalogue() -> None:
    """But for a current that the key marks as peak, and a number of periods."""
    wrong = {p.name: (p.unit, unit_of_key(p.name)) for p in CATALOGUE if unit_of_key(p.name) not in ("1", p.unit)}
    assert {name: pair for name, pair in wrong.items() if pair not in (("A", "A peak"), ("1", "control periods"))} == {}
