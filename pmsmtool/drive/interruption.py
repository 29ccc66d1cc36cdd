# SPDX-License-Identifier: MIT
"""Ctrl-C that waits: work that must not be left half done is finished first, within a time that is said."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK") if hasattr(signal, name))
LONGEST_S = 60.0
"""After this a Ctrl-C acts again, whatever hangs; a store takes 20 s at most, reading a set again 2 s at 500 kbit/s."""


@contextmanager
def interrupts_deferred(say: Callable[[str], None] | None = None, work: str = "") -> Iterator[list[int]]:
    """Collect signals that would interrupt; yields the list they are noted in.

    Outside the main thread nothing is delivered anyway, and nothing is changed; ignored signals stay ignored.

    Parameters
    ----------
    say : callable, optional
        Told at every signal what is finished first, and within which time; from ``LONGEST_S`` on signals act again.
    work : str
        What is finished first.
    """
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return
    began = time.monotonic()
    previous: dict[int, Any] = {}

    def note(number: int, frame: FrameType | None) -> None:
        left = LONGEST_S - (time.monotonic() - began)
        if say is not None and left <= 0.0:
            handler = previous[number]
            if not callable(handler):
                raise KeyboardInterrupt
            handler(number, frame)
            return
        noted.append(number)
        if say is not None:
            with contextlib.suppress(RuntimeError):  # the signal came while this very stream was written
                say(f"interrupted: {work} is finished first, within {left:.0f} s; after that Ctrl-C ends it")

    try:
        for number in _SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.getsignal(number)
                signal.signal(number, note)
        yield noted
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
