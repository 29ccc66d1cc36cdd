# SPDX-License-Identifier: MIT
"""The exported application, compiled with the export's own flags, against the simulated drive's, bit for bit."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from typing import Any

import numpy as np
import pytest

from pmsmtool.firmware.core_binding import APPLICATION_HEADER, core
from pmsmtool.firmware.export_c import FLAGS, c_files
from pmsmtool.firmware.image import pack_image
from pmsmtool.native import load, parse_structs
from pmsmtool.params.catalogue import CATALOGUE

pytestmark = pytest.mark.chain

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
TYPES = parse_structs(APPLICATION_HEADER.read_text(encoding="ascii"), core().types)
TUNED = {"speed.K_p_nms_per_rad": 0.8, "speed.K_i_nm_per_rad": 12.0, "position.K_p_per_s": 20.0}
VALUES = {row.name: row.default for row in CATALOGUE} | TUNED | {"position.inertia_ff_kgm2": 0.01}
PERIODS = 3000


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("exported")
    for name, text in c_files(pack_image(VALUES)).items():
        (folder / name).write_text(text)
    sources = sorted(path.name for path in folder.glob("*.c"))
    command = [str(COMPILER), *FLAGS.split(), "-O2", "-fPIC", "-shared", "-o", "application.so", *sources]
    subprocess.run(command, cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "application.so"))


class Running:
    """One application, and what it computed last."""

    def __init__(self, library: Any, halls: int) -> None:
        self.library = library
        self.params = core().params(VALUES | {"hall.commutation": halls})
        self.app = TYPES["pmsm_application"]()
        self.trace, self.output = (ctypes.c_uint8 * 4096)(), TYPES["pmsm_output"]()
        library.pmsm_application_init(ctypes.byref(self.app), ctypes.byref(self.params), None)
        self.app.trace, self.app.trace_bytes = ctypes.addressof(self.trace), len(self.trace)

    def period(self, sensors: Any) -> bytes:
        """Return all that it holds after a period, but for the pointers in front."""
        self.library.pmsm_application_period(ctypes.byref(self.app), ctypes.byref(sensors), ctypes.byref(self.output))
        start = TYPES["pmsm_application"].trace_bytes.offset
        return bytes(self.app)[start:] + bytes(self.output) + bytes(self.trace)


def ask(app: Any, k: int) -> None:
    """Moves, a homing, a chirp with recorder and averages, a quick stop and a trip, one after the other."""
    position = app.position.asked
    if k == 0:
        app.enabled, app.reference.mode = 1, 6
        position.increments, position.profile, position.jerk = 4096, 1, 3e6
        position.velocity, position.acceleration, position.deceleration = 9000.0, 90000.0, 70000.0
        position.window, position.window_time = 500.0, 0.05
        position.target, position.set_point = 3000, 1
    elif k == 600:
        position.target, position.set_point = -2500, 2
    elif k == 1000:
        position.profile, position.interval, position.set_point = 0, 0.01, 3
    elif k == 1200:
        homing = position.homing
        homing.active, homing.start, homing.method, homing.slow, homing.home_offset = 1, 1, 17, 3000.0, 50
    elif k == 1400:
        app.reference.mode = 2
        excitation = app.excitation
        excitation.shape, excitation.point, excitation.amplitude, excitation.duration = 3, 3, 2.0, 0.05
        excitation.f0, excitation.f1, excitation.command = 50.0, 700.0, 2
        app.recorder.channel[0], app.recorder.channel[1] = 2, 24
        app.recorder.depth, app.recorder.command = 200, 1
        app.average.signal[0], app.average.periods, app.average.command = 19, 500, 1
    elif k == 2200:
        app.reference.mode, app.reference.omega_M_ref = 4, 30.0
    elif k == 2600:
        app.quick_stop = 1


def hall_wires(theta_e: float) -> int:
    return sum((math.cos(theta_e - k * 2 * math.pi / 3) >= 0.0) << k for k in range(3))


@pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
@pytest.mark.parametrize("halls", [0, 1, 2, 3])
def test_the_compiled_export_equals_the_simulated_drives_application(exported: ctypes.CDLL, halls: int) -> None:
    mine, theirs = Running(load("pmsm_sim"), halls), Running(exported, halls)
    rng = np.random.default_rng(4)
    seen: set[int] = set()
    phases: set[int] = set()
    for k in range(PERIODS):
        theta = 0.3 * math.sin(k / 200.0) + k / 500.0
        parts = round(theta / (2 * math.pi) * 2**32)
        i = rng.normal(0.0, 3.0, 3)
        sensors = TYPES["pmsm_sensors"](i[0], i[1], i[2], 210.0, 30.0, 30.0, parts >> 32, parts & 0xFFFFFFFF)
        sensors.limits = int(620 < k < 700 or 1230 < k < 1260)
        sensors.hall, sensors.encoder_unreferenced = hall_wires(VALUES["motor.pole_pairs"] * theta), int(k < 400)
        sensors.U_dc = 210.0 if k < 2900 else 900.0
        for one in (mine, theirs):
            ask(one.app, k)
        assert mine.period(sensors) == theirs.period(sensors), k
        seen.add(mine.app.position.flags)
        phases.add(mine.app.position.homing)
    assert phases >= {0, 1, 2, 3}, "a homing from its search to its rest"
    assert mine.app.trip == 0x3210 and mine.app.recorder.state == 3 and mine.app.average.state == 2
    assert all(any(flags & bit for flags in seen) for bit in (1, 2, 8)), "moves, following errors, a switch"
