# SPDX-License-Identifier: MIT
"""The objects the tool uses are those of the reference drive's EDS."""

from __future__ import annotations

import canopen
import pytest
from canopen.objectdictionary import ODVariable

from pmsmtool.drive import motion_objects, objects, set_point, standard_drive
from pmsmtool.drive.objects import DriveObject
from pmsmtool.drive.port import Excitation, Injection, ProfileMove, Recording, Shape
from pmsmtool.files import data_folder

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


ON_OTHER_DRIVES = {"GUARD_TIME_MS", "LIFE_TIME_FACTOR"}
"""Objects that the tool reads where a drive has them, and the reference drive has not."""


MEANT = {
    "ABORT_CONNECTION": "Abort connection option code", "AVERAGE_COMMAND": "Command",
    "AVERAGE_PERIODS": "Window length", "AVERAGE_STATE": "State", "CONFIGURATION_DATE": "Configuration date",
    "CONFIGURATION_TIME": "Configuration time", "CONTROLWORD": "Controlword",
    "CURRENT_PERMILLE": "Current actual value", "DC_LINK_MV": "DC link circuit voltage", "DEVICE_TYPE": "Device type",
    "ENCODER_INCREMENTS": "Encoder increments", "ERROR_CODE": "Error code", "ERROR_REGISTER": "Error register",
    "EXCITATION_COMMAND": "Command", "EXCITATION_FIELDS.abort_current_apk": "Abort current",
    "EXCITATION_FIELDS.abort_speed_rad_s": "Abort speed, electrical", "EXCITATION_FIELDS.amplitude": "Amplitude",
    "EXCITATION_FIELDS.amplitude_q": "Amplitude of the second axis",
    "EXCITATION_FIELDS.bias_bandwidth_rad_s": "Bandwidth of the current loop that holds the bias",
    "EXCITATION_FIELDS.bias_d_a": "Bias d", "EXCITATION_FIELDS.bias_q_a": "Bias q",
    "EXCITATION_FIELDS.duration_s": "Duration", "EXCITATION_FIELDS.f0_hz": "Start frequency",
    "EXCITATION_FIELDS.f1_hz": "End frequency", "EXCITATION_FIELDS.fixed_angle_rad": "Fixed electrical angle",
    "EXCITATION_FIELDS.hold_periods": "Hold time per level",
    "EXCITATION_FIELDS.i_centre_d_a": "Centre of the d pulses",
    "EXCITATION_FIELDS.i_limit_d_a": "Current that flips the d pulses",
    "EXCITATION_FIELDS.i_limit_q_a": "Current that flips the q pulses", "EXCITATION_FIELDS.point": "Injection point",
    "EXCITATION_FIELDS.shape": "Shape", "FAULT_REACTION": "Fault reaction option code",
    "LIVE.T_magnet_c": "Magnet temperature", "LIVE.T_winding_c": "Winding temperature",
    "LIVE.U_dc_v": "DC-link voltage", "LIVE.binding": "Governor", "LIVE.flags": "Flags",
    "LIVE.following_error_rad": "Following error, mechanical", "LIVE.hall_pattern": "Hall wires, bit k of wire k",
    "LIVE.i_a_a": "Phase current a", "LIVE.i_b_a": "Phase current b", "LIVE.i_c_a": "Phase current c",
    "LIVE.i_d_a": "i_d, sampled", "LIVE.i_d_ref_a": "i_d reference after the governor",
    "LIVE.i_d_req_a": "i_d reference before the governor", "LIVE.i_q_a": "i_q, sampled",
    "LIVE.i_q_ref_a": "i_q reference after the governor", "LIVE.i_q_req_a": "i_q reference before the governor",
    "LIVE.iterations": "Solver iterations of the period", "LIVE.kappa": "Governor",
    "LIVE.omega_e_rad_s": "Electrical speed", "LIVE.theta_e_rad": "Electrical angle",
    "LIVE.theta_m_rad": "Mechanical angle, encoder, unwrapped",
    "LIVE.torque_nm": "Torque from currents and parameters", "LIVE.u_d_lim_v": "u_d after the limiter",
    "LIVE.u_d_v": "u_d command before the limiter", "LIVE.u_q_lim_v": "u_q after the limiter",
    "LIVE.u_q_v": "u_q command before the limiter", "MAX_CURRENT_PERMILLE": "Max current",
    "MAX_SPEED_RPM": "Max motor speed", "MODE": "Modes of operation", "MODE_DISPLAY": "Modes of operation display",
    "PRODUCER_HEARTBEAT_MS": "Producer heartbeat time", "PROFILE_ACCELERATION": "Profile acceleration",
    "PROFILE_DECELERATION": "Profile deceleration", "PROFILE_JERK": "Jerk of every ramp, 0",
    "PROFILE_VELOCITY": "Profile velocity", "QUICK_STOP_DECELERATION": "Quick stop deceleration",
    "QUICK_STOP_OPTION": "Quick stop option code", "RATED_CURRENT_MA": "Motor rated current",
    "SET_COMMAND": "Command", "SET_CRC_ACTIVE": "Active value CRC32", "SET_CRC_EXPECTED": "Expected value CRC32",
    "SET_CRC_STORED": "Stored value CRC32", "SET_OFFENDER": "First offending object",
    "SET_POINT_ANGLE": "Fixed electrical angle", "SET_POINT_D": "i_d", "SET_POINT_Q": "i_q",
    "SET_SCHEMA": "Schema version", "SET_SIGNATURE": "Layout signature", "SET_STATE": "State",
    "STATUSWORD": "Statusword", "SUPPORTED_MODES": "Supported drive modes", "TARGET_TORQUE_PERMILLE": "Target torque",
    "TARGET_VELOCITY_MRPM": "Target velocity", "TRACE_CAPACITY": "Capacity", "TRACE_COMMAND": "Command",
    "TRACE_CRC": "CRC32 of the data", "TRACE_DECIMATION": "Decimation", "TRACE_DEPTH": "Depth",
    "TRACE_PERIOD_NS": "Sample period", "TRACE_POSITION": "Trigger position", "TRACE_PRETRIGGER": "Pre-trigger",
    "TRACE_STATE": "State", "TRACE_STORED": "Samples stored", "TRACE_TRIGGER": "Trigger",
    "TRACE_VOLTAGE_LAG": "The voltage of row k - this acts from row k on", "VELOCITY_MRPM": "Velocity actual value",
}  # fmt: skip
"""How the reference drive's data sheet calls them."""
NUMBERED = {
    "TRACE_CHANNELS": "Channel {}", "AVERAGE_MEANS": "Mean of channel {}", "AVERAGE_CHANNELS": "Channel {}",
}  # fmt: skip
OTHER_ADDRESSES = {
    "DEVICE_NAME": (0x1008, 0), "HARDWARE_VERSION": (0x1009, 0), "SOFTWARE_VERSION": (0x100A, 0),
    "STORE_ALL": (0x1010, 1), "SET_IMAGE": (0x2001, 0), "EXCITATION_BUFFER": (0x2051, 0), "TRACE_DATA": (0x2062, 0),
    "ERROR_HISTORY": 0x1003, "CONSUMER_HEARTBEAT": 0x1016, "IDENTITY": 0x1018,
    "GUARD_TIME_MS": DriveObject(0x100C, 0, "H"), "LIFE_TIME_FACTOR": DriveObject(0x100D, 0, "B"),
}  # fmt: skip
"""Texts, domains, records, and what the reference drive has not."""


@pytest.mark.parametrize("name", sorted(set(all_objects()) - ON_OTHER_DRIVES))
def test_index_sub_and_type(dictionary: canopen.ObjectDictionary, name: str) -> None:
    item = all_objects()[name]
    variable = dictionary.get_variable(item.index, item.sub)
    assert isinstance(variable, ODVariable), f"{name} is not in the EDS"
    assert LETTERS[variable.data_type or 0] == item.letter and variable.subindex == item.sub
    group, _, number = name.rstrip("]").partition("[")
    meant = NUMBERED[group].format(int(number) + 1) if number else MEANT[name]
    assert variable.name.startswith(meant), "another object of the same type"


def test_addresses_of_texts_domains_and_records() -> None:
    assert {name: getattr(objects, name) for name in OTHER_ADDRESSES} == OTHER_ADDRESSES
    for group in NUMBERED:
        assert len(getattr(objects, group)) == 8


OF_THE_STANDARD = {
    motion_objects.ENCODER_COUNTS: (0x608F, 1, "I"), motion_objects.MOTOR_TURNS: (0x608F, 2, "I"),
    motion_objects.POSITION: (0x6064, 0, "i"), motion_objects.MAX_TORQUE_PERMILLE: (0x6072, 0, "H"),
    motion_objects.TORQUE_PERMILLE: (0x6077, 0, "h"), motion_objects.POLARITY: (0x607E, 0, "B"),
    motion_objects.GEAR_MOTOR: (0x6091, 1, "I"), motion_objects.GEAR_SHAFT: (0x6091, 2, "I"),
    motion_objects.FEED: (0x6092, 1, "I"), motion_objects.FEED_TURNS: (0x6092, 2, "I"),
    motion_objects.POSITION_UNIT: (0x60A8, 0, "I"), motion_objects.TORQUE_SLOPE: (0x6087, 0, "I"),
    motion_objects.PERIOD_VALUE: (0x60C2, 1, "B"), motion_objects.PERIOD_EXPONENT: (0x60C2, 2, "b"),
    set_point.TARGET_POSITION: (0x607A, 0, "i"), set_point.POSITION_DEMAND: (0x6062, 0, "i"),
    standard_drive.COMMUTATION_ANGLE: (0x60EA, 0, "H"), objects.DC_LINK_MV: (0x6079, 0, "I"),
}  # fmt: skip


def test_objects_of_motion_are_those_of_the_standard() -> None:
    """CiA 402-2 by clause; most of them the reference drive has not."""
    for item, address in OF_THE_STANDARD.items():
        assert (item.index, item.sub, item.letter) == address


@pytest.mark.parametrize(
    ("letter", "length", "other"),
    [("H", 4, "I"), ("h", 4, "i"), ("I", 2, "H"), ("i", 1, "b"), ("B", 8, "Q"), ("H", 2, "H"), ("H", 3, None),
     ("f", 4, "f"), ("f", 2, None), ("H", 0, None)],
)  # fmt: skip
def test_a_whole_number_in_another_width(letter: str, length: int, other: str | None) -> None:
    found = DriveObject(0x6075, 3, letter).of_length(length)
    assert found == (None if other is None else DriveObject(0x6075, 3, other))


@pytest.mark.parametrize(
    ("letter", "value", "data", "back"),
    [
        ("b", -1, b"\xff", -1.0), ("B", 254.6, b"\xff", 255.0), ("h", -2.4, b"\xfe\xff", -2.0),
        ("H", 0x1234, b"\x34\x12", 4660.0), ("i", -3, b"\xfd\xff\xff\xff", -3.0),
        ("I", 2**32 - 1, b"\xff" * 4, 2.0**32 - 1),
        ("f", 0.5, b"\0\0\0\x3f", 0.5),
    ],
)  # fmt: skip
def test_a_number_in_an_object(letter: str, value: float, data: bytes, back: float) -> None:
    item = DriveObject(0x2070, 0x1A, letter)
    assert item.encode(value) == data and item.decode(data) == back and item.size == len(data)
    assert item.mapping_word == 0x2070_1A_00 + 8 * len(data)


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
