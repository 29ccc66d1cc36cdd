# SPDX-License-Identifier: MIT
"""``pmsmtool info``: what one drive says about itself."""

from __future__ import annotations

import contextlib
import datetime
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from pmsmtool.cli.drive_access import LOOKING_S, map_option, open_node, read_map, warn_of_other_drive
from pmsmtool.cli.options import BusOptions, bus_options, examples, output_options
from pmsmtool.cli.output import Output
from pmsmtool.errors import SdoAbort

if TYPE_CHECKING:
    from pmsmtool.drive.drive_node import DriveNode
    from pmsmtool.drive.port import Identity
    from pmsmtool.drive_maps.drive_map import DriveMap


HEARTBEAT_PERIODS = 1.2
PATIENCE_S = 1.0
"""The NMT state is only in the heartbeat; a slow one is not waited for."""


@click.command("info", epilog=examples("pmsmtool -i pmsmsim info", "pmsmtool -n 5 info --json | jq .identity.serial"))
@map_option
@bus_options
@output_options
def info_command(bus: BusOptions, out: Output, map_file: Path | None) -> None:
    """Show identity, state, faults and parameter set of a drive."""
    given = None if map_file is None else read_map(map_file)
    with open_node(bus, within_s=LOOKING_S) as node:
        facts = read_facts(node, given)
        if given is not None:
            warn_of_other_drive(node, out)
    out.result("info", facts, lambda: _lines(facts))


def read_facts(node: DriveNode, drive_map: DriveMap | None = None) -> dict[str, Any]:
    """Return what ``info`` shows, read from the drive; what it does not have is None."""
    from pmsmtool.cia402 import error_text, state_of
    from pmsmtool.drive import objects

    identity = node.identity()
    if node.supervision.heartbeat_period_s is not None:
        node.connection.wait(min(HEARTBEAT_PERIODS * node.supervision.heartbeat_period_s, PATIENCE_S))
    code, word = _whole(node, objects.ERROR_CODE), _whole(node, objects.STATUSWORD)
    days, milliseconds = _whole(node, objects.CONFIGURATION_DATE), _whole(node, objects.CONFIGURATION_TIME)
    return {
        "identity": identity,
        "device_type": _whole(node, objects.DEVICE_TYPE),
        "statusword": word,
        "state": None if word is None else state_of(word),
        "mode": _whole(node, objects.MODE_DISPLAY),
        "nmt_state": node.supervision.nmt_state,
        "heartbeat_s": node.supervision.heartbeat_period_s,
        "error_code": code,
        "error_text": None if code is None else error_text(code),
        "error_register": _whole(node, objects.ERROR_REGISTER),
        "supported_modes": _whole(node, objects.SUPPORTED_MODES),
        "parameter_set": _parameter_set(node),
        "configured": _moment(days, milliseconds),
        "limits": _limits(node, identity, drive_map),
    }


def _parameter_set(node: DriveNode) -> dict[str, Any] | None:
    from pmsmtool.drive import objects
    from pmsmtool.params.catalogue import SCHEMA_VERSION, layout_signature

    schema, signature = _whole(node, objects.SET_SCHEMA), _whole(node, objects.SET_SIGNATURE)
    if schema is None or signature is None:
        return None
    active, stored = _whole(node, objects.SET_CRC_ACTIVE), _whole(node, objects.SET_CRC_STORED)
    return {
        "schema": schema,
        "signature": signature,
        "known": (schema, signature) == (SCHEMA_VERSION, layout_signature()),
        "crc_active": active,
        "crc_stored": stored,
        "stored": active == stored,
    }


def _limits(node: DriveNode, identity: Identity, drive_map: DriveMap | None) -> dict[str, Any]:
    """Return rated current and largest speed: of the maker's own object where the map of the family names it."""
    from pmsmtool.drive import objects
    from pmsmtool.drive.motion_objects import rated_current
    from pmsmtool.measurement.capabilities import choose_map

    node.map = choose_map(identity, drive_map)
    stands = rated_current(node)
    held = None if stands is None else node.held(stands.item)
    rms = None if stands is None or held is None else stands.per_count * held / math.sqrt(2.0)
    decided = stands is not None and (node.map.staging or not stands.undecided)
    return {
        "rated_current_arms": rms if decided else None,
        "rated_current_a": rms,
        "rated_current_object": None if rms is None else str(stands),
        "max_speed_rpm": _whole(node, objects.MAX_SPEED_RPM),
    }


def _whole(node: DriveNode, item: Any) -> int | None:
    with contextlib.suppress(SdoAbort):
        return node.whole(item)
    return None


def _moment(days: int | None, milliseconds: int | None) -> str | None:
    """Object 0x1020 as a date; zero means: something changed since it was written."""
    from pmsmtool.flash.restore import CONFIGURATION_EPOCH

    if not days:
        return None
    midnight = datetime.datetime.combine(CONFIGURATION_EPOCH, datetime.time())
    try:
        moment = midnight + datetime.timedelta(days=days, milliseconds=milliseconds or 0)
    except OverflowError:
        return None
    return moment.isoformat(sep=" ", timespec="seconds")


def _lines(facts: dict[str, Any]) -> list[str]:
    identity, state, held = facts["identity"], facts["state"], facts["parameter_set"]
    shown = "undefined" if state is None else state.name.replace("_", " ")
    if facts["statusword"] is None:
        shown = "not shown: no 0x6041, this is no CiA 402 drive"
    lines = [
        f"node      {identity.node}  {identity.name}  hw {identity.hardware or '-'}  sw {identity.software or '-'}",
        f"identity  vendor {identity.vendor:#010x}  product {identity.product:#x}  revision {identity.revision:#x}  "
        f"serial {identity.serial}",
        f"state     {shown}  mode {'-' if facts['mode'] is None else facts['mode']}  "
        f"NMT {'-' if facts['nmt_state'] is None else facts['nmt_state'].name.replace('_', '-')}",
    ]
    if facts["error_code"]:
        lines.append(f"fault     {facts['error_code']:#06x} {facts['error_text']}")
    rated, rms = facts["limits"]["rated_current_a"], facts["limits"]["rated_current_arms"]
    if rms is not None:
        lines.append(f"rated     {rms:.6g} Arms ({rms * 2**0.5:.4g} Apk)")
    elif rated is not None:
        where = facts["limits"]["rated_current_object"]
        lines.append(f"rated     {rated:.6g} A in {where}: whether peak or rms is its maker's choice")
    if held is not None:
        known = "known" if held["known"] else "UNKNOWN to this program"
        stored = "stored" if held["stored"] else "NOT stored: a reset brings another set back"
        if held["crc_stored"] == 0:
            stored = "nothing is stored: a reset brings the factory values back"
        lines.append(f"set       schema {held['schema']}  signature {held['signature']:#010x} ({known})")
        lines.append(f"          CRC-32 {held['crc_active']:#010x}, {stored}")
    lines.append(f"changed   {facts['configured'] or 'since the last download, or never written by one'}")
    return lines
