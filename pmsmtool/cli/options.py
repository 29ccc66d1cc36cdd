# SPDX-License-Identifier: MIT
"""Options that many commands share: the bus, the output, the motion envelope; and quantities with units.

The same options stand before the command and after it (``pmsmtool -n 5 scan`` and ``pmsmtool scan -n 5``). What
is typed after the command wins over what is typed before it, and both win over ``PMSMTOOL_INTERFACE`` and the like;
what is given nowhere is left to python-can's own configuration.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import click
from click.core import ParameterSource

from pmsmtool.cli.output import Output, set_up_logging
from pmsmtool.errors import ConfigError
from pmsmtool.units import parse_quantity

if TYPE_CHECKING:
    from pathlib import Path

    from pmsmtool.bus.connect import Connection

Function = Callable[..., Any]
Option = Callable[[Function], Function]

SIMULATED_INTERFACE = "pmsmsim"
VERBOSITY = "pmsmtool.verbosity"
"""Key of the context's shared ``meta``: how much is said, for whoever reports an error."""


class WholeNumber(click.ParamType[int]):
    """A decimal or hexadecimal (``0x``) number within bounds."""

    def __init__(self, name: str, lowest: int, highest: int) -> None:
        self.name = name
        self.lowest = lowest
        self.highest = highest

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or fail as a usage error."""
        try:
            number = value if isinstance(value, int) else int(str(value), 0)
        except ValueError:
            meant = re.fullmatch(r"(\d+) ?[kK].*", str(value))
            near = f"; did you mean {meant[1]}000?" if meant else ""
            self.fail(f"{value!r} is no whole number (decimal or 0x...){near}", param, ctx)
        if not self.lowest <= number <= self.highest:
            self.fail(f"{number} is outside {self.lowest}..{self.highest}", param, ctx)
        return number


class Quantity(click.ParamType[float]):
    """A value with its unit (``800Hz``, ``1200rpm``, ``12Apk``), converted to the dimension's SI unit.

    Parameters
    ----------
    dimension : str
        As ``units.UNITS`` names it.
    positive : bool
        Whether zero and less are refused: a limit of zero would be taken for none.
    bare : bool
        Whether the number may stand alone: the option's name ends in its unit.
    """

    def __init__(self, dimension: str, *, positive: bool = False, bare: bool = False) -> None:
        self.bare = bare
        self.name = dimension
        self.dimension = dimension
        self.positive = positive

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the SI value (A peak for a current), or fail as a usage error."""
        if isinstance(value, float):
            return value
        found = math.nan
        if self.bare:
            with contextlib.suppress(ValueError):
                found = float(value)
        try:
            found = found if math.isfinite(found) else parse_quantity(str(value), self.dimension)
        except ConfigError as error:
            self.fail("; ".join(part for part in (error.what, error.likely, error.hint) if part), param, ctx)
        if self.positive and not found > 0.0:
            self.fail(f"{value} is not above zero", param, ctx)
        return found


_EMPTY = "the text is empty, as a shell leaves a variable that is not set"


class FilePath(click.Path):
    """A path, as ``pathlib.Path``; that module is imported when a path is given, not with this one.

    A name that ends as another kind of file than ``ending`` is refused.
    """

    def __init__(self, ending: str = "", *, file_okay: bool = True, dir_okay: bool = True) -> None:
        super().__init__(file_okay=file_okay, dir_okay=dir_okay)
        self.ending = ending

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or fail as a usage error."""
        from pathlib import Path

        if not value:  # else it is the current folder
            self.fail(_EMPTY, param, ctx)
        if value == "-":  # else a file of that name is made, which few shells remove
            self.fail("'-' is not the name of a file; where the system has /dev/stdout, give that", param, ctx)
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if self.ending and path.suffix.lower() not in ("", self.ending):
            self.fail(f"{path.name!r} ends in {path.suffix}; what is written is {self.ending}", param, ctx)
        return path


NODE = WholeNumber("node", 1, 127)
BITRATE = WholeNumber("bit rate", 1, 10**7)
HZ, DEG, DB = (Quantity(unit, bare=True) for unit in ("Hz", "deg", "dB"))
FILE, TOML, NPZ = (FilePath(ending, dir_okay=False) for ending in ("", ".toml", ".npz"))
DIR, ANY_PATH = FilePath(file_okay=False), FilePath()
SERIAL = WholeNumber("serial", 0, 0xFFFFFFFF_FFFFFFFF)
CURRENT = Quantity("current")
SPEED = Quantity("angular speed")
FREQUENCY = Quantity("frequency")
TIME = Quantity("time")
LARGEST_CURRENT = Quantity("current", positive=True)
LARGEST_SPEED = Quantity("angular speed", positive=True)
DURATION = Quantity("time", positive=True)
RATE = Quantity("frequency", positive=True)


_EXAMPLE_WIDTH = 76
"""Columns of an example; the help puts four blanks before it, and a terminal has 80."""


def examples(*lines: str) -> str:
    """Return the epilog of a command's help: lines that can be pasted, what ``#`` explains in a line before.

    A line that is too long for a terminal goes on behind a backslash.
    """
    shown: list[str] = []
    for line in lines:
        command, _, why = line.partition("  # ")
        shown += ([f"# {why.strip()}"] if why else []) + _continued(command.rstrip())
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in shown)


def _continued(command: str) -> list[str]:
    """Break a command between its options."""
    lines = [""]
    for part in re.split(r" (?=-)", command):
        if len(lines[-1]) + len(part) + 3 > _EXAMPLE_WIDTH and lines[-1]:
            lines[-1] += " \\"
            lines.append("    " + part)
        else:
            lines[-1] += (" " if lines[-1] else "") + part
    return lines


# ---- the options themselves; auto: whether the environment may give them ----------------------------------


def _bus_parameters(auto: bool) -> list[Option]:
    def option(*names: str, **attributes: Any) -> Option:
        return click.option(*names, show_envvar=auto, allow_from_autoenv=auto, **attributes)

    return [
        option("-i", "--interface", metavar="NAME", help="python-can interface, e.g. socketcan, pcan."),
        option("-c", "--channel", metavar="NAME", help="Channel of the interface, e.g. can0."),
        option("-b", "--bitrate", type=BITRATE, metavar="BIT/S", help="Bit rate, e.g. 500000."),
        option("-n", "--node", type=NODE, metavar="ID", help="Node of the drive, 1..127."),
        option("--sim", metavar="PROFILE", help="Short for -i pmsmsim -c PROFILE: a simulated drive."),
        option("--trace-can", type=FILE, metavar="FILE", help="Record the bus (.asc .blf .log .trc)."),
    ]


def _output_parameters(auto: bool) -> list[Option]:
    return [
        click.option(
            "--json",
            "json_output",
            is_flag=True,
            envvar="PMSMTOOL_JSON" if auto else None,
            allow_from_autoenv=False,
            help="Print one JSON object.",
        ),
        *_verbosity_parameters(auto),
    ]


def _verbosity_parameters(auto: bool) -> list[Option]:
    return [
        click.option(
            "-v",
            "--verbose",
            count=True,
            allow_from_autoenv=auto,
            show_default=False,
            help="Say more; -vv with tracebacks.",
        ),
        click.option("-q", "--quiet", is_flag=True, allow_from_autoenv=auto, help="Say only what is wrong."),
    ]


def _yes_parameter(auto: bool, moves: bool = True) -> Option:
    limits = ", and where the machine moves with --i-max, --speed-max and --shaft" if moves else ""
    return click.option(
        "--yes",
        is_flag=True,
        allow_from_autoenv=False,  # consent is typed, never inherited from a shell's environment
        help=f"Answer the prompts; on a real bus only with --serial{limits}.",
    )


def _envelope_parameters(unlisted: bool) -> tuple[Option, ...]:
    """Return the limits of a motion and the serial number; what moves nothing takes the limits unlisted."""
    shaft, current = "What the shaft may do.", "Largest current, e.g. 12Apk or 8.5Arms."
    speed = "Largest speed of the shaft, e.g. 1200rpm."
    return (
        click.option("--i-max", type=LARGEST_CURRENT, metavar="CURRENT", hidden=unlisted, help=current),
        click.option("--speed-max", type=LARGEST_SPEED, metavar="SPEED", hidden=unlisted, help=speed),
        click.option("--shaft", type=click.Choice(["free", "locked", "coupled"]), hidden=unlisted, help=shaft),
        click.option("--serial", type=SERIAL, metavar="NUMBER", help="Serial number the drive must have."),
    )


_SURROUNDINGS_PARAMETERS: tuple[Option, ...] = (
    click.option("--load", type=click.Choice(["none", "gravity"]), default="none", help="What pulls on the shaft."),
    click.option("--brake", type=click.Choice(["open", "drive", "none"]), default="none", help="Holding brake."),
)


def _apply(function: Function, options: list[Option] | tuple[Option, ...]) -> Function:
    for option in reversed(options):
        function = option(function)
    return function


def global_options(function: Function) -> Function:
    """Add the global options to the top-level group."""
    return _apply(function, [*_bus_parameters(True), *_output_parameters(True), _yes_parameter(True)])


# ---- what commands receive --------------------------------------------------------------------------------

_TYPED = (ParameterSource.COMMANDLINE, ParameterSource.PROMPT)


def _strength(ctx: click.Context, name: str) -> int:
    """0 not given, 1 from the environment, 2 typed."""
    source = ctx.get_parameter_source(name)
    if ctx.params.get(name) is None or source in (None, ParameterSource.DEFAULT, ParameterSource.DEFAULT_MAP):
        return 0
    return 2 if source in _TYPED else 1


def given(ctx: click.Context, name: str) -> tuple[Any, int]:
    """Return a shared option and its strength: 3 typed after the command, 2 before it, 1 environment, 0 nowhere."""
    if _strength(ctx, name) == 2:
        return ctx.params[name], 3
    root = ctx.find_root()
    strength = _strength(root, name)
    return (root.params[name], strength) if strength else (None, 0)


@dataclass(frozen=True, slots=True)
class BusOptions:
    """The bus options of a command; None is left to python-can's configuration."""

    interface: str | None = None
    channel: str | None = None
    bitrate: int | None = None
    node: int | None = None
    trace_can: Path | None = None

    def simulated(self) -> bool:
        """Whether the bus is the simulated drive in this process; only then nothing real can move."""
        if self.interface is not None:
            return self.interface == SIMULATED_INTERFACE
        from pmsmtool.bus.connect import configuration

        return bool(configuration({}).get("interface") == SIMULATED_INTERFACE)

    @property
    def recorded(self) -> dict[str, Any]:
        """What the record of a run keeps of it."""
        return {"interface": self.interface, "channel": self.channel, "bitrate": self.bitrate}

    def connect(self) -> Connection:
        """Open the bus; raises ``BusError`` or ``ConfigError``."""
        from pmsmtool.bus.connect import connect

        return connect(self.interface, self.channel, self.bitrate, trace=self.trace_can)


def merged_bus_options(ctx: click.Context) -> BusOptions:
    """Return the bus options of a command, from after it, before it and the environment."""
    values = {name: given(ctx, name) for name in ("interface", "channel", "bitrate", "node", "sim", "trace_can")}
    profile, strength = values.pop("sim")
    rivals = [
        name for name in ("interface", "channel") if values[name][1] and min(values[name][1], 2) == min(strength, 2)
    ]
    if strength and rivals:
        raise click.UsageError(f"--sim and --{rivals[0]} name two buses: give one of them", ctx)
    if strength and strength >= max(values["interface"][1], values["channel"][1]):
        values |= {"interface": (SIMULATED_INTERFACE, strength), "channel": (profile, strength)}
    return BusOptions(**{name: value for name, (value, _) in values.items()})


@dataclass(frozen=True, slots=True)
class MotionOptions:
    """What a person allows before the machine moves or the drive is written."""

    yes: bool = False
    """``--yes`` was typed; what it answers is decided in ``consent``."""
    i_max_apk: float | None = None
    """Largest current (A peak)."""
    speed_max_rad_s: float | None = None
    """Largest mechanical speed (rad/s)."""
    shaft: Literal["free", "locked", "coupled"] | None = None
    """``free``, ``locked`` or ``coupled``."""
    serial: int | None = None
    """Serial number the drive must have."""
    load: Literal["none", "gravity"] = "none"
    brake: Literal["open", "drive", "none"] = "none"
    """What pulls on the shaft (``none``, ``gravity``); the holding brake (``open``, ``drive``, ``none``)."""


def bus_options(function: Function) -> Function:
    """Add the bus options to a command, which receives them as ``bus: BusOptions``."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        bus = merged_bus_options(click.get_current_context())
        for name in ("interface", "channel", "bitrate", "node", "sim", "trace_can"):
            del kwargs[name]
        return function(*args, bus=bus, **kwargs)

    return _apply(command, _bus_parameters(False))


def _output(ctx: click.Context, verbose: int, quiet: bool, json_output: bool) -> Output:
    for where, param in ((c, p) for c in (ctx.find_root(), ctx) for p in c.command.params):
        value = where.params.get(param.name or "")
        if value == "" and getattr(param, "flag_value", None) != "":
            raise click.BadParameter(_EMPTY, where, param)
        if isinstance(value, float) and not math.isfinite(value):  # a range of numbers lets NaN pass
            raise click.BadParameter(f"{value} is not finite", ctx, param)
    above = ctx.find_root().params if ctx.parent else {}
    verbosity = -1 if quiet or above.get("quiet") else verbose + above.get("verbose", 0)
    ctx.meta[VERBOSITY] = verbosity
    set_up_logging(verbosity)
    return Output(json_output or bool(above.get("json_output")), verbosity)


def overspeed_option(function: Function) -> Function:
    """Add ``--overspeed-protection``: what holds the DC link at a fault above uncontrolled generation."""
    return click.option(
        "--overspeed-protection",
        type=click.Choice(["chopper", "battery", "short-circuit"]),
        help="What holds the DC link at a fault above the speed of uncontrolled generation: a brake chopper or a "
        "battery that you state, or shorted windings.  [default: short-circuit where the magnet stands it]",
    )(function)


@contextmanager
def options_named(fields: Mapping[str, str] | None = None) -> Iterator[None]:
    """Name the options a person typed, where a request refuses the fields they fill in (``eps = 2`` -> ``--eps 2``).

    ``fields``: field to option, where they differ; else a field's option is the one that fills a parameter of its name.
    """
    try:
        yield
    except ConfigError as error:
        ctx = click.get_current_context()
        options = {p.name: p.opts[0] for p in ctx.command.params if isinstance(p, click.Option) and p.name}
        options |= fields or {}
        found = tuple(_with_option(text, options) for text in error.violations)
        if found != error.violations:
            error.violations = found
            error.hint = error.hint or f"{ctx.command_path} --help says what each option takes"
        raise


def _with_option(text: str, options: Mapping[str, str]) -> str:
    match = re.match(r"(\w+)( = | is )", text)
    if match is None or match[1] not in options:
        return text
    return f"{options[match[1]]}{match[2].replace(' = ', ' ')}{text[match.end() :]}"


def output_options(function: Function) -> Function:
    """Add ``--json -v -q`` to a command that reads; it receives ``out: Output``."""

    @functools.wraps(function)
    def command(*args: Any, verbose: int, quiet: bool, json_output: bool, **kwargs: Any) -> Any:
        with options_named():
            return function(*args, out=_output(click.get_current_context(), verbose, quiet, json_output), **kwargs)

    return _apply(command, _output_parameters(False))


def text_options(function: Function) -> Function:
    """Add ``-v -q`` to a command whose output is a file or text only; it receives ``out: Output``."""

    @functools.wraps(function)
    def command(*args: Any, verbose: int, quiet: bool, **kwargs: Any) -> Any:
        return function(*args, out=_output(click.get_current_context(), verbose, quiet, False), **kwargs)

    return _apply(command, _verbosity_parameters(False))


def _allowed(ctx: click.Context, kwargs: dict[str, Any]) -> MotionOptions:
    return MotionOptions(
        yes=bool(kwargs.pop("yes") or ctx.find_root().params.get("yes")),
        i_max_apk=kwargs.pop("i_max"),
        speed_max_rad_s=kwargs.pop("speed_max"),
        shaft=kwargs.pop("shaft"),
        serial=kwargs.pop("serial"),
        load=kwargs.pop("load", "none"),
        brake=kwargs.pop("brake", "none"),
    )


def _allowing(function: Function, options: tuple[Option, ...]) -> Function:
    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        motion = _allowed(click.get_current_context(), kwargs)
        return function(*args, motion=motion, **kwargs)

    return _apply(command, options)


def motion_options(function: Function) -> Function:
    """Add the envelope and ``--yes`` to a command that moves the machine; it receives ``motion: MotionOptions``."""
    return _allowing(function, (*_envelope_parameters(False), *_SURROUNDINGS_PARAMETERS, _yes_parameter(False)))


def write_options(function: Function) -> Function:
    """Add ``--yes`` and what it needs to a command that writes the drive; it receives ``motion: MotionOptions``."""
    return _allowing(function, (*_envelope_parameters(True), _yes_parameter(False, moves=False)))
