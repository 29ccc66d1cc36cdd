# SPDX-License-Identifier: MIT
"""A call that may hang in a driver, given up after a while."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

Result = TypeVar("Result")


def in_time(
    work: Callable[[], Result], limit_s: float, *, too_late: Callable[[Result], object] = lambda result: None
) -> Result:
    """Return what the work returns, or raise what it raises; it runs in a thread of its own.

    Parameters
    ----------
    limit_s : float
        Seconds that are waited for it.
    too_late : callable
        Takes a result that came after all.

    Raises
    ------
    TimeoutError
        It has not ended by then; the thread is left to itself and does not keep the program from ending.
    """
    done: list[Result] = []
    failed: list[BaseException] = []
    given_up = threading.Event()

    def run() -> None:
        try:
            done.append(work())
            if given_up.is_set():
                too_late(done[0])
        except BaseException as error:
            failed.append(error)

    worker = threading.Thread(target=run, name="pmsmtool bounded call", daemon=True)
    try:
        worker.start()
        worker.join(limit_s)
    finally:
        given_up.set()
    if failed:
        raise failed[0]
    if not done:
        raise TimeoutError(f"no answer within {limit_s:g} s")
    return done[0]
