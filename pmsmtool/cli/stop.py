# SPDX-License-Identifier: MIT
"""``pmsmtool stop``: stop now, confirmed, and nothing else."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import click

from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import BusError, PmsmtoolError

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.cia402 import State
    from pmsmtool.drive.drive_node import DriveNode


@click.command("stop", epilog=examples("pmsmtool -i pmsmsim stop", "pmsmtool stop -n 5", "pmsmtool stop --all"))
@click.option("--all", "everyone", is_flag=True, help="Stop every drive on the bus.")
@bus_options
@output_options
def stop_command(bus: BusOptions, out: Output, everyone: bool) -> None:
    """Quick stop, zero current, voltage off, confirmed from the statusword.

    Exit code 8 when a drive does not confirm, or none answers: the machine may be energised, use the hardware stop.
    A drive that brakes has the time of its ramp; one without a valid answer for 2 s has not confirmed. Several drives
    are stopped at the same time, then further axes of a device that has several. It waits for no other program.
    """
    from pmsmtool.drive.drive_node import DriveNode, state_text

    with bus.connect() as connection:
        nodes = [DriveNode(connection, node_id) for node_id in _whom(connection, bus.node, everyone)]
        stopped, failures = _stop_together(connection, nodes, out)
    lines = [f"node {node_id}  stopped: {state_text(state)}" for node_id, state in stopped]
    out.result("stop", {"stopped": [{"node": node_id, "state": state} for node_id, state in stopped]}, lines)
    if failures:
        raise failures[0] if len(failures) == 1 else ExceptionGroup("drives that did not confirm", failures)


def _whom(connection: Connection, node: int | None, everyone: bool) -> list[int]:
    """Return the nodes to stop.

    Raises StopNotConfirmed: none answers; ConfigError: several do, and neither one nor all were asked for.
    """
    from pmsmtool.bus.nmt import find_nodes
    from pmsmtool.cli.drive_access import choose_node
    from pmsmtool.drive.stop import nobody_confirms

    try:
        if not everyone:
            return [choose_node(connection, node)]
        found = [entry.node for entry in find_nodes(connection) if entry.is_drive or entry.device_type is None]
    except BusError as error:
        raise nobody_confirms(error.what, error.likely) from error
    if not found:
        raise nobody_confirms("no drive answers", connection.explain_silence(0)[0])
    return found


def _stop_together(
    connection: Connection, nodes: list[DriveNode], out: Output
) -> tuple[list[tuple[int, State]], list[PmsmtoolError]]:
    """Stop all at the same time, so that the last does not turn until the first has stood still."""
    from concurrent.futures import ThreadPoolExecutor

    from pmsmtool.drive.stop import ask_at_once, quick_stop, stop_other_axes

    def stop(node: DriveNode) -> State | PmsmtoolError:
        try:
            state = quick_stop(node, say=lambda text: out.status(f"node {node.node}: {text}"))
            stop_other_axes(node)
        except PmsmtoolError as error:
            return error
        return state

    for node in nodes:
        with contextlib.suppress(BusError):
            ask_at_once(node)
    if connection.shared and len(nodes) > 1:
        with ThreadPoolExecutor(len(nodes)) as pool:
            results = list(pool.map(stop, nodes))
    else:
        results = [stop(node) for node in nodes]
    stopped = [(n.node, found) for n, found in zip(nodes, results, strict=True) if not isinstance(found, PmsmtoolError)]
    return stopped, [found for found in results if isinstance(found, PmsmtoolError)]
