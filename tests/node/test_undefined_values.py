# SPDX-License-Identifier: MIT
"""Commands and choices of the simulated drives: every value the protocol does not define is refused, by its abort code.

A node that takes 2 where 1 is defined lets a tool pass that no real drive would obey.
"""

from __future__ import annotations

import pytest

from pmsmtool.bus.abort_codes import AbortCode
from pmsmtool.bus.connection import Connection
from pmsmtool.drive_maps import copley_objects, epos2_objects, ingenia_objects
from pmsmtool.drive_maps.recorder_map import Address
from pmsmtool.sim.bus import PmsmSimBus
from pmsmtool.sim.node.dictionary import Dictionary, Refused
from pmsmtool.sim.node.objects import object_rows
from tests.node.bench import Bench
from tests.node.raw_client import Aborted

VALUE = {AbortCode.VALUE, AbortCode.VALUE_HIGH, AbortCode.VALUE_LOW}
DEFINED: dict[str, tuple[int, ...]] = {
    "error.behaviour": (0, 1, 2),
    "parameter_set.command": (0, 1, 2, 3, 4),
    "excitation.shape": tuple(range(9)),
    "excitation.point": tuple(range(5)),
    "excitation.command": (0, 1, 2),
    "trace.trigger": tuple(range(7)),
    "trace.command": (0, 1, 2),
    "average.command": (0, 1),
    "cia402.abort_connection": (0, 1, 2, 3),
    "cia402.quick_stop": (0, 1, 2, 3, 5, 6, 7),
    "cia402.fault_reaction": (0, 1, 2),
    "cia402.mode": (-1, 0, 1, 3, 4, 6, 7, 8, 9, 10),
    "cia402.homing_method": (-2, -1, 17, 18, 33, 34, 37),
    "cia402.interpolation_period": range(1, 256),
    "cia402.interpolation_exponent": range(-6, 1),
    "cia402.motor_type": (10,),
    "rpdo1.type": (*range(241), 254, 255),
    "tpdo1.type": (*range(241), 254, 255),
    "error.history_length": (0,),
}
"""Values with a meaning; 0x6060 by 0x6502, PDO types by CiA 301 without those on remote request only."""


def test_every_command_and_choice_is_looked_at() -> None:
    """Objects of one byte that are written and are no parameter: a command, a choice or a count."""
    small = {row.key for row in object_rows() if row.access in ("rw", "wo") and row.type in ("U8", "I8")
             and row.parameter is None and not row.key.endswith(".count")}  # fmt: skip
    alike = {key for key in small if key[1:4] == "pdo"}
    assert small - alike <= set(DEFINED)


@pytest.mark.parametrize("key", DEFINED)
def test_the_reference_drive_refuses_what_is_not_defined(bench: Bench, key: str) -> None:
    row = next(row for row in object_rows() if row.key == key)
    signed, size = row.type.startswith("I"), row.data_type.size
    for value in range(-128, 128) if signed else range(256):
        try:
            bench.client.write(row.index, row.sub, value.to_bytes(size, "little", signed=signed))
        except Aborted as refused:
            code = refused.code
        else:
            code = None
        assert (code in VALUE) is (value not in DEFINED[key]), f"{value}: {code}"


@pytest.mark.parametrize(("index", "sub"), [(0x1010, 1), (0x1010, 4), (0x1011, 1), (0x1011, 4)])
@pytest.mark.parametrize("data", [b"\1\0\0\0", b"SAVE", b"evas", b"savf", b"\0\0\0\0"])
def test_only_the_signature_stores_and_restores(bench: Bench, index: int, sub: int, data: bytes) -> None:
    other = b"load" if index == 0x1010 else b"save"
    for wrong in (data, other):
        with pytest.raises(Aborted) as refused:
            bench.client.write(index, sub, wrong)
        assert refused.value.code in (AbortCode.NOT_STORED, AbortCode.VALUE)


FACES: dict[str, dict[Address, tuple[int, ...]]] = {
    "ingenia": {
        ingenia_objects.ENABLE: (0, 1),
        ingenia_objects.REMOVE_DATA: (1,),
        ingenia_objects.FORCE_TRIGGER: (1,),
        ingenia_objects.TRIGGER_KIND: (0, 1),
        ingenia_objects.MAPPED: tuple(range(17)),
    },
    "copley": {copley_objects.START: (0, 1)},
    "epos2": {
        epos2_objects.CONTROL: (1, 2, 0xFFFE),
        epos2_objects.CONFIGURATION: tuple(range(16)),
        epos2_objects.USED: tuple(range(5)),
    },
}


def answer(dictionary: Dictionary, index: int, sub: int, data: bytes) -> int | None:
    """Return the abort code of a write, None where it is taken."""
    try:
        dictionary.write(dictionary.writable(index, sub), data)
    except Refused as refused:
        return refused.code
    return None


@pytest.mark.parametrize("family", FACES)
def test_the_makers_recorders_refuse_what_is_not_defined(family: str) -> None:
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&drive={family}")) as connection:
        dictionary = connection.bus.line.nodes[0].session.dictionary  # type: ignore[attr-defined]
        for (index, sub, _), defined in FACES[family].items():
            for value in (*range(300), 0x7FFF, 0x8000, 0xFFFD, 0xFFFE, 0xFFFF):
                code = answer(dictionary, index, sub, value.to_bytes(2, "little"))
                assert (code in VALUE) is (value not in defined), f"0x{index:04X}: {value}: {code}"


@pytest.mark.parametrize("family", ["copley", "elmo", "epos2", "epos4", "faulhaber", "ingenia"])
def test_a_family_refuses_modes_it_does_not_have(family: str) -> None:
    with Connection(PmsmSimBus(f"interior-2k2?nv=:memory:&drive={family}")) as connection:
        dictionary = connection.bus.line.nodes[0].session.dictionary  # type: ignore[attr-defined]
        taken = {mode for mode in range(-128, 128)
                 if answer(dictionary, 0x6060, 0, mode.to_bytes(1, "little", signed=True)) is None}  # fmt: skip
        shown = dictionary.find(0x6502, 0).integer()
        of_the_standard = {mode for mode in taken if mode > 0}
        assert of_the_standard == {bit + 1 for bit in range(16) if shown >> bit & 1}
        assert len(taken) < 12
