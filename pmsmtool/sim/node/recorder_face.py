# SPDX-License-Identifier: MIT
"""What the simulated makers' recorders have in common: registers, and the recorder of the drive behind them."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.data_types import DATA_TYPES
from pmsmtool.drive_maps.recorder_map import Address
from pmsmtool.drive_maps.wire_units import wire_unit
from pmsmtool.sim.kernel import Signal
from pmsmtool.sim.node.dictionary import Dictionary, Entry, Refused
from pmsmtool.sim.node.drive_core import RecorderSetup, RecorderState
from pmsmtool.sim.node.objects import ObjectRow
from pmsmtool.sim.node.power_drive import Plant

SIGNALS = {
    "position_rad": Signal.THETA_M,
    "omega_M_rad_s": Signal.OMEGA_E,
    "torque_nm": Signal.TAU,
    "i_q_a": Signal.I_Q,
    "i_d_a": Signal.I_D,
    "i_q_ref_a": Signal.I_Q_REF,
    "asked_u_q": Signal.U_Q,
    "u_q_v": Signal.U_Q,
    "u_d_v": Signal.U_D,
    "U_dc_v": Signal.U_DC,
}
"""Signals of a map, and the core's behind each; the speed is electrical there."""
_TYPES = {row.letter: row.short for row in DATA_TYPES.values() if row.is_integer and row.name != "BOOLEAN"}


class RecorderFace:
    """Registers of one session's recorder.

    Parameters
    ----------
    dictionary : Dictionary
        Dressed as the family's.
    plant : Plant
        The drive behind.
    """

    def __init__(self, dictionary: Dictionary, plant: Plant) -> None:
        self._dictionary = dictionary
        self._plant = plant
        self._entries: dict[Address, Entry] = {}

    def _register(self, *addresses: Address) -> None:
        for index, sub, letter in addresses:
            entry = Entry(ObjectRow(index, sub, "", "Recorder", _TYPES[letter], "rw", default="0"))
            self._entries[index, sub, letter] = entry
            self._dictionary.show(entry)

    def _shows(self, address: Address, value: Callable[[], int]) -> None:
        """Make a register that shows a number of the recorder's own."""
        self._register(address)
        entry = self._entries[address]
        entry.row = replace(entry.row, access="ro")
        entry.writable = False
        entry.shows(value)

    def _takes(self, address: Address, sink: Callable[[bytes], None], defined: Container[int] | None = None) -> None:
        """Make a register whose writing does something; the sink keeps the bytes where they count.

        Where the maker defines a few values only, every other one is refused: a drive need not do anything sensible
        with it.
        """
        self._register(address)

        def strict(data: bytes) -> None:
            if defined is not None and int.from_bytes(data, "little") not in defined:
                raise Refused(AbortCode.VALUE)
            sink(data)

        self._entries[address].sink = strict

    def _keeps(self, address: Address, defined: Container[int]) -> None:
        """Make a register that keeps one of the values the maker defines."""
        self._takes(address, lambda data: self._keep(address, data), defined)

    def _gives(self, index: int, data: Callable[[], bytes]) -> None:
        """Make a DOMAIN."""
        entry = Entry(ObjectRow(index, 0, "", "Recorder", "DOMAIN", "ro"))
        entry.source = data
        self._dictionary.show(entry)

    def _number(self, address: Address) -> int:
        return self._entries[address].integer()

    def _keep(self, address: Address, data: bytes) -> None:
        self._entries[address].value = data

    # ---- the recorder behind --------------------------------------------------------------------

    def _record(self, names: Sequence[str], depth: int, decimation: int) -> None:
        self._plant.look()
        channels = [SIGNALS[name] for name in names]
        self._plant.core.record(RecorderSetup(channels=channels, depth=depth, decimation=decimation))

    def _forget(self) -> None:
        self._plant.look()
        self._plant.core.record(None)

    def _stored(self) -> int:
        self._plant.look()
        return self._plant.core.recorder().stored

    def _complete(self) -> bool:
        self._plant.look()
        return self._plant.core.recorder().state is RecorderState.COMPLETE

    def _counts(self, names: Sequence[str], units: Sequence[str]) -> NDArray[np.float64]:
        """Return the rows stored, in counts."""
        rows = np.frombuffer(self._plant.core.recording(), "<f4").reshape(-1, len(names)).astype(np.float64)
        for k, (name, unit) in enumerate(zip(names, units, strict=True)):
            if name == "omega_M_rad_s":
                rows[:, k] /= max(1.0, self._plant.parameter("motor.pole_pairs"))
            rows[:, k] /= wire_unit(unit).scale
        return rows


def whole(counts: NDArray[np.float64], kind: str) -> NDArray[np.generic]:
    """Return counts as whole numbers of a type, cut to its range."""
    bounds = np.iinfo(np.dtype(kind))
    return np.clip(np.round(counts), bounds.min, bounds.max).astype(kind)
