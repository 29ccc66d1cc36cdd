# SPDX-License-Identifier: MIT
"""Trace files: exact round trips, deterministic bytes, one clear error each."""

import csv

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pmsmtool.errors import ConfigError
from pmsmtool.trace import Trace, read_trace, trace_csv, trace_npz, write_trace

NAMES = ("i_d_a", "u_q_v", "flags")
UNITS = {"i_d_a": "A", "u_q_v": "V", "flags": "1"}


def make_trace(samples=20, meta=None):
    t_s = np.arange(samples) / 12e3
    signals = {name: np.sin(37.0 * (k + 1) * t_s) / 3.0 for k, name in enumerate(NAMES)}
    return Trace(t_s, signals, UNITS, {"period_s": 1 / 12e3, "note": "Größe"} if meta is None else meta)


def assert_same(a, b):
    assert np.array_equal(a.t_s, b.t_s)
    assert list(a.signals) == list(b.signals)
    for name in a.signals:
        assert np.array_equal(a[name], b[name], equal_nan=True)
    assert dict(a.units) == dict(b.units)
    assert dict(a.meta) == dict(b.meta)


@pytest.mark.parametrize("suffix", ["npz", "csv"])
@pytest.mark.parametrize("meta", [None, {}])
def test_round_trip(tmp_path, suffix, meta):
    path = tmp_path / f"trace.{suffix}"
    trace = make_trace(meta=meta)
    write_trace(trace, path)
    assert_same(read_trace(path), trace)
    assert_same(type(trace).load(str(path)), trace)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]


@pytest.mark.chain
@settings(max_examples=50)
@given(
    arrays(np.float64, st.integers(1, 30), elements=st.floats(allow_nan=True, allow_infinity=True)),
    st.sampled_from(["npz", "csv"]),
)
def test_any_number_survives(tmp_path_factory, values, suffix):
    trace = Trace(np.linspace(0.0, 1.0, len(values)), {"i_d_a": values}, {"i_d_a": "A"})
    path = tmp_path_factory.mktemp("trace") / f"t.{suffix}"
    write_trace(trace, path)
    assert_same(read_trace(path), trace)


def test_some_rows_of_a_trace_are_those_of_all_its_signals(tmp_path):
    whole = make_trace()
    for which in (slice(3, 8), whole["i_d_a"] > 0.1):
        part = whole.rows(which)
        assert_same(part, Trace(whole.t_s[which], {n: whole[n][which] for n in NAMES}, UNITS, whole.meta))
    write_trace(whole, tmp_path / "trace.csv")
    with pytest.raises(ConfigError, match="i_q_a"):  # still says which file has no such signal
        read_trace(tmp_path / "trace.csv").rows(slice(2)).signals["i_q_a"]


def test_same_trace_same_bytes():
    assert trace_npz(make_trace()) == trace_npz(make_trace())
    assert trace_csv(make_trace()) == trace_csv(make_trace())


def test_second_row_holds_units(tmp_path):
    path = tmp_path / "t.csv"
    write_trace(make_trace(), path)
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["t_s", *NAMES]
    assert rows[1] == ["s", "A", "V", "1"]
    assert float(rows[2][0]) == 0.0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no trace"),
        ("t_s,i_d_a\n", "no trace"),
        ("t_s,i_d_a\ns\n0,1\n", "2 names"),
        ("t_s,t_s\ns,s\n0,1\n", "each once"),
        ("t_s,i_d_a\ns,A\n0,1\n1e-4\n", "1 values for 2 columns"),
        ("t_s,i_d_a\ns,A\n0,1\n1e-4,x\n", "not a number"),
        ("t_s,i_d_a\ns,A\n0,1\n0,2\n", "does not increase"),
        ("t_s,i_d_a\ns,A\nnan,1\n", "not finite"),
        ("t_s,i_d_a\ns,A\n", "empty"),
        ("t_s,i_d_a\ns,furlong\n0,1\n", "unknown unit"),
        ("t_s,i_d_a\ns,\n0,1\n", "no unit"),
        ("time,i_d_a\ns,A\n0,1\n", "no column t_s"),
        ('t_s,i_d_a\ns,A\n0,1\n# {"a": ', "not JSON"),
    ],
)
def test_a_bad_csv_says_why(tmp_path, text, says):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_trace(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def test_truncated_npz(tmp_path):
    path = tmp_path / "t.npz"
    path.write_bytes(trace_npz(make_trace())[:-40])
    with pytest.raises(ConfigError):
        read_trace(path)


def test_npz_of_something_else(tmp_path):
    path = tmp_path / "t.npz"
    np.savez(path, t_s=np.arange(3.0), i_d_a=np.zeros((3, 2)))
    with pytest.raises(ConfigError, match="not a vector"):
        read_trace(path)


@pytest.mark.parametrize("name", ["t.txt", "t"])
def test_other_suffixes_are_refused(tmp_path, name):
    with pytest.raises(ConfigError, match="no trace format"):
        write_trace(make_trace(), tmp_path / name)
    with pytest.raises(ConfigError, match="no trace format"):
        read_trace(tmp_path / name)


@pytest.mark.parametrize("suffix", ["npz", "csv"])
def test_missing_file_and_folder(tmp_path, suffix):
    with pytest.raises(ConfigError, match="no such file"):
        read_trace(tmp_path / f"none.{suffix}")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_trace(make_trace(), tmp_path / "none" / f"t.{suffix}")
