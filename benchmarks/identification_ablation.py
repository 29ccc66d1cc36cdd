# SPDX-License-Identifier: MIT
"""What each effect of the plant does to the estimates: one identification without it, one with it.

    python -m benchmarks.identification_ablation

The base is a machine on an inverter without dead time, drops or capacitance, with ideal sensors and mechanics. Each row
switches one effect on that the estimator is not told of and prints the change of every estimate in percent of the truth
(offset: degrees electrical), and by how much the printed total 95 % half width is larger: above 1 the interval does not
cover the effect.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

from benchmarks.identification_coverage import evaluated, measured, truth_of
from pmsmtool.errors import PmsmtoolError
from pmsmtool.estimators.estimate import total_half_width
from pmsmtool.files import data_folder
from pmsmtool.machine.key import Value
from pmsmtool.machine.machine_file import MachineFile, load_machine_file

BASE: dict[str, Value] = {
    "inverter_model": "switched",
    "dead_time_s": 0.0,
    "leg_mismatch_s": 0.0,
    "device_drop_v": 0.0,
    "diode_drop_v": 0.0,
    "device_slope_ohm": 0.0,
    "diode_slope_ohm": 0.0,
    "output_capacitance_f": 0.0,
    "sensor_lag_s": 0.0,
    "sampling_shift_s": 0.0,
    "sensor_offset_a_apk": 0.0,
    "sensor_offset_b_apk": 0.0,
    "sensor_offset_c_apk": 0.0,
    "thermal_on": False,
    "T_winding_c": 20.0,
    "T_magnet_c": 20.0,
    "T_ambient_c": 20.0,
}
"""Everything off; noise and quantisation of the profile stay."""
EFFECTS: dict[str, dict[str, Value]] = {
    "dead time 2 us": {"dead_time_s": 2e-6},
    "dead time 2 us, 0.5 nF": {"dead_time_s": 2e-6, "output_capacitance_f": 0.5e-9},
    "legs differ by 5 %": {"dead_time_s": 2e-6, "leg_mismatch_s": 1e-7},
    "thresholds 0.9 V and 1.0 V": {"device_drop_v": 0.9, "diode_drop_v": 1.0},
    "thresholds 0.4 V and 1.2 V": {"device_drop_v": 0.4, "diode_drop_v": 1.2},
    "sensor lag 5 us": {"sensor_lag_s": 5e-6},
    "sampling 5 % of T_s late": {"sampling_shift_s": 4e-6},
    "offset of one sensor, 2 LSB": {"sensor_offset_a_apk": 0.015},
    "gain of one sensor 0.5 %": {"sensor_gain_a": 1.005},
    "encoder once per turn, 0.2 deg": {"encoder_once_rad": math.radians(0.2)},
    "encoder 5 us late": {"encoder_latency_s": 5e-6},
    "cogging 1 % of rated torque": {"cogging_nm": 0.15, "cogging_periods": 12},
    "6th flux harmonic, 1 %": {"psi_6_wb": 0.0055},
    "iron loss, 2 kohm": {"iron_loss_ohm": 2000.0},
    "iron loss, 20 kohm": {"iron_loss_ohm": 20000.0},
    "eddy branch, 3 %": {"eddy_share": 0.03, "eddy_time_s": 1e-4},
    "winding 40 K warmer": {"T_winding_c": 60.0, "T_magnet_c": 60.0},
    "DC-link ripple 2 %": {"U_dc_ripple_v": 11.0, "U_dc_ripple_hz": 300.0},
}
QUANTITIES = ("R_at_T_ohm", "L_d_h", "L_q_h", "psi_f_wb", "offset_rad")


def errors_of(drive: MachineFile) -> dict[str, tuple[float, float]]:
    """Return error and total half width of every quantity, relative (offset: rad)."""
    traces, nameplate, _ = measured(drive)
    found = evaluated(traces, nameplate)
    assert found.resistance is not None
    truth = truth_of(drive, found)
    estimates = {**found.estimates(), "R_at_T_ohm": found.resistance.R_measured}
    errors = {}
    for name in QUANTITIES:
        scale = 1.0 if name == "offset_rad" else truth[name]
        off = estimates[name].value - truth[name]
        off = math.remainder(off, 2.0 * math.pi) if name == "offset_rad" else off
        errors[name] = off / scale, total_half_width(estimates[name]) / scale
    return errors


def row_of(effect: str, errors: dict[str, tuple[float, float]], base: dict[str, tuple[float, float]]) -> str:
    """Return one line of the table."""
    cells = []
    worst = 0.0
    for name in QUANTITIES:
        factor = 180.0 / math.pi if name == "offset_rad" else 100.0
        cells.append(f"{factor * (errors[name][0] - base[name][0]):+10.4f}")
        worst = max(worst, abs(errors[name][0]) / errors[name][1])
    return f"{effect:34s}" + "".join(cells) + f"{worst:10.2f}"


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--profile", default="interior-2k2")
    parser.add_argument("--write", type=Path, help="write the table there as well")
    options = parser.parse_args()
    profile = load_machine_file(data_folder("profiles") / f"{options.profile}.toml")
    ideal = replace(profile, simulation={**profile.simulation, **BASE})
    base = errors_of(ideal)
    heads = ("R %", "L_d %", "L_q %", "psi_f %", "offset deg", "error/95 %")
    lines = [f"{options.profile}: change of the estimate when the effect is on", ""]
    lines.append(f"{'effect':34s}" + "".join(f"{head:>10s}" for head in heads))
    lines.append(row_of("(base: error without any)", base, dict.fromkeys(QUANTITIES, (0.0, 0.0))))
    for effect, changes in EFFECTS.items():
        try:
            errors = errors_of(replace(ideal, simulation={**ideal.simulation, **changes}))
        except PmsmtoolError as error:
            lines.append(f"{effect:34s}refused: {getattr(error, 'reason', type(error).__name__)}")
            continue
        lines.append(row_of(effect, errors, base))
    text = "\n".join(lines) + "\n"
    print(text, end="")
    if options.write:
        options.write.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
