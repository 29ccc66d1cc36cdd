# SPDX-License-Identifier: MIT
"""A simulated drive as it leaves the factory: its non-volatile memory erased before the bus is opened."""

from __future__ import annotations

from pathlib import Path

from pmsmtool.errors import ConfigError
from pmsmtool.machine.profile import machine_path
from pmsmtool.sim.channel import MEMORY_FOLDER, parse_channel


def erase_memory(channel: str | None) -> list[Path]:
    """Erase the memory files of the simulated drives of a channel, unless the channel names its own (``nv=``).

    Parameters
    ----------
    channel : str or None
        Channel string of ``pmsmsim``; None is the default profile.

    Returns
    -------
    list of Path
        What was erased.

    Raises
    ------
    ConfigError
        The channel cannot be used, or a file cannot be erased.
    """
    wanted = parse_channel(channel)
    if wanted.nv is not None:
        return []
    stem = machine_path(wanted.name).stem
    names = [stem, *(f"{stem}-{position}" for position in range(2, wanted.nodes + 1))]
    found = [path for name in names if (path := MEMORY_FOLDER / f"{name}.nv").exists()]
    for path in found:
        try:
            path.unlink()
        except OSError as error:
            raise ConfigError(
                f"cannot be erased: {error.strerror}",
                where=str(path),
                hint="check your rights there, and end a simulated drive that still uses it",
            ) from error
    return found
