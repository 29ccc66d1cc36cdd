# SPDX-License-Identifier: MIT
"""The node's share of the bus clock: everything it planned is forgotten at a reset."""

from __future__ import annotations

from collections.abc import Callable

from pmsmtool.bus.clock import NS, Timer, VirtualClock


class Schedule:
    """Plans actions that run only while this schedule is open."""

    def __init__(self, clock: VirtualClock) -> None:
        self._clock = clock
        self._open = True

    @property
    def now_ns(self) -> int:
        """The present instant (ns)."""
        return self._clock.now_ns

    def at(self, instant_ns: int, action: Callable[[], None]) -> Timer:
        """Plan an action at an instant (ns)."""

        def run() -> None:
            if self._open:
                action()

        return self._clock.at(instant_ns, run)

    def after(self, seconds: float, action: Callable[[], None]) -> Timer:
        """Plan an action ``seconds`` from now."""
        return self.at(self._clock.now_ns + round(seconds * NS), action)

    def close(self) -> None:
        """Forget all that was planned."""
        self._open = False
