# SPDX-License-Identifier: MIT
"""``report --follow``: the page of a run while it goes on, of the newest run where a folder is followed."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest

from pmsmtool.cli.main import run as program
from pmsmtool.cli.report import NICENESS, RELOAD
from pmsmtool.commissioning.design_stages import lut_stage
from pmsmtool.design.lookup.design import LookupRequest
from pmsmtool.files import data_folder
from pmsmtool.run_directory import RECORD, RunDirectory, new_record

pytestmark = [pytest.mark.wall_clock, pytest.mark.chain]
WAIT_S = 40.0
"""A page is there within 3 s of its run's files on two idle cores; a busy computer needs longer."""


def a_run(folder: Path, serial: int) -> RunDirectory:
    drive = {"name": f"drive {serial}", "serial": serial}
    return RunDirectory.create(
        folder, serial, new_record(["commission"], drive=drive, bus={}, versions={}, operator="A")
    )


@contextlib.contextmanager
def following(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    command = [sys.executable, "-m", "pmsmtool", "report", "--follow", str(folder), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, json.loads(process.stdout.readline())["url"]
        finally:
            process.kill()


def page_with(url: str, text: str) -> str:
    """Return the page when it shows a text, or at last without it."""
    latest = time.monotonic() + WAIT_S
    while True:
        with urlopen(url, timeout=WAIT_S) as answer:
            page = str(answer.read().decode())
            policy = answer.headers["Content-Security-Policy"]
        if text in page or time.monotonic() > latest:
            assert text in page
            assert policy.count("'sha256-") == len(re.findall("<script>", page))
            return page
        time.sleep(0.05)


def drawing_of(page: str) -> int:
    (number,) = re.findall(re.escape(RELOAD.split("{}")[0]) + r"(\d+);", page)
    return int(number)


def test_the_page_follows_the_newest_run_as_its_files_come(tmp_path: Path) -> None:
    with following(tmp_path) as (process, url):
        assert drawing_of(page_with(url, "no run yet")) == 0
        a_run(tmp_path, 1)
        first = drawing_of(page_with(url, "drive 1"))
        with urlopen(f"{url}samples", timeout=WAIT_S) as stream:
            lines = (line.decode().strip() for line in stream)
            assert first == 1 and "data: [[1]]" in lines
            second = a_run(tmp_path, 2)
            newer = drawing_of(page_with(url, "drive 2"))
            assert newer > first and f"data: [[{newer}]]" in lines, "an open page hears of the later one"
        shutil.copy(data_folder("profiles") / "interior-2k2.toml", second.path / "machine.toml")
        design = program(["tune", "interior-2k2", "-o", str(second.path / "design.toml"), "-q"])
        assert design == 0
        second.add(lut_stage(second, LookupRequest(torque_points=9, y_points=9)))
        assert drawing_of(page_with(url, "torque error between nodes")) > newer
        (second.path / RECORD).write_text("{")
        page_with(url, "run.json")
        if sys.platform != "win32":
            process.send_signal(signal.SIGINT)
            assert process.wait(WAIT_S) == 0


def test_a_run_is_followed_for_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, given = a_run(tmp_path, 3), []
    monkeypatch.setattr(os, "nice", given.append, raising=False)  # in this process every test after it would be slow
    assert program(["report", "--follow", str(run.path), "--for", "0.1s"]) == 0
    assert given == [NICENESS], "what it follows goes first"
    assert capsys.readouterr().out.startswith("http://127.0.0.1:")
    assert program(["report", "--follow", str(tmp_path / "none")]) == 2
    assert "there is no such folder" in capsys.readouterr().err
    assert program(["report", "--follow", "--pdf", str(run.path)]) == 2
    assert "exclude each other" in capsys.readouterr().err
    for wrong in (["--for", "1s"], ["--port", "8000"], ["--follow", "-o", "x.html"]):
        assert program(["report", str(run.path), *wrong]) == 2, wrong
        assert "belong to --follow" in capsys.readouterr().err
