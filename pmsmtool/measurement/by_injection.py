# SPDX-License-Identifier: MIT
"""Identification by injection: its envelope and plan, its experiments, and the machine file it begins with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from pmsmtool.cia402 import HOMING_LOST
from pmsmtool.drive.canopen_drive import CanopenDrive
from pmsmtool.drive.envelope import Envelope, largest_acceleration, voltage_speed
from pmsmtool.drive.guard import guarded
from pmsmtool.drive.motion_objects import encoder_counts, few_counts
from pmsmtool.errors import ConfigError
from pmsmtool.experiments.rotation import dwell_within
from pmsmtool.identification.by_injection import evaluated_stage
from pmsmtool.identification.request import (
    NAMEPLATE,
    PREDICTED,
    REFUSED,
    IdentifyRequest,
    dump_predicted,
    dump_refused,
    steps_of,
)
from pmsmtool.machine.machine_file import MachineFile, dump_machine_file
from pmsmtool.machine.parameters import HALLS, EncoderParameters, InverterParameters, MachineLimits, MachineParameters
from pmsmtool.measurement import flux_map, frequency_response, mechanics
from pmsmtool.measurement.limits import (
    DURATION_S,
    HEADROOM,
    Keep,
    Limits,
    Say,
    Task,
    require_speed,
    sampled_speed,
    unused_current,
)
from pmsmtool.measurement.measure import Measurement, starting_gains
from pmsmtool.run_directory import Stage
from pmsmtool.units import rad_s_from_rpm, rpm_from_rad_s


def nameplate_of(drive: CanopenDrive, name: str = "") -> MachineFile:
    """Return the machine file of a drive before anything is identified: its ratings, and what its set says so far.

    Without a name, it has that of the drive.
    """
    name = name or drive.identity.name or f"drive {drive.identity.serial:#010x}"

    def read(parameter: str) -> float:
        return drive.read(parameter)

    machine = MachineParameters(
        pole_pairs=round(read("motor.pole_pairs")),
        R_s_ohm=read("motor.R_s_ohm"),
        L_d_h=read("motor.L_d_h"),
        L_q_h=read("motor.L_q_h"),
        psi_f_wb=read("motor.psi_f_wb"),
        I_nom_apk=read("motor.I_nom_apk"),
        I_max_apk=read("motor.I_max_apk"),
        I_max_time_s=read("motor.I_max_time_s"),
        n_max_rpm=read("motor.n_max_rpm"),
        T_ref_c=read("motor.T_ref_c"),
        alpha_R_per_k=read("motor.alpha_R_per_k"),
        alpha_psi_per_k=read("motor.alpha_psi_per_k"),
    )
    inverter = InverterParameters(
        U_dc_v=read("inverter.U_dc_nom_v"),
        f_s_hz=1e9 / read("inverter.T_s_ns"),
        dead_time_s=1e-9 * read("inverter.dead_time_ns"),
        delay_periods=read("inverter.delay_periods"),
        voltage_utilisation=read("inverter.voltage_utilisation"),
    )
    i_d_min = read("field_weakening.i_d_min_a")
    limits = MachineLimits(
        # what is no nearer than I_max is no demagnetisation limit: the design then assumes one
        i_d_min_apk=i_d_min if i_d_min > -read("motor.I_max_apk") else None,
        i_trip_apk=read("protection.i_trip_apk"),
        I_cont_apk=read("protection.I_cont_apk"),
        U_dc_min_v=read("protection.U_dc_min_v"),
        U_dc_max_v=read("protection.U_dc_max_v"),
        n_trip_rpm=read("protection.n_trip_rpm"),
        T_winding_max_c=read("protection.T_winding_max_c"),
    )
    source = "parameter set and ratings of the drive; the measured values are in [estimate]"
    known = MachineFile(name, machine, inverter, limits=limits, provenance={"source": source})
    return with_own_halls(with_own_encoder(known, drive), read)


def with_own_encoder(known: MachineFile, drive: CanopenDrive) -> MachineFile:
    """Return a machine file with the encoder's offset and direction that the drive holds, where it shows them."""
    offset, reverse = (drive.parameters.held_value(f"encoder.{name}") for name in ("offset_rad", "reversed"))
    if offset is None or reverse is None:
        return known
    return replace(known, encoder=replace(known.encoder, offset_rad=offset, direction=-1 if reverse else 1))


def with_own_halls(known: MachineFile, read: Callable[[str], float]) -> MachineFile:
    """Return a machine file with how the drive commutates by Hall sensors, where it does and the file does not say."""
    kind = round(read("hall.commutation"))
    if not kind or known.encoder.halls:
        return known
    stated, axes = known.encoder, (read(f"hall.{key}") for key in HALLS[1:])
    return replace(known, encoder=EncoderParameters(stated.offset_rad, stated.direction, stated.bits, kind, *axes))


def envelope_of(nameplate: MachineFile, request: IdentifyRequest) -> Envelope:
    """Return the motion envelope: what the request says, else the drive's ratings.

    Raises ConfigError: the nameplate has no rated current or speed, and none was given.
    """
    machine = nameplate.machine
    rated, rpm, i_d_min = machine.I_nom_apk, machine.top_rpm, nameplate.limits.i_d_min_apk
    i_max, speed = request.i_max_apk, request.speed_max_rad_s
    if i_max is None:
        i_max = HEADROOM * _stated(rated, "rated current", "I_nom_apk", "--i-max")
    if speed is None:
        speed = rad_s_from_rpm(_stated(rpm, "largest speed", "n_max_rpm", "--speed-max"))
    return Envelope(
        i_max_apk=i_max,
        speed_max_rad_s=speed,
        duration_s=DURATION_S,
        shaft=request.shaft,
        load=request.load,
        brake=request.brake,
        acceleration_rad_s2=largest_acceleration(machine, i_max),
        voltage_speed_rad_s=voltage_speed(nameplate, i_max),
        i_d_max_apk=(rated or i_max) if i_d_min is None else -i_d_min,
    )


def _stated(rating: float | None, what: str, key: str, option: str) -> float:
    if rating is None:
        raise ConfigError(
            f"the {what} is not known", where=f"[machine] {key}",
            hint=f"put {key} into the machine file (data sheet), or give {option}",
        )  # fmt: skip
    return rating


def with_limits_of(earlier: IdentifyRequest, request: IdentifyRequest, nameplate: MachineFile) -> IdentifyRequest:
    """Return a request with the limits of an earlier one where it has none: values are compared at like currents.

    They are never above the ratings of the drive, whose motor may be another one now.
    """
    own = envelope_of(nameplate, replace(request, i_max_apk=None, speed_max_rad_s=None))
    i_max, speed = request.i_max_apk, request.speed_max_rad_s
    if i_max is None and earlier.i_max_apk is not None:
        i_max = min(earlier.i_max_apk, own.i_max_apk)
    if speed is None and earlier.speed_max_rad_s is not None:
        speed = min(earlier.speed_max_rad_s, own.speed_max_rad_s)
    return replace(request, i_max_apk=i_max, speed_max_rad_s=speed)


def plan_lines(envelope: Envelope, request: IdentifyRequest, nameplate: MachineFile) -> list[str]:
    """Return what a person reads of what will happen inside the envelope."""
    steps = steps_of(request.measured, request.shaft == "locked")
    unused = unused_current(envelope.i_max_apk, nameplate, pulses="map" in steps)
    lines = [*unused, f"the rotor aligns with current vectors: it may jump by half an electrical turn; {HOMING_LOST}"]
    if "rotation" in steps:
        unless = "" if request.accuracy is None else " unless the rotor's rests show the pole pairs"
        lines.append(f"the shaft turns slowly through one turn each way{unless}")
    if "speeds" in steps:
        speeds = "four" if request.accuracy is None else "two to four"
        lines.append("torque pulses turn the shaft both ways")
        lines.append(f"it coasts with current from {speeds} speeds in each direction")
    if "turns" in steps:
        lines.append("it coasts with current from three speeds in each direction once more, for harmonics")
    if "coasting" in steps:
        lines.append(mechanics.PLAN_LINE)
    if "slow" in steps:
        lines.append("it turns twice each way at 30 rpm at the most")
    if "response" in steps:
        lines.append(frequency_response.PLAN_LINE)
    if "map" in steps:
        lines += flux_map.plan_lines(nameplate)
    elif request.map_if_saturated and "speeds" in steps:
        lines.append(flux_map.IF_SATURATED)
    return lines


def plan(task: Task) -> tuple[Envelope, list[str]]:
    """Return the envelope and what will happen inside it; refuses what cannot be asked."""
    request, nameplate = task.request, _nameplate(task)
    request.check()
    envelope = envelope_of(nameplate, request)
    envelope.refuse_gravity()
    steps = steps_of(request.measured, request.shaft == "locked")
    if "speeds" in steps:
        require_speed(envelope.speed_max_rad_s, nameplate.machine.top_rpm or 0.0)
    if "rotation" in steps:
        dwell_within(0.0, envelope.speed_max_rad_s)
    if request.shaft == "locked" and "map" in steps:
        flux_map.require_own_frame(task.drive.read, nameplate)
    lines = plan_lines(envelope, request, nameplate)
    if "speeds" in steps and (few := few_counts(encoder_counts(task.drive.node), nameplate.machine.pole_pairs)):
        lines.append(f"{few}; it runs slower for that, and psi and J are less accurate")
    return envelope, lines


def measure(task: Task, envelope: Envelope, keep: Keep, say: Say) -> Sequence[str]:
    """Run the experiments inside the guard; traces, predictions and refusals go into the run.

    Returns what a report says of limits that were not proven.
    """
    # Loaded while the drive is off: it takes 0.3 to 0.8 s, and an energised drive waits 0.35 s for a heartbeat.
    import scipy.optimize  # noqa: F401

    run, request, nameplate = task.run, task.request, _nameplate(task)
    run.save(NAMEPLATE, dump_machine_file(nameplate))
    sampled_rad_s = sampled_speed(nameplate)
    if sampled_rad_s < envelope.speed_max_rad_s:
        say(f"speed at most {rpm_from_rad_s(sampled_rad_s):.0f} rpm: this drive samples too few times per turn beyond")
    limits = Limits(
        I_nom_apk=nameplate.machine.I_nom_apk or envelope.i_max_apk,
        i_max_apk=envelope.i_max_apk,
        omega_max_rad_s=min(envelope.speed_max_rad_s, sampled_rad_s),
        V_max_v=nameplate.inverter.V_max_v,
        i_d_max_apk=envelope.i_d_max_apk,
        counts_per_turn=encoder_counts(task.drive.node) or math.inf,
    )
    with guarded(task.drive, envelope, first=starting_gains(limits, request.accuracy), say=say) as guard:
        measurement = Measurement(
            guard,
            limits,
            keep,
            say,
            held=request.shaft == "locked",
            accuracy=request.accuracy,
            map_if_saturated=request.map_if_saturated,
        )
        measurement.spent = lambda: (guard.energised_s, guard.energy_j)
        measurement.limit_current, measurement.limit_speed = guard.limit_current, guard.limit_speed
        predictions: list[dict[str, Any]] = []

        def predicted(prediction: dict[str, Any]) -> None:
            predictions.append(prediction)
            run.save(PREDICTED, dump_predicted(predictions))

        measurement.predicted = predicted
        try:
            measurement.run(request.measured)
        finally:
            if measurement.refused:
                run.save(REFUSED, dump_refused(measurement.refused))
    return measurement.unproven


def evaluate(task: Task, unproven: Sequence[str]) -> Stage:
    """Evaluate what is stored in the run; ``unproven`` as :func:`measure` returns it."""
    stage = evaluated_stage(task.run, _nameplate(task), task.request)
    return replace(stage, fallbacks=[*stage.fallbacks, *unproven])


def _nameplate(task: Task) -> MachineFile:
    assert task.machine is not None, "by injection the drive's own set stands in where nothing is given"
    return task.machine
