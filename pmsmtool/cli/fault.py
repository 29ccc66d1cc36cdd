# SPDX-License-Identifier: MIT
"""``pmsmtool fault``: faults decoded, and reset on purpose."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import LOOKING_S, open_node
from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import SdoAbort

if TYPE_CHECKING:
    from pmsmtool.drive.drive_node import DriveNode


@click.group("fault", epilog=examples("pmsmtool -n 5 fault show", "pmsmtool -n 5 fault reset"))
def fault_command() -> None:
    """Show a drive's faults, or reset them."""


@fault_command.command("show", epilog=examples("pmsmtool -i pmsmsim fault show", "pmsmtool -n 5 fault show --json"))
@bus_options
@output_options
def show_command(bus: BusOptions, out: Output) -> None:
    """Show the present fault and the error history; exit code 4 while the drive is in fault."""
    from pmsmtool.cia402 import State

    with open_node(bus, within_s=LOOKING_S) as node:
        facts = _faults(node)
        out.result("fault-show", facts, lambda: _lines(facts))
        if facts["state"] in (State.FAULT, State.FAULT_REACTION_ACTIVE):
            raise node.fault_error()


@fault_command.command("reset", epilog=examples("pmsmtool -n 5 fault reset"))
@bus_options
@output_options
def reset_command(bus: BusOptions, out: Output) -> None:
    """Reset a fault; the drive stays off. Exit code 4 when the cause persists."""
    with open_node(bus) as node, node.emergencies_tolerated():
        node.reset_fault()
        facts = _faults(node)
        out.result("fault-reset", facts, lambda: _lines(facts))


def _faults(node: DriveNode) -> dict[str, Any]:
    from pmsmtool.cia402 import error_text
    from pmsmtool.drive import objects

    history = []
    with contextlib.suppress(SdoAbort):
        count = node.sdo.read(objects.ERROR_HISTORY, 0)[0]
        for sub in range(1, count + 1):
            word = int.from_bytes(node.sdo.read(objects.ERROR_HISTORY, sub, size=4), "little")
            code = word & 0xFFFF
            history.append({"code": code, "text": error_text(code), "additional": word >> 16})
    code = node.fault_code()
    return {
        "node": node.node,
        "state": node.state(),
        "error_code": code,
        "error_text": error_text(code),
        "error_register": node.whole(objects.ERROR_REGISTER),
        "history": history,
    }


def _lines(facts: dict[str, Any]) -> list[str]:
    state = "undefined" if facts["state"] is None else facts["state"].name.replace("_", " ")
    lines = [f"node {facts['node']}  {state}  {facts['error_code']:#06x} {facts['error_text']}"]
    lines += [f"  {number}  {entry['code']:#06x} {entry['text']}" for number, entry in enumerate(facts["history"], 1)]
    return lines
