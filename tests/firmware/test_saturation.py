# SPDX-License-Identifier: MIT
"""The saturation table in the control core: an equal law for equal inductances, settling, rest, refusals, travels."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.random_drives import draw_around
from pmsmtool.commissioning.export import image_of
from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.drive_maps.drive_map import reference_map
from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.export_c import c_files
from pmsmtool.firmware.image import ImageRefused, pack_image, saturation_words, unpack_image
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.machine_file import MachineFile, load_machine_file, machine_path
from pmsmtool.papers.governed_drive import IDEAL
from pmsmtool.params.parameter_set import SATURATION, ParameterSet, parse_parameter_set
from pmsmtool.sim.closed_loop import simulate
from pmsmtool.sim.kernel import Application
from pmsmtool.sim.scenarios import Scenario

STEP_S = 0.05
AGREEMENT_A = 2e-3
"""Between a table of one inductance and no table (A): binary32 over 600 periods; measured 4e-4 of 40 A."""
REACHABLE_S, UNREACHABLE_S = 0.010, 0.015
"""Measured 0.0043, and 0.0058 and 0.0101; without the table 0.035, and 0.085 and 0.086."""
SWING = 0.01
"""Of I_max, peak to peak at rest; measured 4e-6, without the table 0.17 to 0.29."""


def ideal(source: MachineFile) -> MachineFile:
    """The machine with sensors and bridge that add nothing."""
    truth = {**IDEAL, "R_s_ohm": source.machine.R_s_ohm}
    return replace(source, simulation=truth, inverter=replace(source.inverter, V_dead_v=0.0))


@cache
def saturated() -> MachineFile:
    return ideal(load_machine_file(machine_path("saturated-pmsyrm")))


@cache
def designed(predictor: bool = False) -> ParameterSet:
    return tune(saturated(), TuneRequest(predictor=predictor)).parameter_set()


def without_table(params: ParameterSet) -> ParameterSet:
    values = {name: 0.0 if name.startswith("saturation.") else value for name, value in params.values.items()}
    return replace(params, values=values, tables={k: v for k, v in params.tables.items() if k != SATURATION})


def current_after(source: MachineFile, params: ParameterSet, rpm: float, points: list[tuple[float, float]],
                  seconds: float) -> np.ndarray:  # fmt: skip
    """i_d, i_q (A) per period from the moment of the step, shape (2, n)."""
    start, target = points
    pairs = zip(("i_d_a", "i_q_a"), start, target, strict=True)
    schedule = {name: ((0.0, a), (STEP_S, a), (STEP_S, b)) for name, a, b in pairs}
    scenario = Scenario("step", STEP_S + seconds, "current", {**schedule, "driven_rpm": ((0.0, rpm),)}, "driven", rpm)
    trace = simulate(source, params, scenario, application=Application.CORE)
    i = np.stack([trace["i_d_true_a"], trace["i_q_true_a"]])
    return i[:, int(np.searchsorted(trace.t_s, STEP_S - 1e-9)) :]


def settling_s(i: np.ndarray, band_a: float) -> float:
    off = np.flatnonzero(np.hypot(*(i - i[:, -200:].mean(axis=1)[:, None])) > band_a)
    return (0 if not len(off) else int(off[-1]) + 1) * saturated().inverter.T_s


@pytest.mark.parametrize("governor", ["off", "line", "best"])
def test_a_table_of_one_inductance_controls_like_none(governor: str) -> None:
    plain = ideal(load_machine_file(machine_path("interior-2k2")))
    machine = plain.machine
    axis = np.linspace(-1.3, 1.3, 9) * (machine.I_max_apk or 0.0)
    i_d, i_q = np.meshgrid(axis, axis, indexing="ij")
    flat = FluxMap(axis, axis, machine.psi_f_wb + machine.L_d_h * i_d, machine.L_q_h * i_q)
    of_map = tune(replace(plain, flux_map=flat), TuneRequest(governor=governor, predictor=True)).parameter_set()
    assert of_map.values["saturation.n_d"] > 0
    bare = without_table(of_map)
    I_nom = machine.I_nom_apk or 0.0
    points = [(0.0, 0.1 * I_nom), (-0.4 * I_nom, I_nom)]
    traces = [current_after(plain, p, 900.0, points, STEP_S) for p in (of_map, bare)]
    assert np.abs(traces[0] - traces[1]).max() < AGREEMENT_A
    assert np.hypot(*traces[0][:, -1]) > I_nom


@pytest.mark.chain
def test_steps_of_a_saturated_machine_settle_like_those_of_others() -> None:
    source, params = saturated(), designed()
    for rpm, points, limit in (
        (1300.0, [(-3.0, 2.0), (-12.0, 9.0)], REACHABLE_S),
        (1500.0, [(-11.0, 6.0), (-2.0, -15.0)], UNREACHABLE_S),
        (1300.0, [(-11.0, 6.0), (0.0, -15.0)], UNREACHABLE_S),
    ):
        i = current_after(source, params, rpm, points, 0.12)
        assert settling_s(i, 0.2) < limit
        assert np.hypot(*i).max() < 1.05 * 20.0


@pytest.mark.chain
@pytest.mark.parametrize(
    ("seed", "rpm", "start", "target"),
    [
        (24, -1986.8, (-11.16, 5.36), (4.63, 12.8)),  # without the table 4.1 A peak to peak, for ever
        (25, -1237.7, (1.57, 7.59), (2.85, 17.13)),  # 3.5 A
        (23, 1582.2, (-12.43, -4.02), (-3.06, -17.15)),  # 5.8 A
        (
            2502003,
            -1714.3625,
            (-15.7465, 8.3782),
            (5.9652, 16.0588),
        ),  # 0.85 A, by landings that the voltage cut
        (2502003, 1636.3393, (-15.2123, -3.9541), (5.6438, -10.1869)),  # 1.13 A
    ],
)
def test_random_saturated_machines_brake_out_of_reach_without_a_limit_cycle(
    seed: int, rpm: float, start: tuple[float, float], target: tuple[float, float]
) -> None:
    source = ideal(draw_around(saturated(), seed, spread=0.2))
    i = current_after(source, tune(source, TuneRequest(predictor=True)).parameter_set(), rpm, [start, target], 0.45)
    assert np.ptp(i[:, -600:], axis=1).max() < SWING * 20.0


@pytest.mark.chain
def test_what_the_integrators_still_forget_does_not_move_an_unreachable_reference() -> None:
    source = ideal(draw_around(saturated(), 2301009, spread=0.2))  # by the integrators' share: 21.2 ms
    points = [(1.54, -3.84), (3.16, -18.32)]
    i = current_after(source, tune(source).parameter_set(), -1032.8, points, 0.12)
    assert settling_s(i, 0.29) < UNREACHABLE_S  # 2 % of the step; measured 9.3 ms


@pytest.mark.chain
def test_the_core_reports_the_torque_of_the_map() -> None:
    source = saturated()
    schedule = {"i_d_a": ((0.0, -10.0),), "i_q_a": ((0.0, 12.0),), "driven_rpm": ((0.0, 300.0),)}
    scenario = Scenario("hold", 0.1, "current", schedule, "driven", 300.0)
    trace = simulate(source, designed(), scenario, application=Application.CORE)
    assert trace["torque_nm"][-1] == pytest.approx(trace["torque_true_nm"][-1], rel=0.02)


def words_of(changes: dict[int, float], **descriptor: float) -> tuple[dict[str, float], bytes]:
    """The designed set's values and table alone, some of its numbers or of its descriptor changed."""
    values = dict(designed().values) | {"lut.format": 0.0, "field_weakening.mode": 0.0}
    nodes = list(designed().tables[SATURATION])
    for k, number in changes.items():
        nodes[k] = number
    values |= {f"saturation.{key}": value for key, value in descriptor.items()}
    return values, struct.pack(f"<{len(nodes)}f", *nodes)


@pytest.mark.parametrize(
    ("changes", "descriptor"),
    [
        ({0: math.nan}, {}),
        ({0: 200.0}, {}),
        ({1: 0.0}, {}),
        ({2: -0.01}, {}),
        ({2: 11.0}, {}),
        ({195: math.inf}, {}),
        ({}, {"n_d": 1.0}),
        ({}, {"n_q": 1.0}),
        ({}, {"n_d": 0.0}),
        ({}, {"n_q": 0.0}),
        ({}, {"i_q_max_a": 0.0}),
        ({}, {"i_d_min_a": 0.0, "i_d_max_a": 0.0}),
        ({}, {"n_d": 6.0}),
    ],
)
def test_c_and_python_refuse_the_same_tables(changes: dict[int, float], descriptor: dict[str, float]) -> None:
    good, nodes = words_of({})
    scalars = len(pack_image(good, nodes)) - len(nodes)
    values, words = words_of(changes, **descriptor)
    image = pack_image({**values, "saturation.n_d": 0.0, "saturation.n_q": 0.0})[:scalars]
    row = list(values).index("saturation.n_d")
    image = (
        image[: 4 * row] + struct.pack("<2I", *(int(values[f"saturation.n_{a}"]) for a in "dq")) + image[4 * row + 8 :]
    )
    no_table = any(descriptor.get(f"n_{axis}", 2.0) < 2.0 for axis in "dq")  # as long as it says
    image += words[: 16 * int(values["saturation.n_d"] * values["saturation.n_q"])] if no_table else words
    with pytest.raises(ImageRefused) as caught:
        unpack_image(image)
    assert core().library.pmsm_image_check_content(image, len(image)) == caught.value.status


def test_the_table_travels_as_text_bytes_and_c_with_the_crc_over_it() -> None:
    params = designed()
    assert parse_parameter_set(params.to_toml()).tables[SATURATION] == params.tables[SATURATION]
    assert not params.violations()
    held = reference_map().decode(reference_map().encode(params))
    assert held.tables[SATURATION] == pytest.approx(params.tables[SATURATION], rel=1e-6)
    image = image_of(params)
    values, words = unpack_image(image)
    size = 4 * saturation_words(values)
    assert words[-size:] == struct.pack(f"<{size // 4}f", *params.tables[SATURATION])
    source = c_files(image)["pmsm_cfg.c"]
    assert f"0x{struct.unpack('<I', words[-4:])[0]:08X}u" in source and "at i_d = -22 A" in source
    short = replace(params, tables={**params.tables, SATURATION: params.tables[SATURATION][:-1]})
    assert short.violations() == ("saturation.nodes has 195 numbers, the descriptor says 196",)
