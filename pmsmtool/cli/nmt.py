# SPDX-License-Identifier: MIT
"""``pmsmtool nmt``: network management commands."""

from __future__ import annotations

import click

from pmsmtool.cli.drive_access import choose_node
from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import DriveTimeout, SdoAbort

COMMANDS = ("start", "stop", "pre-operational", "reset-node", "reset-communication")


@click.command("nmt", epilog=examples("pmsmtool -i pmsmsim nmt start", "pmsmtool -n 5 nmt reset-node"))
@click.argument("command", type=click.Choice(COMMANDS))
@bus_options
@output_options
def nmt_command(bus: BusOptions, out: Output, command: str) -> None:
    """Send an NMT command to one node; refused while its power stage may be on (exit code 5)."""
    from pmsmtool.bus.nmt import NmtCommand, send_nmt
    from pmsmtool.cia402 import HOMING_LOST
    from pmsmtool.drive.drive_lock import claim
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive_maps.shipped_maps import GENERIC, load_family
    from pmsmtool.flash.download import refuse_while_enabled

    wanted = NmtCommand[command.replace("-", "_").upper()]
    with bus.connect() as connection:
        node = DriveNode(connection, choose_node(connection, bus.node), drive_map=load_family(GENERIC))
        try:
            claim(connection, node.node)
            refuse_while_enabled(node)
        except SdoAbort:
            out.detail("the node has no statusword: no CiA 402 drive")
        except DriveTimeout:
            out.warn("the node answers no SDO (it may be stopped): its state is not known")
        if wanted is NmtCommand.RESET_NODE:
            out.note(f"the drive is reset: {HOMING_LOST}")
            node.reset()
        else:
            with node.supervision.expected_reset():
                send_nmt(connection, wanted, node.node)
                connection.wait(HEARTBEAT_WAIT_S)
        state = node.supervision.nmt_state
        node.close()
    shown = "not heard" if state is None else state.name.replace("_", "-")
    out.result(
        "nmt", {"node": node.node, "command": command, "nmt_state": state}, [f"node {node.node}  {command}: {shown}"]
    )


HEARTBEAT_WAIT_S = 1.0
"""The new state shows in the next heartbeat."""
