# SPDX-License-Identifier: MIT
"""Machine files: round trips, defaults, and every violation at once with its place."""

import math
import tomllib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.errors import ConfigError, ExitCode
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_import import flux_map_npz
from pmsmtool.machine.machine_file import (
    SCHEMA,
    MachineFile,
    dump_machine_file,
    load_machine_file,
    machine_from_tables,
    machine_tables,
    parse_machine,
)
from pmsmtool.machine.machine_keys import (
    ENCODER_KEYS,
    INVERTER_KEYS,
    LIMIT_KEYS,
    MACHINE_KEYS,
    MEASURABLE,
    machine_file_keys,
)
from pmsmtool.machine.parameters import (
    EncoderParameters,
    Estimate,
    InverterParameters,
    MachineLimits,
    MachineParameters,
)
from pmsmtool.machine.simulation_keys import SIMULATION_KEYS
from pmsmtool.params.catalogue import BY_NAME

GOOD = """\
schema = "pmsmtool.machine/1"
name = "jercic"

[machine]
pole_pairs = 4
R_s_ohm = 0.137
L_d_h = 2.3e-3
L_q_h = 2.1e-3
psi_f_wb = 0.41

[inverter]
U_dc_v = 210
f_s_hz = 12e3
"""


def violations(text, **changes):
    with pytest.raises(ConfigError) as caught:
        parse_machine(text, where="m.toml", **changes)
    assert caught.value.exit_code == ExitCode.USAGE
    return caught.value.violations


def small_map():
    axis = np.linspace(-4.0, 4.0, 5)
    i_d, i_q = np.meshgrid(axis, axis, indexing="ij")
    return FluxMap(axis, axis, 0.3 + 0.02 * i_d + 1e-4 * i_d**2, 0.05 * i_q, inverse_nodes=(9, 9), meta={"a": [1]})


# -- reading ---------------------------------------------------------------------------------------------------------


def test_the_least_file():
    machine_file = parse_machine(GOOD)
    assert machine_file.name == "jercic"
    assert machine_file.machine == MachineParameters(4, 0.137, 0.0023, 0.0021, 0.41)
    assert machine_file.inverter == InverterParameters(210.0, 12000.0)
    assert machine_file.inverter.voltage_utilisation == pytest.approx(1 / math.sqrt(3))
    assert machine_file.machine.alpha_psi_per_k == -0.0012
    assert machine_file.machine.T_ref_c == 20.0
    assert machine_file.flux_map is None
    assert isinstance(machine_file.machine.pole_pairs, int)
    assert isinstance(machine_file.inverter.U_dc_v, float)


def test_all_violations_are_listed_with_their_place():
    text = """\
schema = "pmsmtool.machine/1"
name = "x"
[machine]
pole_pairs = 4.5
R_s_ohm = -1
L_d_mh = 2.3
L_d_h = "2.3mH"
L_q_h = 2.1e-3
psi_f_wb = true
f_s_hz = 12e3
I_nom_apk = 30
I_max_apk = 20
[inverter]
U_dc_v = nan
[std]
R_s_ohm = -0.1
[encoder]
direction = 0
[estimate.R_s_ohm]
value = 0.1
std = 0.001
unit = "H"
[estimate.R_s]
value = 0.1
[simulation]
inverter_model = "switch"
[sdt]
R_s_ohm = 0.1
"""
    found = violations(text)
    expected = [
        "m.toml:27: sdt: unknown key or table; did you mean std?",
        "m.toml:4: [machine] pole_pairs = 4.5 is not a whole number",
        "m.toml:5: [machine] R_s_ohm = -1 is below 1e-05 ohm (loop resistance per phase at T_ref)",
        "m.toml:6: [machine] L_d_mh: unknown key; did you mean L_d_h?",
        "m.toml:7: [machine] L_d_h is text; write the number 0.0023 (in H)",
        "m.toml:9: [machine] psi_f_wb is true or false, not a number",
        "m.toml:10: [machine] f_s_hz: unknown key; it belongs to [inverter]",
        "m.toml:14: [inverter] U_dc_v = nan is not finite",
        "m.toml:13: inverter: f_s_hz is missing (sampling and PWM frequency)",
        "m.toml:16: [std] R_s_ohm = -0.1 is below 0 ohm (of loop resistance per phase at T_ref)",
        "m.toml:26: [simulation] inverter_model = 'switch' is not one of averaged, switched; did you mean switched?",
        "m.toml:22: [estimate.R_s_ohm] unit = 'H' is not 'ohm'",
        "m.toml:23: [estimate] R_s: no key of the machine; did you mean R_s_ohm?",
        "m.toml:11: [machine] I_nom_apk = 30 is above I_max_apk = 20",
        "m.toml:18: [encoder] direction = 0, allowed are 1 and -1",
    ]
    assert sorted(found) == sorted(expected)


def test_the_message_shows_all_of_them():
    with pytest.raises(ConfigError) as caught:
        parse_machine(GOOD.replace("0.137", "-1").replace("12e3", "1"), where="m.toml")
    text = str(caught.value)
    assert text.startswith("m.toml: 2 things are wrong")
    assert "R_s_ohm" in text and "f_s_hz" in text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("name = ", "is not TOML"),
        ("[machine\n", "is not TOML"),
        ("", "has no schema"),
        ('schema = "pmsmtool.design/1"', "schema is 'pmsmtool.design/1'"),
    ],
)
def test_what_is_no_machine_file(text, says):
    with pytest.raises(ConfigError) as caught:
        parse_machine(text, where="m.toml")
    assert says in str(caught.value)
    assert "m.toml" in str(caught.value)


@pytest.mark.parametrize(
    ("extra", "says"),
    [
        ("[limits]\nU_dc_min_v = 30\nU_dc_max_v = 20", "U_dc_min_v = 30 is above U_dc_max_v = 20"),
        ("[simulation]\nadc_bits = 12.5", "adc_bits = 12.5 is not a whole number"),
        ("[simulation]\nthermal_on = 1", "thermal_on is a number, allowed are true and false"),
        ("[simulation]\nsead = 1", "sead: unknown key; did you mean seed?"),
        ("[conditions]\nT = {a = 1}", "T is neither text nor number"),
        ("[provenance]\nwhen = 2026-01-01", "when is neither text nor number"),
        ("[estimate]\nR_s_ohm = 1", "R_s_ohm: no key of the machine, or not a table"),
        ("[estimate.R_s_ohm]\nstd = 1", "value is missing"),
        ("[flux_map]\nkind = 'bicubic'", "is not a flux map; i_d_a is missing"),
        ("[flux_map]\ni_d = [1]", "unknown key i_d; did you mean i_d_a?"),
    ],
)
def test_more_violations(extra, says):
    found = violations(GOOD + extra)
    assert any(says in violation for violation in found), found


@pytest.mark.parametrize(
    ("inverter", "says"),
    [
        ("voltage_error_i_apk = [0, 1]", "has 0 values for 2 currents"),
        ("voltage_error_i_apk = [0]\nvoltage_error_v = [0]", "has 1 values for 1 currents"),
        ("voltage_error_i_apk = [0, 2, 1]\nvoltage_error_v = [0, 1, 2]", "does not increase"),
        ("voltage_error_i_apk = [0, 'a']\nvoltage_error_v = [0, 1]", "is not an array of numbers"),
        ("voltage_error_i_apk = [0, inf]\nvoltage_error_v = [0, 1]", "is not finite"),
    ],
)
def test_voltage_error_table(inverter, says):
    assert any(says in violation for violation in violations(GOOD + inverter))


def test_a_scalar_where_a_table_is_due():
    for table in ("machine", "estimate", "conditions", "provenance"):
        raw = {**tomllib.loads(GOOD), table: 3}
        del raw["schema"]
        with pytest.raises(ConfigError) as caught:
            machine_from_tables(raw, where="d.toml", path=("machine_file",))
        assert any(f"[machine_file] {table} is not a table" in text for text in caught.value.violations)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        load_machine_file(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="no machine.toml in this folder"):
        load_machine_file(tmp_path)
    path = tmp_path / "m.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read as text"):
        load_machine_file(path)


# -- the flux map ----------------------------------------------------------------------------------------------------


def with_map(name):
    return GOOD.replace("psi_f_wb = 0.41", f'psi_f_wb = 0.41\nflux_map = "{name}"')


def test_a_map_beside_the_file(tmp_path):
    (tmp_path / "map.npz").write_bytes(flux_map_npz(small_map()))
    path = tmp_path / "m.toml"
    path.write_text(with_map("map.npz"))
    machine_file = load_machine_file(path)
    assert machine_file.flux_map is not None
    assert machine_file.flux_map.content_hash() == small_map().content_hash()
    assert 'flux_map = "map.npz"' in dump_machine_file(machine_file)
    assert "[flux_map]" not in dump_machine_file(machine_file)


def test_an_embedded_map_is_complete_alone(tmp_path):
    (tmp_path / "map.npz").write_bytes(flux_map_npz(small_map()))
    beside = parse_machine(with_map("map.npz"), folder=tmp_path)
    text = dump_machine_file(beside, embed_flux_map=True)
    alone = parse_machine(text)
    assert alone.machine.flux_map is None
    assert alone.flux_map is not None
    assert dict(alone.flux_map.meta) == {"a": [1]}
    assert alone.content_hash() == beside.content_hash()
    assert dump_machine_file(alone) == text


def test_map_problems_are_violations(tmp_path):
    assert "names a file, but these tables have no folder" in violations(with_map("map.npz"))[0]
    assert "no such file" in violations(with_map("map.npz"), folder=tmp_path)[0]
    (tmp_path / "map.npz").write_bytes(flux_map_npz(small_map())[:200])
    assert "not a complete .npz archive" in violations(with_map("map.npz"), folder=tmp_path)[0]
    np.savez(tmp_path / "map.npz", i_d_a=[0.0, 1, 1, 2], i_q_a=[0.0, 1, 2, 3], psi_d_wb=np.eye(4), psi_q_wb=np.eye(4))
    assert "axis i_d_a does not increase" in violations(with_map("map.npz"), folder=tmp_path)[0]
    both = with_map("map.npz") + "[flux_map]\n"
    assert "keep one" in violations(both, folder=tmp_path)[0]


def test_an_iron_loss_map_must_be_there(tmp_path):
    text = GOOD.replace("psi_f_wb = 0.41", 'psi_f_wb = 0.41\niron_loss_map = "loss.npz"')
    assert "no such file" in violations(text, folder=tmp_path)[0]
    (tmp_path / "loss.npz").write_bytes(b"")
    assert parse_machine(text, folder=tmp_path).machine.iron_loss_map == "loss.npz"


# -- round trips -----------------------------------------------------------------------------------------------------


def numbers_of(key):
    low, high = max(key.minimum, -1e12), min(key.maximum, 1e12)
    if key.kind == "int":
        return st.integers(math.ceil(low), math.floor(high))
    return st.floats(low, high)


def table_of(keys, optional=True):
    fixed = {key.name: numbers_of(key) for key in keys if key.required}
    free = {key.name: numbers_of(key) for key in keys if not key.required and key.kind in ("float", "int")}
    return st.fixed_dictionaries(fixed, optional=free if optional else {})


def is_consistent(tables):
    machine, limits = tables["machine"], tables.get("limits", {})
    pairs = [
        (machine, "I_nom_apk", "I_max_apk"), (machine, "n_nom_rpm", "n_max_rpm"), (machine, "R_winding_ohm", "R_s_ohm"),
        (limits, "U_dc_min_v", "U_dc_max_v"),
    ]  # fmt: skip
    inverter = tables["inverter"]
    linear = inverter.get("voltage_utilisation", 0.5) < 0.577
    short = inverter.get("min_off_time_s", 0.0) * inverter["f_s_hz"] < 0.49
    return linear and short and all(t.get(low, -math.inf) <= t.get(high, math.inf) for t, low, high in pairs)


def value_of(key):
    if key.choices:
        return st.sampled_from(key.choices)
    if key.kind == "bool":
        return st.booleans()
    return st.text(max_size=10) if key.kind == "text" else numbers_of(key)


DEVIATIONS = st.dictionaries(st.sampled_from(sorted(MEASURABLE)), st.floats(0, 1e-8), max_size=4)
"""Below ten times the least value of every key."""
WITHOUT_FRICTION = [key for key in MACHINE_KEYS if key.name not in ("B_nms", "tau_c_nm")]
ESTIMATES = st.builds(
    Estimate,
    value=st.just(1.0),
    std=st.floats(0, 900),
    systematic=st.floats(0, 900),
    unit=st.just("ohm"),
    n=st.integers(0, 10**6),
    chi2=st.floats(0, 1e3),
    T_c=st.floats(-50, 200),
    method=st.text(max_size=5),
    source=st.sampled_from(["pmsmtool", "vendor"]),
    dof=st.floats(1, 100),
)
TABLES = st.fixed_dictionaries(
    {
        "name": st.text(min_size=1, max_size=10),
        "machine": table_of(WITHOUT_FRICTION),
        "inverter": table_of(INVERTER_KEYS),
    },
    optional={
        "std": DEVIATIONS,
        "systematic": DEVIATIONS,
        "encoder": table_of(ENCODER_KEYS[:1]),
        "limits": table_of(LIMIT_KEYS),
        "simulation": st.fixed_dictionaries({}, optional={key.name: value_of(key) for key in SIMULATION_KEYS}),
        "conditions": st.dictionaries(st.text(min_size=1, max_size=5), st.floats(-1e3, 1e3) | st.text(max_size=5)),
        "provenance": st.dictionaries(st.text(min_size=1, max_size=5), st.lists(st.integers(-9, 9), max_size=3)),
    },
).filter(is_consistent)


@pytest.mark.chain
@settings(max_examples=75, deadline=None)
@given(TABLES, ESTIMATES)
def test_any_machine_survives_its_file(tables, estimate):
    first = machine_from_tables(tables)
    estimate = replace(estimate, value=first.machine.R_s_ohm)
    machine_file = MachineFile(
        first.name, first.machine, first.inverter, first.std, first.systematic, {"R_s_ohm": estimate}, first.encoder,
        first.limits, first.conditions, first.provenance, first.simulation,
    )  # fmt: skip
    text = dump_machine_file(machine_file)
    back = parse_machine(text)
    assert back == machine_file
    assert dump_machine_file(back) == text
    assert back.content_hash() == machine_file.content_hash()


def test_what_an_estimate_does_not_know_stays_unknown():
    estimate = Estimate(0.1, math.nan, 0.0, "ohm")
    source = parse_machine(GOOD)
    machine_file = MachineFile(source.name, source.machine, source.inverter, estimates={"R_s_ohm": estimate})
    back = parse_machine(dump_machine_file(machine_file)).estimates["R_s_ohm"]
    assert math.isnan(back.std) and math.isnan(back.chi2) and math.isnan(back.i_d_apk)
    assert back.dof == math.inf


def test_estimates_at_several_bias_points():
    text = GOOD + "[estimate.L_q_h_at_rated]\nvalue = 2e-3\nstd = 1e-5\ni_q_apk = 28\n"
    estimate = parse_machine(text).estimates["L_q_h_at_rated"]
    assert (estimate.unit, estimate.i_q_apk, estimate.source) == ("H", 28.0, "pmsmtool")


def test_voltage_error_table_survives():
    source = parse_machine(GOOD + "voltage_error_i_apk = [-1, 0, 1]\nvoltage_error_v = [-2.5, 0, 2.5]\n")
    assert source.inverter.voltage_error_i_apk == (-1.0, 0.0, 1.0)
    assert parse_machine(dump_machine_file(source)) == source


def test_key_order_of_the_source_does_not_matter():
    lines = GOOD.splitlines()
    shuffled = "\n".join([*lines[:4], *lines[8:3:-1], *lines[9:]])
    assert dump_machine_file(parse_machine(shuffled)) == dump_machine_file(parse_machine(GOOD))


def test_embedding_in_another_file():
    tables = machine_tables(parse_machine(GOOD))
    assert "schema" not in tables
    assert machine_from_tables(tables) == parse_machine(GOOD)


# -- the hash --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "extra",
    [
        "[encoder]\noffset_rad = 0.1",
        "[limits]\ni_trip_apk = 50",
        "[std]\nR_s_ohm = 0.01",
        "[systematic]\nR_s_ohm = 0.01",
    ],
)
def test_what_decides_a_design_changes_the_hash(extra):
    assert parse_machine(GOOD + extra).content_hash() != parse_machine(GOOD).content_hash()


@pytest.mark.parametrize(
    "extra",
    [
        "[simulation]\nseed = 3",
        "[conditions]\nnote = 'x'",
        "[provenance]\nrun = 'x'",
        "[estimate.R_s_ohm]\nvalue = 0.1\nstd = 0.01",
    ],
)
def test_what_does_not_decide_a_design_leaves_the_hash(extra):
    assert parse_machine(GOOD + extra).content_hash() == parse_machine(GOOD).content_hash()
    assert parse_machine(GOOD.replace("jercic", "other")).content_hash() == parse_machine(GOOD).content_hash()


# -- the tables of keys ----------------------------------------------------------------------------------------------


def test_keys_are_the_fields_of_the_parameters():
    for keys, kind in (
        (MACHINE_KEYS, MachineParameters),
        (INVERTER_KEYS, InverterParameters),
        (ENCODER_KEYS, EncoderParameters),
        (LIMIT_KEYS, MachineLimits),
    ):
        fields = kind.__dataclass_fields__
        assert [key.name for key in keys] == list(fields)
        for key in keys:
            default = fields[key.name].default
            if not key.required:
                assert key.default == default, key.name


def test_keys_are_documented_and_unique():
    keys = machine_file_keys()
    assert len({(key.table, key.name) for key in keys}) == len(keys)
    for key in keys:
        assert key.meaning
        if key.kind in ("float", "int") and key.default is not None:
            assert key.check(key.default) == (key.default, "")
        if key.choices:
            assert key.default in key.choices


def test_bounds_are_not_tighter_than_the_drive_needs():
    """What the drive accepts as motor data, a machine file accepts too."""
    for key in MACHINE_KEYS:
        row = BY_NAME.get(f"motor.{key.name}")
        if row is not None and key.name != "J_kgm2":  # the drive takes 0 for "not known", a file leaves the key out
            assert key.minimum <= row.minimum or row.minimum in key.besides  # psi_f = 0: no magnets
            assert key.maximum >= row.maximum
            assert key.unit == row.unit


def test_simulation_settings_fall_back_to_the_file():
    text = GOOD.replace("psi_f_wb = 0.41", "psi_f_wb = 0.41\nI_max_apk = 50\nJ_kgm2 = 0.02")
    settings_ = parse_machine(text + "dead_time_s = 2e-6\n[simulation]\nR_s_ohm = 0.15\n").simulation_settings()
    assert settings_["R_s_ohm"] == 0.15  # the truth differs from the file
    assert settings_["L_d_h"] == 0.0023
    assert settings_["J_kgm2"] == 0.02
    assert settings_["dead_time_s"] == 2e-6
    assert settings_["U_dc_v"] == 210.0
    assert settings_["adc_full_scale_apk"] == 75.0
    assert settings_["encoder_offset_rad"] == 0.0
    assert "tau_c_nm" not in settings_  # nobody gave it
    assert SCHEMA == "pmsmtool.machine/1"
