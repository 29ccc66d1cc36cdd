# SPDX-License-Identifier: MIT
"""``pmsmtool sim``: simulated drives for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import map_option, new_file
from pmsmtool.cli.options import BITRATE, FILE, BusOptions, WholeNumber, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import ConfigError
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from pmsmtool.sim.channel import Channel
    from pmsmtool.sim.line import Line
    from pmsmtool.sim.serve import SocketcandServer

_PORT = WholeNumber("port", 0, 65535)
_SEED = WholeNumber("seed", 0, 2**63 - 1)
_NODE_ID = WholeNumber("node", 1, 255)
_COUNT = WholeNumber("count", 1, 127)


_HELP = """Serve simulated drives to other programs; list the profiles; clone a drive; show faults.

A simulated drive in this process needs no server: -i pmsmsim -c CHANNEL, or --sim CHANNEL, with a CHANNEL of
NAME[?key=value&...], NAME a profile or a machine file:

\b
seed=N       seed of noise and faults
nv=FILE      non-volatile memory; :memory: forgets; default .pmsmsim/NAME.nv
faults=FILE  faults on purpose; `pmsmtool sim faults` prints an example
bitrate=B    bit-exact frame times; default: nominal times at 1 Mbit/s
node=ID      node id of the first drive; 255: unconfigured (LSS)
nodes=N      number of drives on the line
drive=FAMILY the objects of another family: epos4, ingenia, cia402, ...
level=LEVEL  capability level: inject (no averages), or recorder (neither
             averages nor excitation)
speed=X      idle time in multiples of the wall clock; default: at once
"""


@click.group("sim", help=_HELP, epilog=examples("pmsmtool sim list", "pmsmtool sim serve interior-2k2 --nodes 2"))
def sim_command() -> None:
    """Group of the commands below."""


@sim_command.command(
    "serve",
    epilog=examples(
        "pmsmtool sim serve  # then `pmsmtool -i socketcand -c vcan0 scan` finds the drive",
        "pmsmtool sim serve jercic-2017 --port 0 --json",
        "pmsmtool sim serve --nodes 3 --faults lossy.toml --bitrate 500000",
        "pmsmtool sim serve --scenario operation  # for `pmsmtool -i socketcand -c vcan0 track`",
    ),
)
@click.argument("profile", required=False)
@click.option("--host", default="127.0.0.1", help="Address to listen on.")
@click.option("--port", type=_PORT, default="29536", help="Port to listen on; 0 takes a free one.")
@click.option(
    "--speed",
    type=click.FloatRange(0, 1000, min_open=True),
    default=1.0,
    help="Multiple of the wall clock. Motion needs 0.8 to 2: a tool's heartbeat and time-outs are real time.",
)
@click.option("--bitrate", type=BITRATE, metavar="BIT/S", help="Pace the frames bit by bit; default: not paced.")
@click.option("--node", type=_NODE_ID, metavar="ID", help="Node id of the first drive; 255: unconfigured (LSS).")
@click.option("--nodes", type=_COUNT, metavar="N", help="Number of drives on the bus.")
@click.option("--seed", type=_SEED, help="Seed of noise and faults.")
@click.option("--nv", metavar="FILE", help="File of the non-volatile memory, or :memory:.")
@click.option("--faults", type=FILE, help="File of faults on purpose; `sim faults` prints an example.")
@click.option(
    "--scenario",
    type=click.Choice(["operation"]),
    help="operation: each drive holds a design for its machine and runs through speeds and loads by itself, until it "
    "is stopped; its memory is volatile. To try `track` and `monitor` on.",
)
@output_options
def serve_command(
    out: Output, profile: str | None, host: str, port: int, speed: float, scenario: str | None, **given: Any
) -> None:
    """Serve simulated drives on a socketcand server until Ctrl-C.

    PROFILE is a profile (`pmsmtool sim list`), a machine file, or a channel string NAME?key=value&...; the options
    win over its keys. Any program with python-can's socketcand backend can join, several at a time.
    """
    from pmsmtool.sim.channel import build_line, parse_channel
    from pmsmtool.sim.serve import SocketcandServer

    channel = replace(parse_channel(profile), **{name: value for name, value in given.items() if value is not None})
    if scenario is not None:
        channel = _without_memory(channel)
    line = build_line(channel, instant=True)
    if scenario is not None:
        _operate(line, channel, out)
    server = SocketcandServer(line, host, port, speed=speed, damaged=channel.terminator == "missing", say=out.note)
    ids = [node.node_id for node in line.nodes]
    data = {"interface": "socketcand", "host": host, "port": server.port, "profile": channel.name, "node_ids": ids}
    out.result("sim-serve", data, [f"socketcand {host}:{server.port}"])
    out.note(f"simulating {channel.name} as node {', '.join(map(str, ids))}; Ctrl-C ends it")
    out.note(_how_to_join(host, server.port))
    if scenario is not None:
        out.note("in operation: look at it with `monitor` or `track`; `stop` ends it")
    _serve(server)


def _without_memory(channel: Channel) -> Channel:
    """Return the channel of drives whose memory forgets: a stored set would outrank that of the scenario."""
    from pmsmtool.sim.channel import VOLATILE

    if channel.nv not in (None, VOLATILE):
        raise ConfigError(
            "--scenario gives the drive a set of its own, and --nv another one",
            where=f"nv={channel.nv}",
            hint="leave one of them out",
        )
    return replace(channel, nv=VOLATILE)


def _operate(line: Line, channel: Channel, out: Output) -> None:
    from pmsmtool.machine.machine_file import load_machine_file
    from pmsmtool.sim.operation import operate

    operate(line, load_machine_file(channel.name), out.note)


def _how_to_join(host: str, port: int) -> str:
    if (host, port) == ("127.0.0.1", 29536):
        return "join with: pmsmtool -i socketcand -c vcan0 scan"
    return (
        f'join with: can.Bus(interface="socketcand", host="{host}", port={port}, channel="vcan0", tcp_tune=True); '
        f"pmsmtool with the lines `host = {host}` and `port = {port}` below `[default]` in ~/can.conf"
    )


def _serve(server: SocketcandServer) -> None:
    """Serve until SIGINT or SIGTERM; both end the command normally."""
    import signal
    import sys

    sys.stdout.flush()
    ended: list[int] = []

    def end(number: int, frame: object) -> None:
        ended.append(number)

    previous = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        server.serve(lambda: bool(ended))
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@sim_command.command(
    "clone",
    epilog=examples(
        "pmsmtool -i socketcan -c can0 -n 5 sim clone runs/20260101T120000Z-000055f1 -o twin.toml",
        "pmsmtool sim clone machine.toml -n 5 -o twin.toml --draw 1   # a drive for `--sim twin.toml`",
    ),
)
@click.argument("machine")
@new_file("path", required=True, help="Machine file of the clone; others beside it.")
@click.option("--draw", type=_SEED, metavar="SEED", help="Draw the clone's truth from the estimates' intervals.")
@map_option
@bus_options
@output_options
def clone_command(
    bus: BusOptions, out: Output, machine: str, path: Path, draw: int | None, map_file: Path | None
) -> None:
    """Make a simulated drive in the image of a real one: its machine, its parameters, its data sheet.

    MACHINE is the machine file, run directory or profile that says what is on the drive; the drive is only read.
    """
    from pmsmtool.cli.drive_access import open_node, read_map, warn_of_other_drive
    from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file
    from pmsmtool.measurement.capabilities import examine
    from pmsmtool.measurement.clone import clone_drive

    machine_file = load_machine_file(machine)
    with open_node(bus) as node:
        found = examine(node, None if map_file is None else read_map(map_file))
        if map_file is not None:
            warn_of_other_drive(node, out)
        clone = clone_drive(node, found, machine_file, draw)
    embed = machine_file.flux_map is not None
    contents: dict[Path, bytes] = {path: dump_machine_file(clone.machine_file, embed_flux_map=embed).encode()}
    if clone.parameters.values:
        contents[path.with_suffix(".params.toml")] = clone.parameters.to_toml().encode()
    if clone.data_sheet:
        contents[path.with_suffix(".eds")] = clone.data_sheet
    for file, content in contents.items():
        write_file(file, content)
    channel = str(path) if clone.family == "pmsmsim" else f"'{path}?drive={clone.family}'"
    data = {"files": [str(file) for file in contents], "family": clone.family, "draw": draw}
    out.result("sim-clone", data, [f"wrote {', '.join(map(str, contents))}", f"pmsmtool --sim {channel} info"])


@sim_command.command(
    "faults", epilog=examples("pmsmtool sim faults > faults.toml", "pmsmtool sim serve --faults faults.toml")
)
def faults_command() -> None:
    """Print an example of a faults file: every fault there is, with its keys."""
    from pmsmtool.sim.faults import EXAMPLE

    click.echo(EXAMPLE, nl=False)


@sim_command.command("list", epilog=examples("pmsmtool sim list", "pmsmtool sim list --json | jq '.profiles[].name'"))
@output_options
def list_command(out: Output) -> None:
    """List the profiles that ship with the package."""
    from pmsmtool.machine.machine_file import load_machine_file, profile_names
    from pmsmtool.sim.channel import DEFAULT_PROFILE

    rows = []
    for name in profile_names():
        machine_file = load_machine_file(name)
        machine, inverter = machine_file.machine, machine_file.inverter
        rows.append(
            {
                "name": name,
                "description": machine_file.name,
                "default": name == DEFAULT_PROFILE,
                "pole_pairs": machine.pole_pairs,
                "I_nom_apk": machine.I_nom_apk,
                "U_dc_v": inverter.U_dc_v,
                "f_s_hz": inverter.f_s_hz,
                "n_max_rpm": machine.n_max_rpm,
                "saturated": machine_file.flux_map is not None,
            }
        )
    heads = ("profile", "I_nom/Apk", "U_dc/V", "f_s/kHz", "n_max/rpm", "pole pairs", "magnetics")
    out.result("sim-list", {"profiles": rows}, lambda: table(heads, [_cells(row) for row in rows]))


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    return (
        row["name"] + (" (default)" if row["default"] else ""),
        "-" if row["I_nom_apk"] is None else f"{row['I_nom_apk']:.4g}",
        f"{row['U_dc_v']:.4g}",
        f"{row['f_s_hz'] / 1e3:.4g}",
        "-" if row["n_max_rpm"] is None else f"{row['n_max_rpm']:.0f}",
        row["pole_pairs"],
        "saturated" if row["saturated"] else "linear",
    )
