# SPDX-License-Identifier: MIT
"""The objects the tool uses are those of the reference drive's EDS."""

from __future__ import annotations

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from pmsmtool.drive import objects
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, ProfileMove, Recording, Shape
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


def test_what_an_experiment_does_not_ask_for_is_not_done() -> None:
    """The drive gets every field: one that was left out must change nothing."""
    plain = Excitation(Shape.STEP, Injection.I_Q, 1.0)
    left_out = {name: getattr(plain, name) for name in objects.EXCITATION_FIELDS} | {"lead_s": plain.lead_s}
    for name in ("shape", "point", "amplitude"):
        del left_out[name]
    assert left_out.pop("hold_periods") == 1 and left_out.pop("fixed_angle_rad") is None
    assert set(left_out.values()) == {0.0} and plain.buffer == ()
    record, move = Recording((), 10), ProfileMove(1, 2, 3)
    assert (record.decimation, record.pretrigger, record.excitation, record.move, move.jerk) == (1, 0, None, None, 0)


def test_numbers_of_shapes_and_injection_points_are_the_interfaces() -> None:
    shapes = ("NONE", "STEP", "SINE", "CHIRP", "PRBS", "BUFFER", "SQUARE", "DC", "HYSTERESIS")
    assert {shape.name: shape.value for shape in Shape} == {name: k for k, name in enumerate(shapes)}
    assert {point.name: point.value for point in Injection} == {"U_D": 0, "U_Q": 1, "I_D": 2, "I_Q": 3, "SPEED": 4}


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
