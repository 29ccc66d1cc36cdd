# SPDX-License-Identifier: MIT
"""The shipped profiles: they load, they say what they were made from, and their numbers are consistent."""

import math

import numpy as np
import pytest

from benchmarks.analytic_saturation import saturated_pmsyrm_map
from pmsmtool.files import data_folder
from pmsmtool.machine.flux_map_check import check_flux_map
from pmsmtool.machine.flux_map_import import flux_map_csv
from pmsmtool.machine.machine_file import dump_machine_file, load_machine_file, parse_machine

PROFILES = sorted(path.stem for path in data_folder("profiles").glob("*.toml"))


def load(name):
    return load_machine_file(data_folder("profiles") / f"{name}.toml")


def test_the_profiles_are_there():
    assert set(PROFILES) >= {
        "fast-ipm", "interior-2k2", "jercic-2017", "miyajima-2013-assumed", "mtpv-test", "saturated-pmsyrm",
    }  # fmt: skip


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_is_a_complete_drive(name):
    profile = load(name)
    machine, limits, settings = profile.machine, profile.limits, profile.simulation_settings()
    assert profile.name == name
    assert machine.I_nom_apk is not None and machine.I_max_apk is not None
    assert machine.n_nom_rpm is not None and machine.n_max_rpm is not None
    assert limits.i_trip_apk is not None and limits.n_trip_rpm is not None
    assert machine.I_nom_apk < machine.I_max_apk < limits.i_trip_apk <= settings["adc_full_scale_apk"]
    assert machine.n_max_rpm < limits.n_trip_rpm
    assert limits.U_dc_min_v < profile.inverter.U_dc_v < limits.U_dc_max_v
    assert settings["J_kgm2"] > 0
    # rated speed can be reached against the back-EMF
    omega_e = machine.n_nom_rpm * 2 * math.pi / 60 * machine.pole_pairs
    assert omega_e * machine.psi_f_wb < profile.inverter.V_max_v


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_survives_its_own_text(name):
    profile = load(name)
    folder = data_folder("profiles")
    back = parse_machine(dump_machine_file(profile), folder=folder)
    assert back.content_hash() == profile.content_hash()
    assert dump_machine_file(back) == dump_machine_file(profile)


def test_serial_numbers_differ():
    serials = [load(name).simulation_settings()["serial"] for name in PROFILES]
    assert len(set(serials)) == len(serials)


def test_jercic_is_table_1():
    profile = load("jercic-2017")
    machine = profile.machine
    assert (machine.R_s_ohm, machine.L_d_h, machine.L_q_h, machine.psi_f_wb) == (0.137, 2.3e-3, 2.1e-3, 0.41)
    assert (machine.pole_pairs, machine.I_nom_apk, machine.n_nom_rpm) == (4, 28.0, 620.0)
    assert profile.inverter.f_s_hz == 12e3
    # the link is chosen so that 92 % of it is just what the rated point needs
    omega = 620 * 2 * math.pi / 60 * 4
    u_d, u_q = -omega * 2.1e-3 * 28, 0.137 * 28 + omega * 0.41
    assert 0.92 * profile.inverter.V_max_v == pytest.approx(math.hypot(u_d, u_q), rel=2e-3)


def test_miyajima_in_peak_quantities():
    profile = load("miyajima-2013-assumed")
    assert profile.machine.psi_f_wb == pytest.approx(0.033 * math.sqrt(2 / 3), abs=1e-6)
    assert profile.inverter.V_max_v == pytest.approx(36 / math.sqrt(2) * math.sqrt(2 / 3), rel=1e-12)
    text = (data_folder("profiles") / "miyajima-2013-assumed.toml").read_text()
    assert "EVERY machine number below is assumed" in text


def test_mtpv_test_machine_gives_100_v():
    assert load("mtpv-test").inverter.V_max_v == pytest.approx(100.0, rel=1e-15)


def test_the_saturated_profile_is_the_analytic_model():
    profile = load("saturated-pmsyrm")
    assert profile.flux_map is not None
    assert profile.flux_map.content_hash() == saturated_pmsyrm_map().content_hash()
    assert check_flux_map(profile.flux_map).ok


def test_the_shipped_map_is_what_the_model_writes():
    path = data_folder("profiles") / "saturated-pmsyrm.csv"
    assert path.read_text(encoding="utf-8") == flux_map_csv(saturated_pmsyrm_map())


def test_the_saturated_profile_states_its_inductances_at_the_rated_point():
    profile = load("saturated-pmsyrm")
    flux_map, machine = profile.flux_map, profile.machine
    assert flux_map is not None and machine.I_nom_apk is not None
    angle = np.linspace(math.pi / 2, math.pi, 20001)
    i_d, i_q = machine.I_nom_apk * np.cos(angle), machine.I_nom_apk * np.sin(angle)
    best = int(np.argmax(flux_map.torque_nm(machine.pole_pairs, i_d, i_q)))
    jac = flux_map.incremental_inductance(i_d[best], i_q[best])
    apparent = [float(value) for value in flux_map.apparent_inductance(i_d[best], i_q[best])]
    assert (i_d[best], i_q[best]) == pytest.approx((-8.74, 8.86), abs=0.01)
    assert (machine.L_d_h, machine.L_q_h) == pytest.approx((jac[0, 0], jac[1, 1]), rel=1e-3)
    assert (machine.L_d_app_h, machine.L_q_app_h) == pytest.approx(apparent, rel=1e-3)
    assert machine.psi_f_wb == pytest.approx(float(flux_map.flux(0.0, 0.0)[0]), abs=1e-5)
