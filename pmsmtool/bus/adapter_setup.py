# SPDX-License-Identifier: MIT
"""What the usual USB adapters need on which system, and what is typed then; which interface a misspelt name means.

By the makers' pages and python-can's documentation of each interface. On Linux the kernel brings most of them up as a
network device, whoever made them: python-can's own interface of the maker is not needed then.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches

_BRING_UP = "sudo ip link set can0 up type can bitrate 500000"
_SOCKETCAN = "-i socketcan -c can0"
_PYTHON = "python -m pip install"


@dataclass(frozen=True, slots=True)
class SetUp:
    """What an adapter needs on one system.

    Attributes
    ----------
    install : str
        What to install or to run once.
    type : str
        The bus options then.
    """

    install: str
    type: str


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
