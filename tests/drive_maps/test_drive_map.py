# SPDX-License-Identifier: MIT
"""The drive map: bytes of every value, scaled integers, integral times, tables, map files."""

from __future__ import annotations

import math
import struct
from decimal import Decimal

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pmsmtool.drive_maps.drive_map import Cell, DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import dump_drive_map, parse_drive_map
from pmsmtool.drive_maps.map_tables import decode_table, encode_table, look_up_words, shortest_binary32
from pmsmtool.errors import ConfigError
from pmsmtool.firmware.image import lut_size_words, pack_image
from pmsmtool.params.catalogue import CATALOGUE
from pmsmtool.params.parameter_set import ParameterSet, default_set

SCALED = DriveMap(
    "scaled",
    0x1234,
    1,
    {
        "current.K_p_d_v_per_a": Cell("current.K_p_d_v_per_a", 0x30A0, 1, "UNSIGNED32", 1e-6, unit="uV/A"),
        "current.K_i_d_v_per_as": Cell(
            "current.K_i_d_v_per_as",
            0x320F,
            2,
            "UNSIGNED16",
            1e-6,
            gain="current.K_p_d_v_per_a",
            unit="us",
            form="time",
        ),
        "motor.I_max_apk": Cell(
            "motor.I_max_apk", 0x2031, 0, "UNSIGNED16", math.sqrt(2) / 1000, rounding="down", unit="mA rms"
        ),
        "motor.T_ref_c": Cell("motor.T_ref_c", 0x3001, 9, "INTEGER16", 0.1, -273.15, unit="0.1 degC"),
    },
)


def test_reference_map_is_the_catalogue() -> None:
    encoded = reference_map().encode(default_set())
    assert list(encoded) == [row.name for row in CATALOGUE]
    assert encoded["motor.R_s_ohm"] == struct.pack("<f", 0.137)
    assert encoded["motor.pole_pairs"] == b"\x04" and encoded["inverter.T_s_ns"] == struct.pack("<I", 83333)
    held = reference_map().quantised(default_set()).values
    assert held == {name: pytest.approx(value, rel=1e-7) for name, value in default_set().values.items()}
    assert reference_map().encode(ParameterSet(held)) == encoded


@pytest.mark.chain
@settings(max_examples=500, deadline=None)
@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
@example(999999995904.0)  # 1e12 is shorter, its repr is longer
def test_shortest_decimal_keeps_the_binary32(value: float) -> None:
    short = shortest_binary32(value)
    assert struct.pack("<f", short) == struct.pack("<f", value)
    digits = [len(Decimal(repr(number)).normalize().as_tuple().digits) for number in (short, value)]
    assert digits[0] <= min(digits[1], 9)


def test_scaled_integers_show_what_the_drive_holds() -> None:
    wanted = ParameterSet(
        {
            "current.K_p_d_v_per_a": 6.9000004,
            "current.K_i_d_v_per_as": 411.0,
            "motor.I_max_apk": 56.0,
            "motor.T_ref_c": 20.0,
        }
    )
    held = SCALED.quantised(wanted).values
    assert SCALED.encode(wanted)["current.K_p_d_v_per_a"] == struct.pack("<I", 6_900_000)
    assert held["current.K_p_d_v_per_a"] == pytest.approx(6.9, rel=1e-12)
    # T_n = K_p / K_i = 16.788 ms, kept in microseconds.
    assert SCALED.encode(wanted)["current.K_i_d_v_per_as"] == struct.pack("<H", 16788)
    assert held["current.K_i_d_v_per_as"] == pytest.approx(6.9 / 16788e-6, rel=1e-12)
    # 56 A peak are 39 597.98 mA rms; a limit is never rounded up.
    assert SCALED.encode(wanted)["motor.I_max_apk"] == struct.pack("<H", 39597)
    assert held["motor.T_ref_c"] == pytest.approx(19.95)


@settings(max_examples=200, deadline=None)
@given(st.floats(0.001, 90.0))
def test_encoding_what_was_decoded_changes_nothing(current: float) -> None:
    first = SCALED.encode(ParameterSet({"motor.I_max_apk": current, "motor.T_ref_c": current}))
    again = SCALED.encode(SCALED.decode(first))
    assert again["motor.T_ref_c"] == first["motor.T_ref_c"]
    assert (
        abs(int.from_bytes(again["motor.I_max_apk"], "little") - int.from_bytes(first["motor.I_max_apk"], "little"))
        <= 1
    )


def test_all_values_that_do_not_fit_are_listed() -> None:
    with pytest.raises(ConfigError) as caught:
        SCALED.encode(
            ParameterSet({"motor.I_max_apk": 1000.0, "current.K_p_d_v_per_a": 1e5, "current.K_i_d_v_per_as": 1.0})
        )
    text = str(caught.value)
    assert "3 values" in text and "0x2031:00" in text and "0x30A0:01" in text and "0x320F:02" in text


def test_integral_time_without_its_gain_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"1 value"):
        SCALED.encode(ParameterSet({"current.K_i_d_v_per_as": 411.0}))


@pytest.mark.parametrize("kind", [1, 2])
def test_tables_in_both_formats_and_in_the_image(kind: int) -> None:
    descriptor = {"lut.format": kind, "lut.n_x": 3, "lut.n_y": 2, "lut.n_z": 1, "lut.lsb_a": 0.01}
    tables = {
        "lut.axis_x": (0.0, 5.0, 10.0),
        "lut.axis_y": (100.0, 200.0),
        "lut.axis_z": (48.0,),
        "lut.i_d_a": (0.0, -1.25, -2.0, -3.0, -4.0, math.nan),
        "lut.i_q_a": (0.0, 1.0, 2.0, 3.0, 4.11, math.nan),
    }
    wanted = ParameterSet({**default_set().values, **descriptor}, tables)
    assert wanted.violations() == ()
    encoded = reference_map().encode(wanted)
    held = reference_map().quantised(wanted)
    assert held.tables["lut.i_q_a"][4] == pytest.approx(4.11) and math.isnan(held.tables["lut.i_d_a"][5])
    words = look_up_words(encoded)
    assert len(words) == 4 * lut_size_words(wanted.values)
    assert pack_image(wanted.values, words).endswith(words)


def test_table_that_does_not_fit_int16() -> None:
    with pytest.raises(ConfigError, match="does not fit"):
        encode_table("lut.i_d_a", (400.0,), {"lut.format": 2, "lut.lsb_a": 0.01})
    assert decode_table("lut.i_d_a", struct.pack("<h", -32768), {"lut.format": 2, "lut.lsb_a": 0.01})[0] != 0


def test_map_file_round_trip() -> None:
    for drive_map in (reference_map(), SCALED):
        assert parse_drive_map(dump_drive_map(drive_map)) == drive_map
