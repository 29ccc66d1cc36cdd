# SPDX-License-Identifier: MIT
"""The objects the tool uses are those of the reference drive's EDS."""

from __future__ import annotations

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation
from pmsmtool.resources import data_folder

LETTERS = {0x02: "b", 0x03: "h", 0x04: "i", 0x05: "B", 0x06: "H", 0x07: "I", 0x08: "f"}


def all_objects() -> dict[str, DriveObject]:
    found = {name: item for name, item in vars(objects).items() if isinstance(item, DriveObject)}
    for group in ("EXCITATION_FIELDS", "LIVE"):
        found |= {f"{group}.{name}": item for name, item in getattr(objects, group).items()}
    for group in ("TRACE_CHANNELS", "AVERAGE_MEANS", "AVERAGE_CHANNELS"):
        found |= {f"{group}[{k}]": item for k, item in enumerate(getattr(objects, group))}
    return found


@pytest.fixture(scope="module")
def dictionary() -> canopen.ObjectDictionary:
    return canopen.import_od(str(data_folder("firmware-params") / "pmsmsim" / "pmsmsim.eds"))


ON_OTHER_DRIVES = {"PROFILE_DECELERATION", "GUARD_TIME_MS", "LIFE_TIME_FACTOR"}
"""Objects that the tool reads where a drive has them, and the reference drive has not."""


@pytest.mark.parametrize("name", sorted(set(all_objects()) - ON_OTHER_DRIVES))
def test_index_sub_and_type(dictionary: canopen.ObjectDictionary, name: str) -> None:
    item = all_objects()[name]
    variable = dictionary.get_variable(item.index, item.sub)
    assert isinstance(variable, ODVariable), f"{name} is not in the EDS"
    assert LETTERS[variable.data_type or 0] == item.letter


def test_every_field_of_an_excitation_has_an_object() -> None:
    elsewhere = {"buffer", "lead_s"}  # the DOMAIN 0x2051; the tool's own order of starting things
    assert set(objects.EXCITATION_FIELDS) | elsewhere == set(Excitation.__dataclass_fields__)


def test_signal_units() -> None:
    expected = {
        "i_d_a": "A",
        "u_q_v": "V",
        "theta_e_rad": "rad",
        "omega_e_rad_s": "rad/s",
        "flags": "1",
        "T_winding_c": "degC",
    }
    assert {name: objects.signal_unit(name) for name in expected} == expected
