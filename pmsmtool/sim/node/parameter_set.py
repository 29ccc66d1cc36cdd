# SPDX-License-Identifier: MIT
"""The drive's parameter set: active values, a staging copy, and the commands between them (objects 0x2000, 0x2001).

While a set is staged, writes to the parameters, the tables' DOMAINs and the image go to the staging copy and are read
back from there; nothing acts until the set was validated (ranges, look-up table, CRC-32 against the expected one) and
activated as a whole. Without staging a parameter may be written directly while the power stage is off, a live gain
always; tables and their descriptors change by staging only, because a half-written table has no meaning.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import partial
from itertools import pairwise

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.firmware.image import (
    LUT_FORMAT_BINARY32,
    LUT_FORMAT_NONE,
    SCALAR_BYTES,
    ImageRefused,
    ImageStatus,
    crc32,
    unpack_image,
)
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE, LUT_CAPACITY_WORDS, SATURATION_VALUES, Parameter
from pmsmtool.params.parameter_set import SATURATION, to_binary32
from pmsmtool.sim.node.dictionary import Dictionary, Refused

LUT_PARTS = ("lut.axis_x", "lut.axis_y", "lut.axis_z", "lut.table_i_d", "lut.table_i_q")
"""Keys of the look-up DOMAIN objects."""
PARTS = (*LUT_PARTS, SATURATION)
"""Keys of all table DOMAINs, in the order of the image."""
_MAX_LUT_BYTES = 4 * LUT_CAPACITY_WORDS
_WORD = struct.Struct("<I")
_REAL = struct.Struct("<f")
_ROW_NUMBER = {row.name: number for number, row in enumerate(CATALOGUE)}


class SetState(IntEnum):
    """Object 0x2000:07."""

    NONE = 0
    STAGING = 1
    VALID = 2
    ACTIVE = 3
    REJECTED = 4


class SetCommand(IntEnum):
    """Object 0x2000:06."""

    IDLE = 0
    BEGIN = 1
    VALIDATE = 2
    ACTIVATE = 3
    DISCARD = 4


class ParameterImage:
    """Scalar words and look-up parts of one set; may be inconsistent while it is being written."""

    def __init__(self, words: bytes, parts: Mapping[str, bytes]) -> None:
        self.words = bytearray(words)
        self.parts = dict(parts)

    @classmethod
    def of_values(cls, values: Mapping[str, float]) -> ParameterImage:
        """Return the image of factory defaults, changed by ``values`` (catalogue names, SI)."""
        image = cls(bytes(SCALAR_BYTES), dict.fromkeys(PARTS, b""))
        for row in CATALOGUE:
            image.set(row.name, values.get(row.name, row.default))
        return image

    @classmethod
    def of_bytes(cls, image: bytes) -> ParameterImage:
        """Return the image of packed bytes whose size is not checked yet; surplus stays in the last part."""
        made = cls(image[:SCALAR_BYTES], dict.fromkeys(PARTS, b""))
        position = SCALAR_BYTES
        for key, (_, padded) in made.part_sizes().items():
            made.parts[key] = image[position : position + padded]
            position += padded
        made.parts[PARTS[-1]] += image[position:]
        return made

    def copy(self) -> ParameterImage:
        """Return an independent copy."""
        return ParameterImage(bytes(self.words), self.parts)

    def get(self, name: str) -> float:
        """Return a value by catalogue name, in SI."""
        code = _WORD if BY_NAME[name].is_integer else _REAL
        value: float = code.unpack_from(self.words, 4 * _ROW_NUMBER[name])[0]
        return value

    def set(self, name: str, value: float) -> None:
        """Set a value by catalogue name, in SI."""
        if BY_NAME[name].is_integer:
            _WORD.pack_into(self.words, 4 * _ROW_NUMBER[name], int(value))
        else:
            _REAL.pack_into(self.words, 4 * _ROW_NUMBER[name], value)

    def wire(self, row: Parameter, size: int) -> bytes:
        """Return a value as its object travels: the low bytes of its word."""
        offset = 4 * _ROW_NUMBER[row.name]
        return bytes(self.words[offset : offset + size])

    def set_wire(self, row: Parameter, data: bytes) -> None:
        """Set a value from the bytes of its object, widened to a word."""
        offset = 4 * _ROW_NUMBER[row.name]
        self.words[offset : offset + 4] = data.ljust(4, b"\0")

    def part_sizes(self) -> dict[str, tuple[int, int]]:
        """Return (bytes, bytes padded to words) that the descriptor announces for each part."""
        kind = int(self.get("lut.format"))
        nodes = 4 * SATURATION_VALUES * int(self.get("saturation.n_d") * self.get("saturation.n_q"))
        if kind == LUT_FORMAT_NONE:
            return {**dict.fromkeys(LUT_PARTS, (0, 0)), SATURATION: (nodes, nodes)}
        counts = [int(self.get(f"lut.n_{axis}")) for axis in "xyz"]
        table = math.prod(counts) * (4 if kind == LUT_FORMAT_BINARY32 else 2)
        sizes = [4 * count for count in counts] + [table, table, nodes]
        return {key: (size, -(-size // 4) * 4) for key, size in zip(PARTS, sizes, strict=True)}

    def pack(self) -> bytes:
        """Return the packed image; parts of a wrong length go in as they are, for validation to find."""
        sizes = self.part_sizes()
        used = (key for key in PARTS if sizes[key][1])
        return bytes(self.words) + b"".join(self.parts[key].ljust(sizes[key][1], b"\0") for key in used)

    def first_offender(self) -> tuple[str, ImageStatus] | None:
        """Return key and reason of the first thing wrong with the set, None when the core would take it."""
        for row in CATALOGUE:
            value = self.get(row.name)
            if not to_binary32(row.minimum) <= value <= to_binary32(row.maximum):
                return row.name, ImageStatus.RANGE
        offender = self._lut_offender()
        if offender is not None:
            return offender
        try:
            unpack_image(self.pack())
        except ImageRefused as refused:
            return "parameter_set.image", refused.status
        return None

    def _lut_offender(self) -> tuple[str, ImageStatus] | None:
        sizes = self.part_sizes()
        if len(self.parts[SATURATION]) != sizes[SATURATION][0] != 0:
            return SATURATION, ImageStatus.LUT_SIZE
        if int(self.get("lut.format")) == LUT_FORMAT_NONE:
            return None
        for axis, fewest in (("x", 2), ("y", 2), ("z", 1)):
            if self.get(f"lut.n_{axis}") < fewest:
                return f"lut.n_{axis}", ImageStatus.LUT_SIZE
        for key, (size, padded) in sizes.items():
            if key in LUT_PARTS and len(self.parts[key]) not in (size, padded):
                return key, ImageStatus.LUT_SIZE
        if sum(padded for _, padded in sizes.values()) > _MAX_LUT_BYTES:
            return "lut.table_i_q", ImageStatus.LUT_SIZE
        for key in LUT_PARTS[:3]:
            nodes = struct.unpack(f"<{len(self.parts[key]) // 4}f", self.parts[key])
            if not all(map(math.isfinite, nodes)) or any(b <= a for a, b in pairwise(nodes)):
                return key, ImageStatus.LUT_AXIS
        return None


class ParameterSet:
    """Objects 0x2000, 0x2001, 0x2042 to 0x2046, 0x2049 and every parameter of the catalogue.

    Parameters
    ----------
    dictionary : Dictionary
        Its entries are hooked up here.
    active : ParameterImage
        The set the drive starts with.
    energised : callable
        Whether the power stage may drive current now.
    activated : callable
        Called after the active set changed; the core must take it.

    Attributes
    ----------
    stored_crc : int
        CRC-32 of the set in non-volatile memory, 0 when there is none.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        active: ParameterImage,
        energised: Callable[[], bool],
        activated: Callable[[], None],
    ) -> None:
        self.active = active
        self.staging: ParameterImage | None = None
        self.state = SetState.NONE
        self.stored_crc = 0
        self._offender = 0
        self._dictionary = dictionary
        self._energised = energised
        self._activated = activated
        self._active_crc: int | None = None
        self._hook()

    def _hook(self) -> None:
        entries = self._dictionary.by_key
        for row in CATALOGUE:
            entry = entries[row.name]
            entry.source = self._parameter_source(row, entry.size)
            entry.sink = partial(self._take_parameter, row)
        for key in PARTS:
            entries[key].source = self._part_source(key)
            entries[key].sink = partial(self._take_part, key)
        entries["parameter_set.image"].source = lambda: self._shown().pack()
        entries["parameter_set.image"].sink = self._write_image
        entries["parameter_set.command"].sink = self._command
        entries["parameter_set.crc_active"].shows(lambda: self.active_crc)
        entries["parameter_set.crc_stored"].shows(lambda: self.stored_crc)
        entries["parameter_set.state"].shows(lambda: self.state)
        entries["parameter_set.first_offender"].shows(lambda: self._offender)

    def _parameter_source(self, row: Parameter, size: int) -> Callable[[], bytes]:
        return lambda: (self.staging or self.active).wire(row, size)

    def _take_parameter(self, row: Parameter, data: bytes) -> None:
        if self.staging is not None:
            self.staging.set_wire(row, data)
            self._restage()
            return
        if row.name.startswith(("lut.", "saturation.")) or (self._energised() and not row.live):
            raise Refused(AbortCode.DEVICE_STATE)
        self.active.set_wire(row, data)
        self.state = SetState.NONE
        self.announce()

    def _part_source(self, key: str) -> Callable[[], bytes]:
        return lambda: self._shown().parts[key]

    def _take_part(self, key: str, data: bytes) -> None:
        if self.staging is None:
            raise Refused(AbortCode.DEVICE_STATE)
        if len(data) > _MAX_LUT_BYTES:
            raise Refused(AbortCode.TOO_LONG)
        self.staging.parts[key] = data
        self._restage()

    def _shown(self) -> ParameterImage:
        return self.staging or self.active

    def _restage(self) -> None:
        self.state = SetState.STAGING

    def _write_image(self, data: bytes) -> None:
        if self.staging is None:
            raise Refused(AbortCode.DEVICE_STATE)
        if len(data) < SCALAR_BYTES:
            raise Refused(AbortCode.TOO_SHORT)
        if len(data) > SCALAR_BYTES + _MAX_LUT_BYTES:
            raise Refused(AbortCode.TOO_LONG)
        self.staging = ParameterImage.of_bytes(data)
        self._restage()

    def _command(self, data: bytes) -> None:
        command = SetCommand(data[0])
        if command is SetCommand.BEGIN:
            self.staging = self.active.copy()
            self.state = SetState.STAGING
            self._offender = 0
        elif command is SetCommand.VALIDATE:
            self._validate()
        elif command is SetCommand.ACTIVATE:
            self._activate()
        elif command is SetCommand.DISCARD:
            self.staging = None
            self.state = SetState.NONE
            self._offender = 0
        self._dictionary["parameter_set.command"].value = data

    def _validate(self) -> None:
        if self.staging is None:
            raise Refused(AbortCode.DEVICE_STATE)
        offender = self.staging.first_offender()
        expected = self._dictionary["parameter_set.crc_expected"].integer()
        if offender is None and crc32(self.staging.pack()) != expected:
            offender = "parameter_set.crc_expected", ImageStatus.CRC
        if offender is None:
            self.state, self._offender = SetState.VALID, 0
            return
        row = self._dictionary[offender[0]].row
        self.state = SetState.REJECTED
        self._offender = row.index << 16 | row.sub << 8 | offender[1]

    def _activate(self) -> None:
        if self.staging is None or self.state is not SetState.VALID or self._energised():
            raise Refused(AbortCode.DEVICE_STATE)
        self.active, self.staging = self.staging, None
        self.state = SetState.ACTIVE
        self.announce()

    @property
    def active_crc(self) -> int:
        """CRC-32 of the active set."""
        if self._active_crc is None:
            self._active_crc = crc32(self.active.pack())
        return self._active_crc

    def announce(self) -> None:
        """Tell the core that the active set changed."""
        self._active_crc = None
        self._activated()
