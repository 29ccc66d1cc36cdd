# SPDX-License-Identifier: MIT
"""Every bad TOML file ends in one clear error, whatever the parser beneath makes of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pmsmtool.errors import ConfigError
from pmsmtool.toml_file import parse_toml, read_toml, written_value


def test_tables_are_returned(tmp_path: Path) -> None:
    path = tmp_path / "good.toml"
    path.write_text("a = 1\n[b]\nc = [1.5, -9223372036854775808]\n", encoding="utf-8")
    assert read_toml(path) == {"a": 1, "b": {"c": [1.5, -(1 << 63)]}}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = ", "the file is not TOML"),
        ("a = " + "9" * 5000, "is not TOML"),
        ("a = " + "[" * 100_000, "is not TOML"),
        ("[t]\na = 9223372036854775808", "f.toml:t.a: is a whole number beyond the 64 bit"),
        ("[[t]]\na = [1, -" + "9" * 400 + "]", "f.toml:t.a: is a whole number beyond"),
    ],
)
def test_bad_text_is_one_error(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_toml(text, where="f.toml")
    assert said in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_toml(tmp_path / "missing.toml")
    path = tmp_path / "latin.toml"
    path.write_bytes(b"a = '\xff'")
    with pytest.raises(ConfigError, match="cannot be read as text"):
        read_toml(path)


def test_the_mark_of_windows_editors_is_no_mistake(tmp_path: Path) -> None:
    path = tmp_path / "marked.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1\n")
    assert read_toml(path) == {"a": 1}


def test_a_value_of_the_command_line_is_read_as_toml_and_else_as_text() -> None:
    assert [written_value(text) for text in ("true", "1e3", "a", "[1, 2]", "0.5 ")] == [True, 1e3, "a", [1, 2], 0.5]
