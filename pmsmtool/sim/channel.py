# SPDX-License-Identifier: MIT
"""Channel strings of the simulated bus: ``NAME[?key=value&...]``, and the line they describe.

NAME is a profile (``pmsmtool sim list``) or the path of a machine file. Keys:

========== =============================================================================================
``seed``   seed of noise and faults; default: ``[simulation] seed`` of the machine file
``nv``     file of the non-volatile memory, or ``:memory:``; default ``./.pmsmsim/<profile>.nv``
``faults`` file of faults on purpose (``sim/faults.py``)
``bitrate`` bit rate (bit/s) for bit-exact frame times; default: nominal times at 1 Mbit/s
``node``   node id of the first drive, outranks one stored by LSS; default 1; 255: unconfigured
``nodes``  number of drives on the line, with consecutive node ids and serial numbers; default 1
``drive``  family whose object dictionary the drive shows (``firmware-params``), or the path of a map file; default:
           the reference drive's own
``eds``    EDS or DCF of a maker's drive, or ``TABLE.csv#FAMILY``: the drive has those objects and no others
``gains``  seed that draws what the gains of a drive made by ``eds`` mean; default: they mean nothing
``level``  capability level, ``inject`` or ``recorder``: the reference drive without its averages, or without its
           excitation, too; ``tier`` is the older name of this key
``filter`` time constant (s) of a set-point filter behind the torque slope; default: none
``jitter`` how late (s) a process data object is sent at most; default: not late
``terminator`` ``missing``: every frame of the line is damaged, at any bit rate
``speed``  how fast idle time passes at most, as a multiple of the wall clock; default: at once
========== =============================================================================================

Any key of ``[simulation]`` may stand here, too (``leads_swapped=true``), and outranks that of the machine file.

A simulated drive as it leaves the factory: its non-volatile memory erased before the bus is opened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl

from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import load_family
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_text
from pmsmtool.machine.machine_file import machine_path
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
from pmsmtool.sim.faults import load_faults
from pmsmtool.sim.line import Line
from pmsmtool.sim.node.dictionary import DriveFace
from pmsmtool.sim.node.factory import drive_settings
from pmsmtool.sim.node.family import LEVEL_HIDES, Face, Reduced
from pmsmtool.sim.node.lss import UNCONFIGURED
from pmsmtool.sim.node.memory import FileStorage, Memory, RamStorage
from pmsmtool.sim.node.node import Node
from pmsmtool.toml_file import written_value

if TYPE_CHECKING:
    from pmsmtool.drive_maps.drive_map import DriveMap
    from pmsmtool.machine.machine_file import MachineFile
    from pmsmtool.sim.node.drive_core import DriveCore

NEXT_STEP = "a channel is PROFILE?key=value&key=value; `pmsmtool sim list` names the profiles"

DEFAULT_PROFILE = "interior-2k2"
"""Profile of a channel without a name."""
OWN_FAMILY = "pmsmsim"
"""The reference drive by its family's name: no other face."""
DEFAULT_NODE_ID = 1
LARGEST_NODE_ID = 127
MEMORY_FOLDER = Path(".pmsmsim")
VOLATILE = ":memory:"
TERMINATORS = ("fitted", "missing")
_RATES = range(10_000, 1_000_001)


@dataclass(frozen=True, slots=True)
class Channel:
    """A parsed channel string; ``name`` is a profile or a path."""

    name: str = DEFAULT_PROFILE
    seed: int | None = None
    nv: str | None = None
    faults: Path | None = None
    bitrate: int | None = None
    node: int | None = None
    nodes: int = 1
    speed: float | None = None
    drive: str | None = None
    eds: str | None = None
    gains: int | None = None
    level: str | None = None
    filter: float = 0.0
    jitter: float = 0.0
    terminator: str = "fitted"
    simulation: Mapping[str, Any] = field(default_factory=dict)


def _whole(low: int, high: int) -> Callable[[str], int]:
    def convert(text: str) -> int:
        value = int(text, 0)
        if not low <= value <= high:
            raise ValueError(f"must be within {low} .. {high}")
        return value

    return convert


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e6:
        raise ValueError("must be a positive number")
    return value


def _short_time(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise ValueError("must be a time below 1 s")
    return value


def _level(text: str) -> str:
    if text not in LEVEL_HIDES:
        raise ValueError(f"must be one of {', '.join(LEVEL_HIDES)}")
    return text


def _terminator(text: str) -> str:
    if text not in TERMINATORS:
        raise ValueError(f"must be one of {', '.join(TERMINATORS)}")
    return text


_KEYS: dict[str, Callable[[str], Any]] = {
    "seed": _whole(0, 2**63 - 1),
    "nv": str,
    "faults": Path,
    "bitrate": _whole(_RATES.start, _RATES.stop - 1),
    "node": _whole(1, 255),
    "nodes": _whole(1, 127),
    "speed": _positive,
    "drive": str,
    "eds": str,
    "gains": _whole(0, 2**63 - 1),
    "level": _level,
    "filter": _short_time,
    "jitter": _short_time,
    "terminator": _terminator,
}


_SIMULATION = frozenset(key.name for key in SIMULATION_KEYS)
_OLDER = {"tier": "level"}
"""Older names of keys, which scripts may still use."""


@next_step(NEXT_STEP)
def parse_channel(text: str | None) -> Channel:
    """Return the channel a string describes; None is the default profile.

    Raises ConfigError: everything that is wrong with the string.
    """
    name, begun, query = (text or "").partition("?")
    values: dict[str, Any] = {}
    changes: dict[str, Any] = {}
    violations = []
    if not begun and "=" in name:
        violations.append("a ? is missing: it stands between the name and the first key")
    for typed, value in parse_qsl(query, keep_blank_values=True):
        key = _OLDER.get(typed, typed)
        if key not in _KEYS and key in _SIMULATION:
            changes[key] = written_value(value)
            continue
        if key not in _KEYS:
            near = get_close_matches(key, [*_KEYS, *_SIMULATION], 1)
            violations.append(f"{key}: unknown key" + (f", did you mean {near[0]}?" if near else ""))
            continue
        try:
            values[key] = _KEYS[key](value)
        except ValueError as error:
            violations.append(f"{key} = {value!r}: {error}")
    if violations:
        raise ConfigError(
            "the channel of the simulated bus cannot be used",
            where=f"channel {text!r}",
            hint=f"NAME[?key=value&...] with {', '.join(_KEYS)}, or a key of `pmsmtool help simulation`",
            violations=violations,
        )
    return Channel(name=name or DEFAULT_PROFILE, simulation=changes, **values)


def _memory_file(channel: Channel, position: int) -> Path:
    """Return the file of a drive's memory; another maker's face on a machine has one of its own."""
    name = machine_path(channel.name).stem
    other = channel.drive if channel.eds is None else channel.eds.replace("#", "-").replace("/", "-")
    if other not in (None, OWN_FAMILY):
        name = f"{name}-{Path(str(other)).stem}"
    path = MEMORY_FOLDER / f"{name}.nv" if channel.nv is None else Path(channel.nv)
    return path if position == 0 else path.with_name(f"{path.stem}-{position + 1}{path.suffix}")


def _face(channel: Channel, machine_file: MachineFile) -> DriveFace | None:
    """Return what the channel's drives show instead of the reference drive's whole dictionary.

    Raises ConfigError: there is no such family or file, or a level of a family that is not the reference drive.
    """
    if channel.eds is not None:
        return _makers_drive(channel, machine_file)
    if channel.drive in (None, OWN_FAMILY):
        return None if channel.level is None else Reduced(channel.level)
    if channel.level is not None:
        raise ConfigError("level= is for the reference drive, not for another family", where=f"channel {channel.name}")
    return Face(_map(str(channel.drive)))


def _makers_drive(channel: Channel, machine_file: MachineFile) -> DriveFace:
    from pmsmtool.sim.foreign.behind import set_up_of
    from pmsmtool.sim.foreign.drawn_gains import draw_gains
    from pmsmtool.sim.foreign.drive import ForeignDrive
    from pmsmtool.sim.foreign.file_rows import read_makers_objects

    if channel.drive is not None or channel.level is not None:
        raise ConfigError("the channel names an EDS file and also a drive or a level", where=f"channel {channel.name}")
    objects, motor = read_makers_objects(str(channel.eds)), set_up_of(machine_file)
    return ForeignDrive(objects, motor, None if channel.gains is None else draw_gains(channel.gains, objects, motor))


def _map(drive: str) -> DriveMap:
    """Return a shipped family's map, or that of a file."""
    if not drive.endswith(".toml"):
        return load_family(drive)
    return parse_drive_map(read_text(Path(drive)), drive)


CoreMaker = Callable[["MachineFile", int], "DriveCore"]


def _kernel(machine_file: MachineFile, seed: int) -> DriveCore:
    from pmsmtool.sim.drive_kernel import create

    return create(machine_file, seed)


def simulated_machine_file(channel: Channel) -> MachineFile:
    """Return the machine of a channel; without [simulation] (by hand, by identify) with what `machine new` assumes."""
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.machine.simulation_keys import simulation_of
    from pmsmtool.sim.simulated_machine import with_simulation

    found = load_machine_file(machine_path(channel.name))
    if not found.simulation:
        found = replace(found, simulation=simulation_of(found.machine, found.encoder.bits)[0])
    return with_simulation(found, channel.simulation)


@next_step(NEXT_STEP)
def build_line(
    channel: Channel, *, bitrate: int | None = None, instant: bool = False, make_core: CoreMaker = _kernel
) -> Line:
    """Return a line with the drives of a channel.

    Raises ConfigError: the machine file, the faults file or the memory cannot be used, or there are not so many node
    ids.

    Parameters
    ----------
    channel : Channel
        What is wanted.
    bitrate : int, optional
        Bit rate where the channel names none.
    instant : bool
        Frames take no time while there is no bit rate.
    make_core : callable
        Makes the application with its machine: ``(machine file, seed)``.
    """
    first = DEFAULT_NODE_ID if channel.node is None else channel.node
    if first != UNCONFIGURED and first + channel.nodes - 1 > LARGEST_NODE_ID:
        raise ConfigError(
            f"node ids {first} .. {first + channel.nodes - 1} exceed {LARGEST_NODE_ID}", where=f"channel {channel.name}"
        )
    path = machine_path(channel.name)
    machine_file = simulated_machine_file(channel)
    face = _face(channel, machine_file)
    plan = None if channel.faults is None else load_faults(channel.faults)
    seed = int(machine_file.simulation.get("seed", 0)) if channel.seed is None else channel.seed  # type: ignore[arg-type]
    line = Line(channel.bitrate or bitrate, plan, seed=seed, instant=instant)
    fixed = channel.node not in (None, UNCONFIGURED)
    for position in range(channel.nodes):
        node_id = first if first == UNCONFIGURED else first + position
        settings = drive_settings(machine_file, path.stem, node_id, position, fixed_node_id=fixed, face=face)
        settings = replace(
            settings, set_point_filter_s=channel.filter, pdo_jitter_s=channel.jitter, seed=seed + position
        )
        storage = RamStorage() if channel.nv == VOLATILE else FileStorage(_memory_file(channel, position))
        line.add_node(Node(line, make_core(machine_file, seed + position), Memory(storage), settings))
    line.arm_faults()
    return line


def erase_memory(channel: str | None) -> list[Path]:
    """Erase the memory files of the simulated drives of a channel, unless the channel names its own (``nv=``).

    Raises ConfigError: the channel cannot be used, or a file cannot be erased.

    Parameters
    ----------
    channel : str or None
        Channel string of ``pmsmsim``; None is the default profile.

    Returns
    -------
    list of Path
        What was erased.
    """
    wanted = parse_channel(channel)
    if wanted.nv is not None:
        return []
    found = [path for position in range(wanted.nodes) if (path := _memory_file(wanted, position)).exists()]
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
