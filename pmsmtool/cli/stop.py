"""``pmsmtool stop``: stop now, confirmed, and nothing else."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output

if TYPE_CHECKING:
    from pmsmtool.cia402 import State


@click.command("stop", epilog=examples("pmsmtool -i pmsmsim stop", "pmsmtool stop -n 5", "pmsmtool stop --all"))
@click.option("--all", "everyone", is_flag=True, help="Stop every drive on the bus.")
@bus_options
@output_options
def stop_command(bus: BusOptions, out: Output, everyone: bool) -> None:
    """Quick stop, zero current, voltage off, confirmed from the statusword.

    Exit code 8 when a drive does not confirm: the machine may be energised, use the hardware stop.
    """
    from pmsmtool.bus.scan import find_nodes
    from pmsmtool.cli.drive_access import choose_node
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive.stop import quick_stop, state_text
    from pmsmtool.errors import PmsmtoolError

    stopped: list[tuple[int, State]] = []
    failures: list[PmsmtoolError] = []
    with bus.connect() as connection:
        if everyone:
            found = find_nodes(connection)
            ids = [entry.node for entry in found if entry.is_drive or entry.device_type is None]
        else:
            ids = [choose_node(connection, bus.node)]
        for node_id in ids:
            node = DriveNode(connection, node_id)
            try:
                stopped.append((node_id, quick_stop(node)))
            except PmsmtoolError as error:  # the others are stopped first
                failures.append(error)
            finally:
                node.close()
    lines = [f"node {node_id}  stopped: {state_text(state)}" for node_id, state in stopped]
    out.result("stop", {"stopped": [{"node": node_id, "state": state} for node_id, state in stopped]}, lines)
    if failures:
        raise failures[0]
