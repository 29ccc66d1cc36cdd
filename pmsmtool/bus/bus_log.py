# SPDX-License-Identifier: MIT
"""A recorded bus, frame by frame: candump, Vector ASC and what else python-can reads.

A line of a text file that is no frame is left out and counted; a binary file ends at its first damaged frame. What was
read until then is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pmsmtool.errors import ConfigError

TEXT = {".log": "CanutilsLogReader", ".asc": "ASCReader", ".trc": "TRCReader"}
"""Text formats by suffix (candump -L, Vector, PEAK), and python-can's readers of them."""
BINARY = (".blf", ".mf4")
MF4_EXTRA = "reading .mf4 needs asammdf: pip install 'pmsmtool[mf4]'"
MOST_WRONG = 10_000
"""Lines that are no frame, after which a file is no log."""


@dataclass(frozen=True, slots=True)
class LogFrame:
    """One data frame with an 11-bit identifier: time since the first frame (s), identifier, data."""

    t_s: float
    cob_id: int
    data: bytes


class BusLog:
    """The frames of a file. Raises ConfigError: another suffix, or a file that cannot be opened.

    Parameters
    ----------
    path : Path
        Its suffix says the format.

    Attributes
    ----------
    left_out : int
        Lines that are no frame, known after :meth:`frames`.
    first_wrong : str
        Why the first of them is none.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.left_out, self.first_wrong = path, 0, ""
        if path.suffix.lower() not in (*TEXT, *BINARY):
            raise ConfigError(
                f"{path.suffix or 'a name without suffix'} is no format of a bus log", where=str(path),
                hint=f"name it by its format: {', '.join((*TEXT, *BINARY))} (candump -L writes .log)",
            )  # fmt: skip
        try:
            with path.open("rb"):
                pass
        except OSError as error:
            raise ConfigError(
                f"the log cannot be read: {error.strerror or error}",
                where=str(path),
                hint="give a file that you may read",
            ) from error

    def frames(self) -> Iterator[LogFrame]:
        """Yield the data frames with an 11-bit identifier, in their order."""
        start_s: float | None = None
        for message in self._messages():
            if message.is_error_frame or message.is_remote_frame or message.is_extended_id:
                continue
            start_s = message.timestamp if start_s is None else start_s
            yield LogFrame(message.timestamp - start_s, message.arbitration_id, bytes(message.data))

    def _messages(self) -> Iterator[Any]:
        import can

        suffix = self.path.suffix.lower()
        if suffix in BINARY:
            try:
                with can.LogReader(str(self.path)) as reader:
                    yield from reader
            except NotImplementedError as error:
                raise ConfigError("this format is not installed", where=str(self.path), hint=MF4_EXTRA) from error
            except Exception as error:  # python-can's readers raise what their parsing meets
                self._note(error)
            return
        with self.path.open(encoding="utf-8", errors="replace") as file:
            reader = getattr(can, TEXT[suffix])(file)
            while self.left_out < MOST_WRONG:
                try:
                    yield from reader  # a wrong line ends the generator; the next one goes on behind it
                    return
                except Exception as error:
                    self._note(error)

    def _note(self, error: Exception) -> None:
        self.left_out += 1
        self.first_wrong = self.first_wrong or f"{type(error).__name__}: {error}"
