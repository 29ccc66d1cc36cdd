# SPDX-License-Identifier: MIT
"""One program per drive: a lock file per serial number, which the system frees when its owner ends or dies.

Layer setting services have none to speak of: their answers carry no node id, so one program per bus uses them.

Two programs on one SDO channel corrupt each other's transfers, and both roll back. The lock lets the first one win and
names it to the second. ``stop`` never asks for it; a drive simulated in this process cannot be shared and has none.
"""

from __future__ import annotations

import contextlib
import datetime
import getpass
import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path

from pmsmtool.bus.connection import Connection
from pmsmtool.bus.sdo import SdoChannel
from pmsmtool.bus.supervision import SecondMaster
from pmsmtool.drive.drive_node import vendor_product_serial
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.errors import ConfigError, SdoAbort
from pmsmtool.files import user_folder
from pmsmtool.plain_text import one_line

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

_LOCKED_BYTE = 1 << 30
"""Windows locks bytes, and who holds the file must stay readable: the locked byte lies behind the text."""
_LONGEST_OWNER = 200
_LOOKS, _LOOK_S = 20, 0.01
"""Looks at a lock whose holder has not said yet who it is, and time between them (s): it does next."""
IDENTITY_S = 5.0
"""Time for three numbers; a drive that answers needs 5 ms."""


def claim(connection: Connection, node_id: int) -> None:
    """Lock the drive of a node until the connection is closed.

    Only vendor, product and serial number are read before: another program at work takes these reads for harmless.

    Raises SecondMaster: another program of this account works with the drive; it is named.
    """
    _hold(
        connection, lambda: _key(connection, node_id), "this drive", f"node {node_id}",
        f"; `pmsmtool stop -n {node_id}` works all the same",
    )  # fmt: skip


def claim_layer_setting(connection: Connection) -> None:
    """Lock the layer setting services of a bus until the connection is closed.

    Raises SecondMaster: another program of this account gives node ids on this bus; it is named.
    """
    _hold(connection, lambda: f"lss-{_place(connection)}", "the layer setting services of this bus", "LSS")


def claim_identity(connection: Connection, vendor: int, product: int, serial: int) -> None:
    """Lock a drive that has no node id yet, by what it says of itself; one without a serial number has no lock.

    Raises SecondMaster: another program of this account works with the drive; it is named.
    """
    if serial and vendor != reference_map().vendor:
        _hold(connection, lambda: _name(vendor, product, serial), "this drive", f"serial {serial}")


def _hold(connection: Connection, key: Callable[[], str], what: str, where: str, besides: str = "") -> None:
    if not connection.shared:
        return
    try:
        folder = user_folder() / "locks"
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / f"{key()}.lock", os.O_RDWR | os.O_CREAT, 0o600)
    except (OSError, ConfigError):
        return  # nothing can be written for this user: no journal either, so nothing is downloaded
    if not _lock(descriptor):
        owner = _said(descriptor)
        for _ in range(_LOOKS):  # it has the lock before it has said who it is
            if owner:
                break
            connection.clock.wait(_LOOK_S)
            owner = _said(descriptor)
        owner = owner or "unknown"
        os.close(descriptor)
        raise SecondMaster(
            f"another pmsmtool works with {what}: {owner}",
            where=where,
            likely="a second terminal, a script or a scheduled job",
            hint=f"wait until it has ended, or end it{besides}",
        )
    connection.at_close.append(lambda: os.close(descriptor))
    os.ftruncate(descriptor, 0)
    os.write(descriptor, _owner().encode("utf-8", "replace")[:_LONGEST_OWNER])


def _key(connection: Connection, node_id: int) -> str:
    """Return the drive's name among locks.

    One without a serial number is known by its bus and node id; simulated ones, of which several servers give the same
    number, by both.
    """
    sdo = SdoChannel(connection, node_id)
    sdo.finish_within(IDENTITY_S)
    try:
        vendor, product, serial = vendor_product_serial(sdo)
    except SdoAbort:
        vendor = product = serial = 0
    finally:
        sdo.close()
    name = _name(vendor, product, serial)
    if serial and vendor != reference_map().vendor:
        return name
    return f"{name}-{_place(connection)}-{node_id}"


def _name(vendor: int, product: int, serial: int) -> str:
    return f"{vendor:08x}-{product:08x}-{serial}"


def _place(connection: Connection) -> str:
    where = str(connection.bus.channel_info).rpartition("@")[2]  # of socketcand the server, whatever name is opened
    return hashlib.sha256(where.encode()).hexdigest()[:12]


def _lock(descriptor: int) -> bool:
    try:
        if sys.platform == "win32":
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            os.lseek(descriptor, 0, os.SEEK_SET)
        else:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        if sys.platform == "win32":
            os.lseek(descriptor, 0, os.SEEK_SET)
        return False
    return True


def _said(descriptor: int) -> str:
    """Return what the holder of a lock says of itself; empty where it has not yet."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    return one_line(os.read(descriptor, _LONGEST_OWNER).decode("utf-8", "replace").strip())


def _owner() -> str:
    """Say who holds the lock, as the next program's user needs it to find him."""
    user = "an unknown user"
    with contextlib.suppress(OSError, KeyError, ImportError):
        user = getpass.getuser()
    since = datetime.datetime.now().strftime("%Y-%m-%d %H:%M:%S")
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return f"process {os.getpid()} of {user} since {since}: {command}"
