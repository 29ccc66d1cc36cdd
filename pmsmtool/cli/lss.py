# SPDX-License-Identifier: MIT
"""``pmsmtool lss``: nodes without an id."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.options import NODE, BusOptions, MotionOptions, bus_options, examples, output_options, write_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import BusError, ConfigError

if TYPE_CHECKING:
    from pmsmtool.bus.lss import LssAddress


@click.group(
    "lss",
    epilog=examples("pmsmtool -i socketcan -c can0 lss scan", "pmsmtool -i socketcan -c can0 lss set-node 5 --store"),
)
def lss_command() -> None:
    """Find nodes that have no node id, and give them one (CiA 305)."""


@lss_command.command("scan", epilog=examples("pmsmtool -i pmsmsim -c 'interior-2k2?node=255' lss scan"))
@bus_options
@output_options
def scan_command(bus: BusOptions, out: Output) -> None:
    """Show the identity of one unconfigured node; nothing is changed."""
    from pmsmtool.bus.lss import LssMaster
    from pmsmtool.drive.drive_lock import claim_layer_setting

    with bus.connect() as connection:
        claim_layer_setting(connection)
        master = LssMaster(connection)
        found = master.fast_scan()
        master.close()
    out.result("lss-scan", {"found": found}, _lines(found))


@lss_command.command("set-node", epilog=examples("pmsmtool -i socketcan -c can0 lss set-node 5 --store"))
@click.argument("new_id", metavar="ID", type=NODE)
@click.option("--store", is_flag=True, help="Keep it over a power-off.")
@bus_options
@write_options
@output_options
def set_command(bus: BusOptions, motion: MotionOptions, out: Output, new_id: int, store: bool) -> None:
    """Give the unconfigured node that is found a node id; refused when the id is taken."""
    from pmsmtool.bus.lss import LssMaster
    from pmsmtool.bus.nmt import find_nodes
    from pmsmtool.cli.consent import ask_writing
    from pmsmtool.drive.drive_lock import claim_identity, claim_layer_setting

    with bus.connect() as connection:
        claim_layer_setting(connection)
        if new_id in [entry.node for entry in find_nodes(connection)]:
            raise ConfigError(f"node id {new_id} is taken", hint="`pmsmtool scan` lists the ids in use")
        master = LssMaster(connection)
        found = master.fast_scan()
        if found is None:
            raise BusError("no unconfigured node answers", hint="a node that has an id is not found by the fast scan")
        claim_identity(connection, found.vendor, found.product, found.serial)
        lines = [*_lines(found), f"gets node id {new_id}{', stored' if store else ''}"]
        ask_writing(lines, motion, simulated=bus.simulated(), serial=found.serial, out=out)
        with master.configuration(found):
            master.set_node_id(new_id)
            if store:
                master.store()
        connection.wait(BOOT_WAIT_S)
        there = new_id in [entry.node for entry in find_nodes(connection)]
        master.close()
    if not there:
        raise BusError(
            f"the node does not answer as {new_id}",
            likely="it takes the id after its next power-on",
            hint="switch the drive off and on, then `pmsmtool scan`",
        )
    out.result(
        "lss-set-node", {"slave": found, "node": new_id, "stored": store}, [f"serial {found.serial} is node {new_id}"]
    )


BOOT_WAIT_S = 1.0


def _lines(found: LssAddress | None) -> list[str]:
    if found is None:
        return ["no unconfigured node"]
    facts: dict[str, Any] = {"vendor": f"{found.vendor:#010x}", "product": f"{found.product:#x}"}
    facts |= {"revision": f"{found.revision:#x}", "serial": found.serial}
    return ["unconfigured node: " + "  ".join(f"{key} {value}" for key, value in facts.items())]
