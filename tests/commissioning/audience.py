# SPDX-License-Identifier: MIT
"""Who a chain talks to in tests: a person who agrees, and a progress that shows nothing."""

from __future__ import annotations

from collections.abc import Sequence

from pmsmtool.run_directory import Stage


class Told:
    """A person who agrees, and notes what was shown."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def allow_motion(self, lines: Sequence[str]) -> None:
        pass

    def allow_writing(self, lines: Sequence[str]) -> None:
        self.shown += lines


class Quiet:
    """A progress that notes how the stages ended."""

    def __init__(self) -> None:
        self.ended: dict[str, str] = {}

    def skip(self, stage: Stage, number: int, count: int) -> None:
        pass

    def begin(self, name: str, number: int, count: int) -> None:
        pass

    def say(self, text: str) -> None:
        pass

    def end(self, stage: Stage, number: int, count: int) -> None:
        self.ended[stage.name] = stage.status
