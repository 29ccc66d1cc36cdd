# SPDX-License-Identifier: MIT
"""``pmsmtool jog``: a short motion within limits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from pmsmtool.cli.drive_access import map_option, open_drive, read_map
from pmsmtool.cli.options import (
    DURATION,
    LARGEST_CURRENT,
    SPEED,
    BusOptions,
    MotionOptions,
    Quantity,
    bus_options,
    examples,
    motion_options,
    output_options,
)
from pmsmtool.cli.output import Output, table
from pmsmtool.errors import ConfigError, Partial, SafetyRefusal
from pmsmtool.units import rpm_from_rad_s

SPEED_MARGIN = 1.5
"""Speed limit over the wanted speed when --speed-max is not given."""
CURRENT_JOG_SPEED_RAD_S = 2.0 * math.pi
"""Speed limit of a current jog without --speed-max: one turn per second."""
SAMPLE_S = 0.05


@click.command(
    "jog",
    epilog=examples(
        "pmsmtool -i pmsmsim --yes jog --current 2Apk --angle 90deg --for 1s",
        "pmsmtool -n 5 jog --speed 100rpm --for 2s --i-max 5Apk --shaft free",
    ),
)
@click.option("--current", "current_apk", type=LARGEST_CURRENT, help="Hold this current vector, e.g. 2Apk.")
@click.option("--angle", "angle_rad", type=Quantity("angle"), default="0deg", help="Electrical angle of the vector.")
@click.option("--speed", "speed_rad_s", type=SPEED, help="Run at this speed, e.g. 100rpm.")
@click.option("--for", "seconds", type=DURATION, default="1s", help="How long.")
@map_option
@bus_options
@motion_options
@output_options
def jog_command(
    bus: BusOptions,
    motion: MotionOptions,
    out: Output,
    current_apk: float | None,
    angle_rad: float,
    speed_rad_s: float | None,
    seconds: float,
    map_file: Path | None,
) -> None:
    """Hold a current vector at a fixed angle, or run at a speed, for a short time; then stop and restore everything.

    A speed jog needs a drive that is set up: pole pairs, encoder offset, gains. Exit code 10 where the shaft misses the
    speed by more than half. For drives that take set points of d and q; `pmsmtool move` moves all others.
    """
    from pmsmtool.cli.consent import ask_motion
    from pmsmtool.drive.envelope import Envelope
    from pmsmtool.drive.guard import guarded

    if (current_apk is None) == (speed_rad_s is None):
        raise ConfigError(
            "give one of --current and --speed", hint="`pmsmtool jog --current 1Apk`, or `pmsmtool jog --speed 100rpm`"
        )
    with open_drive(bus, read_map(map_file)) as drive:
        _refuse_beyond("current", current_apk or 0.0, drive.read("motor.I_max_apk"), "Apk", "motor.I_max_apk")
        rpm = rpm_from_rad_s(abs(speed_rad_s or 0.0))
        _refuse_beyond("speed", rpm, drive.read("motor.n_max_rpm"), "rpm", "motor.n_max_rpm")
        i_nom_apk = drive.read("motor.I_nom_apk")
        speed = abs(speed_rad_s) * SPEED_MARGIN if speed_rad_s is not None else CURRENT_JOG_SPEED_RAD_S
        envelope = Envelope(
            i_max_apk=motion.i_max_apk or (i_nom_apk if current_apk is None else min(current_apk, i_nom_apk)),
            speed_max_rad_s=motion.speed_max_rad_s or speed,
            duration_s=seconds + 2.0,
            shaft=motion.shaft or "free",
            load=motion.load,
            brake=motion.brake,
        )
        envelope.refuse_gravity()
        ask_motion(envelope.lines(), motion, simulated=bus.simulated(), serial=drive.identity.serial, out=out)
        with guarded(drive, envelope, say=out.note) as guard:
            guard.enable()
            if current_apk is not None:
                guard.command_current(current_apk, 0.0, fixed_angle_rad=angle_rad)
            elif speed_rad_s is not None:
                guard.command_speed(speed_rad_s)
            readings = _watch(guard, seconds)
        pole_pairs = drive.read("motor.pole_pairs")
    facts = {"seconds": seconds, "envelope": envelope, "dead_man": guard.proof, "readings": readings}
    rows = [(name, f"{value:.6g}", unit) for name, value, unit in _means(readings)]
    out.result("jog", facts, lambda: table(("quantity", "mean", "unit"), rows))
    if speed_rad_s is not None:
        _require_reached(speed_rad_s, _means(readings), pole_pairs)


def _require_reached(asked: float, means: list[tuple[str, float, str]], pole_pairs: float) -> None:
    speed = next(value for name, value, _ in means if name == "omega_e_rad_s") / pole_pairs
    if abs(speed - asked) > abs(asked) / 2:
        raise Partial(
            f"the shaft ran at {rpm_from_rad_s(speed):.3g} rpm in place of {rpm_from_rad_s(asked):.3g} rpm",
            likely="the drive is not set up: speed gains of 0 give no torque; or the load holds the shaft",
            hint="`pmsmtool param get 'speed.K*'` shows the gains; `pmsmtool commission` sets the drive up",
        )


def _refuse_beyond(quantity: str, value: float, limit: float, unit: str, name: str) -> None:
    """Refuse what the drive would cut without a word: its own limit of the machine, where it knows one."""
    if 0.0 < limit < value:
        raise SafetyRefusal(
            f"a {quantity} of {value:.4g} {unit} is asked for, the machine's largest is {limit:.4g} {unit}",
            where=name,
            hint=f"ask for less, or set {name} if the machine allows it",
        )


def _watch(guard: Any, seconds: float) -> list[dict[str, float]]:
    names = ("i_d_a", "i_q_a", "omega_e_rad_s", "U_dc_v", "theta_m_rad")
    readings = []
    left = seconds
    while left > 0.0:
        guard.wait(min(SAMPLE_S, left))
        left -= SAMPLE_S
        readings.append({name: guard.live(name) for name in names})
    return readings


def _means(readings: list[dict[str, float]]) -> list[tuple[str, float, str]]:
    """Mean of the second half of the motion: what it settled to."""
    from pmsmtool.drive.objects import signal_unit

    half = readings[len(readings) // 2 :]
    return [(name, sum(r[name] for r in half) / len(half), signal_unit(name)) for name in half[0]]
