# SPDX-License-Identifier: MIT
"""Opening a CAN bus: python-can's own configuration honoured, the trace of ``--trace-can``, errors that say why.

What the usual USB adapters need is by the makers' pages and python-can's documentation. On Linux the kernel brings most
of them up as a network device, whoever made them. A call that may hang in a driver, given up after a while.
"""

from __future__ import annotations

import configparser
import errno
import logging
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

import can

from pmsmtool.bus.connection import TRACE_HINT, Connection
from pmsmtool.errors import BusError, ConfigError, PmsmtoolError
from pmsmtool.plain_text import reason

__all__ = ["Connection", "connect"]

SOCKETCAND_DEFAULTS: Mapping[str, Any] = {"host": "127.0.0.1", "port": 29536, "channel": "vcan0"}
"""What ``pmsmtool sim serve`` offers; used for what neither the caller nor python-can's files say."""
TRACE_SUFFIXES = (".asc", ".blf", ".log", ".trc")
_SERVER_TIMEOUT_S = 2.0
OPEN_LIMIT_S = 10.0
"""Adapters take up to 3 s to open (slcan sleeps for 2 s); one that needs longer is taken for hung."""

_BRING_UP = "sudo ip link set can0 up type can bitrate 500000"
_SOCKETCAN = "-i socketcan -c can0"
_PYTHON = "python -m pip install"


def connect(
    interface: str | None = None,
    channel: str | None = None,
    bitrate: int | None = None,
    *,
    trace: Path | None = None,
    **options: Any,
) -> Connection:
    """Open a bus; what is not given is left to python-can's own configuration.

    Parameters
    ----------
    interface, channel, bitrate
        As for ``can.Bus``; None is not passed on, so ``~/can.conf``, ``~/.canrc`` and ``CAN_*`` decide.
    trace : Path, optional
        Record every frame there; the suffix chooses the format.
    **options
        Further keyword arguments of the interface.

    Raises
    ------
    BusError
        No interface is configured, or it does not open.
    ConfigError
        The trace file's suffix is unknown or it cannot be written.
    """
    given = {"interface": interface, "channel": channel, "bitrate": bitrate, **options}
    arguments = {key: value for key, value in given.items() if value is not None}
    writer = None if trace is None else _open_trace(trace)
    try:
        configured = arguments if arguments.get("ignore_config") else configuration(arguments)
        bus = _open_in_time(_completed(arguments, configured), configured.get("interface"))
    except (can.CanError, OSError, ValueError, NotImplementedError, ImportError, TypeError) as error:
        if writer is not None:
            writer.stop()
        if isinstance(error, ConfigError):
            raise
        raise _open_failure(arguments, error) from error
    return Connection(bus, writer=writer)


def _open_in_time(arguments: dict[str, Any], interface: str | None) -> can.BusABC:
    """Open a bus; python-can's back ends may wait for ever for a driver, or for a server's first word.

    Raises TimeoutError: it did not open within ``OPEN_LIMIT_S``.
    """
    if interface == "pmsmsim":
        return can.Bus(**arguments)  # in this process; its clock belongs to this thread
    before = socket.getdefaulttimeout()
    # Also of the sockets made now, for good: a server that stops reading must not keep a sender waiting.
    socket.setdefaulttimeout(_SERVER_TIMEOUT_S)
    try:
        return in_time(lambda: can.Bus(**arguments), OPEN_LIMIT_S, too_late=lambda bus: bus.shutdown())
    finally:
        socket.setdefaulttimeout(before)


def configuration(typed: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is typed with what python-can's own files and environment add; raises ConfigError: a damaged file."""
    try:
        return dict(can.util.load_config(config=dict(typed)))
    except can.CanInterfaceNotImplementedError:
        return dict(typed)
    except (configparser.Error, UnicodeDecodeError) as error:
        raise ConfigError(
            f"python-can's configuration cannot be read: {reason(error)}",
            where=str(getattr(error, "source", "can.conf, can.ini or .canrc")),
            likely="a missing bracket or equals sign",
            hint="a section [default] has lines like `interface = socketcan`",
        ) from None


def _completed(arguments: dict[str, Any], configured: dict[str, Any]) -> dict[str, Any]:
    """Add what python-can's configuration lacks for a simulated drive in another process."""
    if configured.get("interface") != "socketcand":
        return arguments
    logging.getLogger("can.interfaces.socketcand").setLevel(logging.CRITICAL)
    missing = {key: value for key, value in SOCKETCAND_DEFAULTS.items() if configured.get(key) is None}
    server = {**configured, **missing}
    # python-can tries for ten seconds; where nobody listens that is known at once.
    place = server["host"], int(server["port"])
    try:
        socket.create_connection(place, _SERVER_TIMEOUT_S).close()
    except ConnectionError as error:
        raise ConnectionError(f"no server listens at {place[0]}:{place[1]}") from error
    # Without tcp_tune Nagle's algorithm makes block transfers 17 times slower (docs/canopen.md, 1).
    return {"tcp_tune": True, **arguments, **missing}


def _open_failure(arguments: Mapping[str, Any], error: Exception) -> PmsmtoolError:
    name = arguments.get("interface")
    if isinstance(error.__cause__, ConfigError):
        return error.__cause__  # the simulated bus names the key of its channel that is wrong
    if name is None and isinstance(error, can.CanInterfaceNotImplementedError):
        return BusError(
            "no CAN interface is configured",
            likely="neither -i/-c nor python-can's own configuration (~/can.conf, CAN_INTERFACE) names one",
            hint="-i pmsmsim for the simulated drive, or -i and -c of your adapter; `pmsmtool doctor` lists adapters",
        )
    known = can.VALID_INTERFACES
    if name is not None and name not in known:
        near = meant_interface(name, known)
        return BusError(
            f"there is no CAN interface {name!r}" + (f", did you mean {near}?" if near else ""),
            where=f"-i {name}",
            hint=how_to_set_up(near) or "`pmsmtool doctor` lists what there is",
        )
    where = " ".join(str(arguments[k]) for k in ("interface", "channel") if arguments.get(k) is not None)
    return BusError(
        f"the bus does not open: {reason(error)}",
        where=where,
        likely=_why_closed(name, error),
        hint=how_to_set_up(name or "") or "`pmsmtool doctor` without -i lists what each adapter needs here",
    )


def _why_closed(name: str | None, error: Exception) -> str:
    if isinstance(error, (can.CanInterfaceNotImplementedError, ImportError)):
        return "the adapter's driver or python-can's extra for it is not installed"
    if isinstance(error, TimeoutError):
        return "what listens there is no socketcand server, or it hangs" if name == "socketcand" else "it hangs"
    if isinstance(error, ConnectionError):
        return "`pmsmtool sim serve` does not run, or serves at another port: `port = N` below [default] in ~/can.conf"
    if getattr(error, "errno", None) == errno.EAFNOSUPPORT:
        return "this system has no SocketCAN"
    if getattr(error, "errno", None) == errno.ENODEV:
        return "the channel does not exist, or is down"
    if "library" in str(error) or "dll" in str(error).lower():
        return f"the maker's library for {name} is not installed"
    return f"wrong channel for {name}" if name else ""


def _open_trace(path: Path) -> Any:
    if path.suffix.lower() not in TRACE_SUFFIXES:
        raise ConfigError(
            f"no trace format for {path.suffix or 'a file without suffix'!r}",
            where=f"--trace-can {path}",
            hint=f"use one of {', '.join(TRACE_SUFFIXES)}",
        )
    try:
        return can.Logger(str(path))
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"the bus trace cannot be written: {error}", where=f"--trace-can {path}", hint=TRACE_HINT
        ) from error


Result = TypeVar("Result")


def in_time(
    work: Callable[[], Result], limit_s: float, *, too_late: Callable[[Result], object] = lambda result: None
) -> Result:
    """Return what the work returns, or raise what it raises; it runs in a thread of its own.

    Raises TimeoutError: it has not ended by then; the thread is left to itself and does not keep the program from
    ending.

    Parameters
    ----------
    limit_s : float
        Seconds that are waited for it.
    too_late : callable
        Takes a result that came after all.
    """
    done: list[Result] = []
    failed: list[BaseException] = []
    given_up = threading.Event()

    def run() -> None:
        try:
            done.append(work())
            if given_up.is_set():
                too_late(done[0])
        except BaseException as error:
            failed.append(error)

    worker = threading.Thread(target=run, name="pmsmtool bounded call", daemon=True)
    try:
        worker.start()
        worker.join(limit_s)
    finally:
        given_up.set()
    if failed:
        raise failed[0]
    if not done:
        raise TimeoutError(f"no answer within {limit_s:g} s")
    return done[0]


@dataclass(frozen=True, slots=True)
class SetUp:
    """What an adapter needs on one system."""

    install: str
    """What to install or to run once."""
    type: str
    """The bus options then."""


def _kernel(driver: str) -> SetUp:
    return SetUp(f"nothing (the kernel's driver {driver} serves it), run `{_BRING_UP}`", _SOCKETCAN)


ADAPTERS: Mapping[str, tuple[str, Mapping[str, SetUp]]] = {
    "pcan": (
        "PEAK PCAN-USB",
        {
            "linux": _kernel("peak_usb"),
            "win32": SetUp("PEAK's device driver with PCAN-Basic", "-i pcan -c PCAN_USBBUS1 -b 500000"),
            "darwin": SetUp("the PCBUSB library of MacCAN", "-i pcan -c PCAN_USBBUS1 -b 500000"),
        },
    ),
    "ixxat": (
        "IXXAT USB-to-CAN",
        {
            "linux": SetUp(f"HMS's SocketCAN driver (ix_usb_can), run `{_BRING_UP}`", _SOCKETCAN),
            "win32": SetUp("HMS's VCI driver, version 4", "-i ixxat -c 0 -b 500000"),
        },
    ),
    "kvaser": (
        "Kvaser",
        {
            "linux": _kernel("kvaser_usb"),
            "win32": SetUp("Kvaser's drivers (CANlib)", "-i kvaser -c 0 -b 500000"),
        },
    ),
    "slcan": (
        "serial line (slcan: CANable, Lawicel)",
        {
            "linux": SetUp(
                f"pyserial (`{_PYTHON} pyserial`), and join the group dialout", "-i slcan -c /dev/ttyACM0 -b 500000"
            ),
            "win32": SetUp(f"pyserial (`{_PYTHON} pyserial`)", "-i slcan -c COM3 -b 500000"),
            "darwin": SetUp(f"pyserial (`{_PYTHON} pyserial`)", "-i slcan -c /dev/tty.usbmodem1 -b 500000"),
        },
    ),
    "gs_usb": (
        "gs_usb (candleLight, CANable 2)",
        {
            "linux": _kernel("gs_usb"),
            "win32": SetUp(
                f"gs_usb (`{_PYTHON} 'python-can[gs-usb]'`), and WinUSB for it (Zadig)", "-i gs_usb -c 0 -b 500000"
            ),
            "darwin": SetUp(f"gs_usb (`{_PYTHON} 'python-can[gs-usb]'`), and libusb", "-i gs_usb -c 0 -b 500000"),
        },
    ),
}
"""Name of python-can's interface: what people call the adapter, and the set-up by ``sys.platform``."""

_CALLED: Mapping[str, str] = {
    **dict.fromkeys(("peak", "pcanusb", "pcanbasic", "peakcan"), "pcan"),
    **dict.fromkeys(("hms", "vci", "usbtocan"), "ixxat"),
    **dict.fromkeys(("canlib", "leaf"), "kvaser"),
    **dict.fromkeys(("lawicel", "canusb", "serialcan"), "slcan"),
    **dict.fromkeys(("gsusb", "candlelight", "candle", "canable"), "gs_usb"),
    **dict.fromkeys(("can", "can0", "vcan0", "linux"), "socketcan"),
    **dict.fromkeys(("sim", "simulated"), "pmsmsim"),
}
_NEAR = 0.6
"""Similarity from which a name is offered (difflib): ``pcna`` and ``pcan`` have 0.75."""


def meant_interface(name: str, known: Iterable[str]) -> str:
    """Return the interface that a name which is none most likely means; empty when none is near."""
    plain = name.lower().replace("-", "").replace("_", "").replace(" ", "")
    if plain in _CALLED:
        return _CALLED[plain]
    by_plain = {each.replace("_", ""): each for each in known}
    near = get_close_matches(plain, [*by_plain, *_CALLED], 1, _NEAR)
    return "" if not near else by_plain.get(near[0]) or _CALLED[near[0]]


def how_to_set_up(interface: str, system: str = sys.platform) -> str:
    """Return what to install and to type for an adapter on a system; empty for one that is not listed."""
    if interface not in ADAPTERS:
        return ""
    name, systems = ADAPTERS[interface]
    found = systems.get(system)
    if found is None:
        return f"{name}: no driver for this system; take one with SocketCAN under Linux"
    return f"{name}: install {found.install}; then type {found.type}"
