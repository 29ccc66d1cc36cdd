# SPDX-License-Identifier: MIT
"""What holds for every test."""

from __future__ import annotations

import ast
import compileall
import contextlib
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from _pytest.pathlib import import_path
from _pytest.runner import runtestprotocol

# As the program does, before anything imports numpy. With a thread per processor in every worker, the threads spin for
# each other: an identification took 12 s of processor time instead of 1.6.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Tests start some hundred programs; without stored bytecode each compiles the package again, for a second.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

from pmsmtool.bus.clock import PutOff
from tests import wall_clock

# And every worker compiles all tests, for 8 s.
sys.dont_write_bytecode = False

# What a disk holds after a power cut no test sees; a sync takes 4 ms, and 3 ms more when its file is removed.
# ``tests/test_files.py`` asks for the syncs themselves.
os.fsync = lambda descriptor: None

# A background job of a shell without job control ignores SIGINT and hands that on to its children; tests of Ctrl-C
# would wait for ever. A handler of ours is back to the default in children.
if signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, signal.default_int_handler):
    signal.signal(signal.SIGINT, PutOff(signal.default_int_handler))  # as the program does

# Before 3.11.8 two threads must not parse at once (python/cpython#106905: SystemError "AST constructor recursion depth
# mismatch"): pytest does for the source of a failure, and `traceback` for what a server's thread logs meanwhile. The
# whole worker died of it.
_parse, _one_parser = ast.parse, threading.RLock()


def _parse_alone(*args: Any, **kwargs: Any) -> Any:
    with _one_parser:
        return _parse(*args, **kwargs)


ast.parse = _parse_alone


@pytest.fixture(scope="session", autouse=True)
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test writes into the home of whoever runs it, who may have none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PMSMTOOL_HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the figures of a report with all their data, but not their SVG text, for chains whose test is not of it.

    What a page draws is tested in ``tests/report``, ``tests/cli/test_report.py`` and by the README's first session.
    """
    monkeypatch.setattr("pmsmtool.report.figures.svg", lambda canvas: '<svg xmlns="http://www.w3.org/2000/svg"/>')


def _compile_a_share(session: pytest.Session) -> None:
    """Begin with another share in every worker: in a new clone each compiled every test and module, for 12 s."""
    worker = getattr(session.config, "workerinput", None)
    if worker is None or session.config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    root, first, step = session.config.rootpath, int(worker["workerid"].removeprefix("gw")), worker["workercount"]
    for path in sorted(Path(root, "pmsmtool").rglob("*.py"))[first::step]:
        compileall.compile_file(path, quiet=2)
    for path in sorted(Path(root, "tests").rglob("test_*.py"))[first::step]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # an error is told when it is collected
            import_path(path, mode="importlib", root=root, consider_namespace_packages=False)


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    """Import and collect without a search for garbage, since all of it stays: the searches took a third of the time."""
    gc.disable()
    try:
        _compile_a_share(session)
        return (yield)
    finally:
        gc.enable()


def pytest_collection_finish() -> None:
    """Leave what was imported and collected out of every later search for garbage: it took a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)  # every 700 objects, as by default, cost a tenth of a test's time


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Hand every worker a run of neighbours, which share what their modules make once, and let an idle one steal."""
    if config.getoption("dist") != "load":
        return None  # somebody asked for another way
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Repeat a failed test of the wall clock where the computer stood still."""
    if item.get_closest_marker("wall_clock") is None:
        return None
    wall_clock.watch()
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    begun = time.monotonic()
    for _ in range(wall_clock.TRIES):
        wall_clock.STALLS.clear()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        hung = time.monotonic() - begun > wall_clock.LONGEST_S
        if hung or not any(report.failed for report in reports) or not wall_clock.STALLS:
            break
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True
