# SPDX-License-Identifier: MIT
"""Tests that live on the wall clock: a computer that stood still meanwhile has shown nothing, so they are repeated.

Only where a stall was seen, in this process or in a served drive: a test that fails on a computer that runs has failed.
"""

from __future__ import annotations

import threading
import time
from functools import cache
from typing import IO

from pmsmtool.sim.serve import PAUSED

TRIES = 3
LATE_S = 0.05
"""A sleep of ``NAP_S`` that takes this much longer is a stall: a heartbeat of the tool would have been left out."""
LONGEST_S = 60.0
"""No repetition after this: the limit of a test's time counts from its first try, and ends it once."""
NAP_S = 0.02
STALLS: list[str] = []
"""What was noticed; a test that begins empties it."""


@cache
def watch() -> None:
    """Note from now on when this process is not run."""
    threading.Thread(target=_watch, name="stalls of this process", daemon=True).start()


def _watch() -> None:
    before = time.monotonic()
    while True:
        time.sleep(NAP_S)
        now = time.monotonic()
        if now - before - NAP_S > LATE_S:
            STALLS.append(f"this process stood still for {now - before:.2f} s")
        before = now


def listen(said: IO[str]) -> None:
    """Note what a served drive says about its own stalls."""

    def read() -> None:
        with said:
            STALLS.extend(line for line in said if PAUSED in line)

    threading.Thread(target=read, name="stalls of a served drive", daemon=True).start()
