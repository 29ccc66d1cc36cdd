# SPDX-License-Identifier: MIT
"""What a simulated drive needs of the dictionary that it shows instead of its own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from pmsmtool.bus.clock import Schedule
    from pmsmtool.sim.node.dictionary import Dictionary
    from pmsmtool.sim.node.power_drive import Plant, PowerDrive
    from pmsmtool.sim.node.session import Session


class Guarding(Protocol):
    """Node guarding (objects 0x100C, 0x100D)."""

    def asked(self) -> None:
        """Take a remote frame."""


class DriveFace(Protocol):
    """Another dictionary over the same application."""

    @property
    def vendor_product(self) -> tuple[int, int]:
        """Vendor and product that 0x1018 shows."""

    @property
    def label(self) -> str:
        """Beginning of the device name."""

    def dress(self, dictionary: Dictionary) -> None:
        """Change a dictionary whose application is not hooked up yet."""

    def attach(self, dictionary: Dictionary, plant: Plant, power: PowerDrive, schedule: Schedule) -> None:
        """Put own functions over the running application."""

    def guarding(self, session: Session) -> Guarding | None:
        """Return node guarding where the drive has it."""
