# SPDX-License-Identifier: MIT
"""The two consents: who may answer them, and what happens where nobody can."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from pmsmtool.cli import consent
from pmsmtool.cli.options import MotionOptions
from pmsmtool.cli.output import Output
from pmsmtool.errors import Declined
from tests.cli.conftest import Tool

ROOT = Path(__file__).resolve().parents[2]


ENOUGH = MotionOptions(yes=True, i_max_apk=5.0, speed_max_rad_s=10.0, shaft="free", serial=77)


def answer(
    given: MotionOptions, monkeypatch: pytest.MonkeyPatch, *, simulated: bool = False, typed: str | None = None
) -> consent.Consent:
    """Ask for motion; ``typed`` None is no terminal, an empty text is Ctrl-D."""
    monkeypatch.setattr(consent, "person_present", lambda: typed is not None)
    results: list[consent.Consent] = []

    @click.command()
    def command() -> None:
        results.append(consent.ask_motion(["i_max 5 A"], given, simulated=simulated, serial=77, out=Output()))

    CliRunner().invoke(command, input=typed or "", catch_exceptions=False, standalone_mode=False)
    return results[0]


@pytest.mark.parametrize(
    ("given", "simulated", "typed", "how"),
    [
        (MotionOptions(), False, "y\n", "prompt"),
        (MotionOptions(yes=True), True, None, "--yes"),
        (ENOUGH, False, None, "--yes"),
        (MotionOptions(yes=True), False, "y\n", "prompt"),
    ],
)
def test_consent_given(
    given: MotionOptions, simulated: bool, typed: str | None, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = answer(given, monkeypatch, simulated=simulated, typed=typed)
    assert found == consent.Consent("motion", how, ("i_max 5 A",))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("given", "simulated", "typed"),
    [
        (MotionOptions(), False, None),
        (MotionOptions(), True, None),
        (MotionOptions(), False, "n\n"),
        (MotionOptions(), False, "\n"),
        (MotionOptions(), False, ""),
        (MotionOptions(yes=True), False, None),
        (MotionOptions(yes=True, i_max_apk=5.0, speed_max_rad_s=10.0, shaft="free"), False, None),
        (MotionOptions(yes=True, speed_max_rad_s=10.0, shaft="free", serial=77), False, None),
        (MotionOptions(yes=True, i_max_apk=5.0, speed_max_rad_s=10.0, shaft="free", serial=78), False, "y\n"),
        (MotionOptions(serial=78), False, "y\n"),
    ],
)
def test_consent_declined(
    given: MotionOptions, simulated: bool, typed: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(Declined) as caught:
        answer(given, monkeypatch, simulated=simulated, typed=typed)
    assert caught.value.exit_code == 7


def test_declined_message_names_what_yes_still_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Declined) as caught:
        answer(MotionOptions(yes=True, shaft="free"), monkeypatch)
    assert caught.value.hint == "run it in a terminal, or give --yes --i-max ... --speed-max ... --serial ..."
    only_serial = MotionOptions(yes=True, serial=77)
    assert consent.missing_for_yes(only_serial, "writing") == [] and len(consent.missing_for_yes(only_serial)) == 3


TRIES = 30
"""Seconds after which a prompt that takes no key is given up."""


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminal")
@pytest.mark.parametrize(("key", "code"), [(b"y\n", 0), (b"n\n", 7), (b"\x03", 7), (b"\x04", 7)])
def test_prompt_on_a_real_terminal(key: bytes, code: int) -> None:
    import pty

    program = """
import sys
from pmsmtool.cli import consent, main
from pmsmtool.cli.options import MotionOptions
from pmsmtool.cli.output import Output
try:
    consent.ask_writing(["R_s 1 2"], MotionOptions(), simulated=False, serial=1, out=Output())
except BaseException as error:
    sys.exit(main.report(error))
"""
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", program])
    seen = b""
    while b"[y/N]: " not in seen:  # the blank is the reader's own: it has taken the terminal
        seen += os.read(terminal, 1024)
    # A key that comes while the reader is still changing the terminal's mode can be lost: it is typed again.
    with contextlib.suppress(OSError):  # Linux: the other end closed
        for _ in range(TRIES):
            os.write(terminal, key)
            while select.select([terminal], [], [], 1.0)[0]:
                chunk = os.read(terminal, 1024)
                if not chunk:
                    break
                seen += chunk
    os.close(terminal)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == code
    assert b"R_s 1 2" in seen


def test_without_a_serial_number_only_a_person_consents(monkeypatch: pytest.MonkeyPatch) -> None:
    """--serial 0 matches what such a drive tells, and any other such drive, too."""
    monkeypatch.setattr(consent, "person_present", lambda: False)
    given = MotionOptions(yes=True, i_max_apk=5.0, speed_max_rad_s=10.0, shaft="free", serial=0)
    for ask, done in ((consent.ask_motion, "moved"), (consent.ask_writing, "written")):
        with pytest.raises(Declined, match=f"nothing was {done}") as caught:
            ask(["i_max 5 A"], given, simulated=False, serial=0, out=Output())
        assert "shows no serial number" in caught.value.hint
        assert ask(["i_max 5 A"], given, simulated=True, serial=0, out=Output()).answer == "--yes"


@pytest.mark.parametrize("ask", [consent.ask_motion, consent.ask_writing])
def test_only_a_simulated_drive_goes_without_its_lines_when_quiet(
    ask: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    quiet, given = Output(verbosity=-1), MotionOptions(yes=True)
    ask(["i_max 5 A"], given, simulated=True, serial=7, out=quiet)
    assert capsys.readouterr().err == ""
    ask(["i_max 5 A"], given, simulated=True, serial=7, out=Output())
    assert "i_max 5 A" in capsys.readouterr().err
    monkeypatch.setattr(consent, "person_present", lambda: False)
    with pytest.raises(Declined):
        ask(["i_max 5 A"], given, simulated=False, serial=7, out=quiet)
    assert "i_max 5 A" in capsys.readouterr().err


def test_nothing_moves_where_a_journal_could_not_be_kept(tool: Tool, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("home").write_text("", encoding="utf-8")  # a file in place of the folder
    monkeypatch.setenv("PMSMTOOL_HOME", "home")
    code, out, told = tool("jog", "--current", "1Apk", "--sim", "interior-2k2?nv=:memory:", "--yes")
    assert (code, out) == (2, "")
    assert "PMSMTOOL_HOME names another folder" in told and told.startswith("error:")  # before the envelope
