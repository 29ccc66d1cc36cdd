# SPDX-License-Identifier: MIT
"""What the recorder of a drive can be told to record, as its map says it: the table ``[recorder]``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

Recording = Literal["none", "domain", "index", "rows", "rings"]
"""How a recorder is set up and read, by what its data are: ``domain``, one upload with a CRC-32 (the reference drive);
``index``, blocks out of one register (Ingenia's monitor); ``rows``, numbered trace variables, a row of them per sample
(Copley); ``rings``, a ring of words per variable (maxon EPOS2)."""

Address = tuple[int, int, str]
"""Index, sub-index and ``struct`` letter of an object."""


@dataclass(frozen=True, slots=True)
class Channel:
    """A signal that a recorder can take.

    Attributes
    ----------
    unit : str
        What one recorded count is worth (``drive_maps/wire_units.py``).
    number : int
        Number of the trace variable; 0 where the recorder takes objects.
    index, sub, wire : int, int, str
        The object and its CiA 301 type; empty where the recorder takes numbers.
    source : str
        Key of ``DriveMap.sources``.
    """

    unit: str
    number: int = 0
    index: int = 0
    sub: int = 0
    wire: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class RecorderMap:
    """The table ``[recorder]``.

    Attributes
    ----------
    channels : mapping of str to Channel
        By the names of ``drive_map.SIGNALS``.
    period : str
        What one count of the recorder's period is worth, where the drive itself does not say it; empty: not known.
    period_source : str
        Key of ``DriveMap.sources``.
    """

    channels: Mapping[str, Channel] = field(default_factory=dict)
    period: str = ""
    period_source: str = ""
