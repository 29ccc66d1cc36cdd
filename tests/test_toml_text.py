# SPDX-License-Identifier: MIT
"""The TOML writer: what it writes reads back, and the same tables give the same bytes."""

import tomllib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pmsmtool.toml_file import toml_lines, toml_text, toml_value

KEYS = st.text(min_size=1, max_size=8)
NUMBERS = st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False)
PLAIN = st.booleans() | NUMBERS | st.text(max_size=20)
VALUES = st.recursive(PLAIN, lambda inner: st.lists(inner, max_size=5), max_leaves=10)
TABLES = st.recursive(
    st.dictionaries(KEYS, VALUES, max_size=4), lambda inner: st.dictionaries(KEYS, VALUES | inner, max_size=4)
)


# a loaded computer makes too few tables a second for the check of the health
@pytest.mark.chain
@settings(suppress_health_check=[HealthCheck.too_slow], max_examples=60)
@given(TABLES)
def test_reads_back(tables):
    assert tomllib.loads(toml_text(tables)) == tables


@pytest.mark.chain
@given(st.lists(st.dictionaries(KEYS, PLAIN, min_size=1, max_size=3), min_size=1, max_size=3), PLAIN)
def test_arrays_of_tables_read_back(rows, value):
    tables = {"row": rows, "after": {"value": value}}
    assert tomllib.loads(toml_text(tables)) == tables


def test_keeps_types():
    back = tomllib.loads(toml_text({"whole": 1, "real": 1.0, "flag": True}))
    assert [type(back[name]) for name in ("whole", "real", "flag")] == [int, float, bool]


def test_layout():
    text = toml_text({"a": 1, "t": {"x": 0.1, "deep": {"y": "q"}}, "only": {"tables": {"z": 2}}}, comment="one\n\ntwo")
    assert text == ('# one\n#\n# two\n\na = 1\n\n[t]\nx = 0.1\n\n[t.deep]\ny = "q"\n\n[only.tables]\nz = 2\n')


def test_long_arrays_are_broken():
    text = toml_text({"values": [k / 7 for k in range(100)]})
    assert max(map(len, text.splitlines())) <= 120
    assert tomllib.loads(text)["values"] == [k / 7 for k in range(100)]


@pytest.mark.parametrize("value", [None, object(), {1, 2}, 1j])
def test_what_toml_cannot_hold_is_refused(value):
    with pytest.raises(TypeError):
        toml_value(value)


def test_lines_of_keys():
    text = 'a = 1\n# b = 2\n[t]\nx.y = 3\n  "q k" = 4 # z = 5\n[[u.v]]\nw = 6\n'
    assert toml_lines(text) == {
        ("a",): 1,
        ("t",): 3,
        ("t", "x", "y"): 4,
        ("t", "q k"): 5,
        ("u", "v"): 6,
        ("u", "v", "w"): 7,
    }
