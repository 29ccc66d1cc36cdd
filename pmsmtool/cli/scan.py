# SPDX-License-Identifier: MIT
"""``pmsmtool scan``: who is on the bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import LOOKING_S
from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import BusError, SdoAbort

if TYPE_CHECKING:
    from pmsmtool.bus.connection import Connection
    from pmsmtool.bus.nmt import FoundNode


NODE_S = 5.0
"""Time for the identity of one node; one that answers needs 10 ms."""


@click.command("scan", epilog=examples("pmsmtool -i pmsmsim scan", "pmsmtool -i socketcan -c can0 scan --json"))
@bus_options
@output_options
def scan_command(bus: BusOptions, out: Output) -> None:
    """List the nodes on a bus, with identity and state.

    Every node id is asked for its device type; nodes that only send heartbeats are listed too.
    """
    from pmsmtool.bus.nmt import find_nodes

    with bus.connect() as connection:
        found = [entry for entry in find_nodes(connection) if bus.node in (None, entry.node)]
        if not found:
            likely, hint = connection.explain_silence(0)
            raise BusError("no node answers", where=str(connection.bus.channel_info), likely=likely, hint=hint)
        end_s = connection.clock.now() + LOOKING_S
        nodes = [_facts(connection, entry, end_s) for entry in found]
    for facts in nodes:
        if "error" in facts:
            out.warn(f"node {facts['node']}: {facts['error']}")
    heads = ("node", "device", "name", "vendor", "product", "serial", "nmt", "state")
    out.result("scan", {"nodes": nodes}, lambda: table(heads, [_cells(facts) for facts in nodes]))


def _facts(connection: Connection, entry: FoundNode, end_s: float) -> dict[str, Any]:
    from pmsmtool.drive.drive_lock import claim
    from pmsmtool.drive.drive_node import DriveNode

    facts: dict[str, Any] = {
        "node": entry.node,
        "device_type": entry.device_type,
        "profile": None if entry.device_type is None else entry.device_type & 0xFFFF,
        "nmt_state": entry.nmt_state,
    }
    left_s = min(NODE_S, end_s - connection.clock.now())
    if entry.device_type is None:
        return facts
    if left_s <= 0.0:
        return facts | {"error": f"not asked: the nodes before took {LOOKING_S:g} s"}
    try:
        claim(connection, entry.node)
    except BusError as error:  # reading on would disturb whoever works with it
        return facts | {"error": error.what}
    node = DriveNode(connection, entry.node)
    node.sdo.finish_within(left_s)
    try:
        identity = node.identity()
        facts |= {key: getattr(identity, key) for key in ("vendor", "product", "revision", "serial", "name")}
        facts["state"] = node.state() if entry.is_drive else None
    except (BusError, SdoAbort) as error:
        facts["error"] = error.what
    finally:
        node.close()
    return facts


def _cells(facts: dict[str, Any]) -> tuple[str, ...]:
    def text(key: str, form: str = "{}") -> str:
        value = facts.get(key)
        return "-" if value is None else form.format(value)

    nmt, state = facts.get("nmt_state"), facts.get("state")
    device = "no SDO answer" if facts["profile"] is None else f"CiA {facts['profile']}"
    return (
        text("node"), device, text("name"), text("vendor", "{:#010x}"), text("product", "{:#x}"), text("serial"),
        "-" if nmt is None else nmt.name.replace("_", "-"), "-" if state is None else state.name.replace("_", " "),
    )  # fmt: skip
