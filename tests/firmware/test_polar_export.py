# SPDX-License-Identifier: MIT
"""A tuned polar design, exported as C and compiled by itself, gives the bits of the drive's core."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pmsmtool.design.tune import tune
from pmsmtool.design.tune_request import TuneRequest
from pmsmtool.firmware.core_binding import core
from pmsmtool.firmware.export_c import FLAGS, c_files
from pmsmtool.firmware.image import pack_image
from pmsmtool.machine.machine_file import load_machine_file, machine_path
from tests.firmware.closed_loop import MODE_TORQUE, Loop

pytestmark = pytest.mark.chain

COMPILER = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
PERIODS = 300

MAIN = r"""
#include <stdio.h>
#include "pmsm_core.h"
#include "pmsm_cfg.h"
int main(void)
{
    float x[8];
    pmsm_state state;
    pmsm_output out;
    pmsm_init(&state);
    while (fread(x, sizeof x[0], 8, stdin) == 8) {
        const pmsm_measurement m = {x[0], x[1], x[2], x[3], x[4], x[5], x[6]};
        const pmsm_reference r = {3u, 0.0F, 0.0F, x[7], 0.0F, 0.0F, 0.0F, 0.0F};
        pmsm_step(&state, &pmsm_cfg.params, 0, &m, &r, &out);
        const float y[5] = {out.duty_a, out.duty_b, out.duty_c, state.live.u_d, state.live.u_q};
        if (fwrite(y, sizeof y[0], 5, stdout) != 5) { return 1; }
    }
    return 0;
}
"""


@pytest.mark.skipif(COMPILER is None, reason="no C compiler on this machine")
@pytest.mark.parametrize(("profile", "law"), [("miyajima-2013-assumed", "proposed"), ("interior-2k2", "unified")])
def test_exported_polar_design_gives_the_same_bits(profile: str, law: str, tmp_path: Path) -> None:
    source = load_machine_file(machine_path(profile))
    design = tune(source, TuneRequest(controller="polar", polar_law=law, field_weakening="off"))
    values = dict(design.parameter_set().values)
    for name, text in c_files(pack_image(values)).items():
        if not name.endswith("_main.c"):
            (tmp_path / name).write_text(text)
    (tmp_path / "run.c").write_text(MAIN)
    sources = sorted(path.name for path in tmp_path.glob("*.c"))
    subprocess.run([COMPILER, *FLAGS.split(), "-O1", "-o", "run", *sources], cwd=tmp_path, check=True)

    speed = 1.2 * float(design.facts.get("polar_design_speed_rpm", 2000.0)) * source.machine.pole_pairs * np.pi / 30
    loop = Loop(core(), values, omega=speed, U_dc=source.inverter.U_dc_v)
    torque = 0.5 * values["speed.tau_max_nm"]
    inputs, outputs = [], []
    for k in range(PERIODS):
        tau = torque * (1, -1, 0.3)[k // 100]
        live = loop.step(mode=MODE_TORQUE, tau_ref=tau)
        m, out = loop.measurement, loop.output
        inputs.append((m.i_a, m.i_b, m.i_c, m.theta_e, m.omega_e, m.U_dc, m.T_winding, tau))
        outputs.append((out.duty_a, out.duty_b, out.duty_c, live.u_d, live.u_q))
    given, mine = np.array(inputs, dtype=np.float32), np.array(outputs, dtype=np.float32)
    result = subprocess.run([tmp_path / "run"], input=given.tobytes(), capture_output=True, check=True)
    assert result.stdout == mine.tobytes()
    assert np.ptp(mine[:, 3]) > 1.0  # it did work
