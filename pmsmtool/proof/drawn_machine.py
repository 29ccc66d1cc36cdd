# SPDX-License-Identifier: MIT
"""One machine of a proof's prediction, drawn from the intervals of its machine file and what is usual beyond them."""

from __future__ import annotations

import math

import numpy as np

from pmsmtool.design.tolerance import NORMAL_95, Samples
from pmsmtool.identification.sampling import INSTANT, LAG
from pmsmtool.machine.machine_file import MachineFile
from pmsmtool.machine.torque import iron_drag
from pmsmtool.machine.two_masses import (
    ZETA_FACTOR,
    by_more_torque,
    damping_nms_per_rad,
    doubt,
    hides_play,
    shafts_of,
)
from pmsmtool.sim.kernel import Setup, library
from pmsmtool.sim.simulated_machine import MODELS, SHAPES
from pmsmtool.units import rad_s_from_rpm

T_SPREAD_K = 5.0
"""Half range of the winding's temperature about its sensor, and of the magnets' about theirs."""
T_MAGNET_SPREAD_K = 15.0
"""Half range of the magnets' temperature about the winding's where they have no sensor."""
U_DC_SPREAD = 0.01
RIPPLE_HZ = (100.0, 120.0, 300.0, 360.0)
"""Its frequency: twice that of the mains behind one phase, six times behind three."""
DEAD_SPREAD = 0.2
KNEE_FACTOR = 3.0
MISMATCH_OF_LEGS = 0.05
LARGEST_DROP_SHARE = 0.5
"""Inverter: half range of its plateau, factor either way of its knee, dead times of the legs against each other, and
largest part of the plateau that comes from thresholds."""
FRICTION_SHARE = 0.03
"""Largest Coulomb and viscous friction, of the rated torque, where the machine file gives none."""
FRICTION_FACTOR = 2.0
"""Factor either way where it gives them, and their standard deviation."""
LAG_SHARES, LAG_S = (0.1, 0.65), 20e-6
"""Largest lag of the current sensors where it was not identified: that of amplifier and filter (s), within these shares
of the control period. With a tenth of it a healthy drive (17 of 44 us) was 1.23 half widths of the delay off, with 0.4
one of 19.4 us at 31 kHz (0.61 periods) 1.85. Short ones are drawn more often."""
LATE_SHARE = 0.1
"""Latest sample of half of the drives where it was not identified (T_s). Beside an iron loss of 8 % one that is later
than the sensor's lag has the current of the loss in it: the loop gain of a healthy drive seemed 6 % lower."""
TIMING_COVERAGE = 2.0
"""Half range of identified lag and instant, of their standard deviation."""
OFFSET_SHARE = 0.001
MISMATCH = 0.002
"""Standard deviations of sensor offsets (of I_max) about what they show before the proof, and of the phases' gains
against each other."""
BENT = "L_d changes with its current, and there is no flux map of it: the predicted bands are wider"
"""A line of the proof's report."""
LEAST_BENT = 0.3
"""Least L_d that its slope may leave, of that at the bias: the slope of a small ripple holds for no such change."""
IRON_LOSS = 0.08
"""Largest usual iron loss, of the rated power at the rated speed."""
SEEN_SHARES, EDDY_FACTOR = (0.5, 1.5), 2.0
"""Range of identified eddy currents, drag, cogging, encoder errors and ripple of the link, and factor either way of the
currents' time constant: one branch stands for many, one order for the orders of the cogging."""
EMF_HARMONICS = {"psi_5_wb": ("psi_6", 5, 0.05), "psi_7_wb": ("psi_7", 7, 0.03)}
"""Harmonics of the back-EMF: in a machine file's estimates, in the plant, of a phase, and the largest of the usual
range, of the fundamental, where none was identified (a healthy machine with 3.7 % of the 5th was at 1.29 of the band of
a speed step without). Patterns that are repeated are then simulated without: their bands have the ripple that the
repeats show, and with 5 % in them a gain 20 % too high passed on one drive."""

FINE_COGGING, FINE_ORDER = 0.05, 18
"""Largest usual cogging, of the rated torque, and its order per pole pair, where none was identified: a coasting does
not show such an order, and a move comes to rest on it. With 4.8 % a healthy machine was at 1.9 of the band of one."""


def about(middle: float, half: float) -> tuple[float, float]:
    """Return the range of a half width about a middle."""
    return middle - half, middle + half


def draw_machine(
    base: Setup, machine: MachineFile, samples: Samples, row: int, rng: np.random.Generator, I_max: float
) -> Setup:
    """Return the simulation of one drawn machine.

    Parameters
    ----------
    base : Setup
        That of the machine file's own values.
    machine : MachineFile
        Values, intervals and what was seen beside them.
    samples : Samples
        Draws from the intervals; ``row`` is taken.
    rng : Generator
        For all that no interval tells.
    I_max : float
        Largest current of the motor (A peak), for the sensors' offsets.
    """
    setup = Setup.from_buffer_copy(base)
    varied = samples.describe(row)
    out = setup.machine
    R = varied.get("R_s_ohm", 1.0)
    out.R_copper, out.R_fixed = R * out.R_copper, R * out.R_fixed
    out.L_d, out.L_q = (getattr(out, n) * varied.get(f"{n}_h", 1.0) for n in ("L_d", "L_q"))
    _draw_saturation(setup, machine, rng)
    out.psi_f *= varied.get("psi_f_wb", 1.0)
    out.J *= varied.get("J_kgm2", 1.0)
    _draw_elastic_shaft(setup, machine, rng)
    out.B, out.tau_c = _friction(machine, rng)
    setup.T_winding, setup.T_magnet, setup.U_dc = (varied[n] for n in ("T_winding_c", "T_magnet_c", "U_dc_v"))
    if setup.U_dc_ripple > 0.0:
        setup.U_dc_ripple *= float(rng.uniform(*SEEN_SHARES))
        setup.U_dc_ripple_hz = float(rng.choice(RIPPLE_HZ))
    setup.sensors.encoder_offset_e += varied["encoder_rad"]
    setup.sensors.offset[:] = list(base.sensors.offset + rng.normal(0.0, OFFSET_SHARE * I_max, 3))
    known = [machine.conditions.get(f"sensor_gain_{phase}_over_mean", 1.0) for phase in "abc"]
    setup.sensors.gain[:] = list(rng.normal(1.0, MISMATCH, 3) * np.array(known))
    _draw_eddy_currents(setup, machine, rng)
    _draw_harmonics(setup, machine, rng)
    _draw_shaft_effects(setup, machine, rng)
    _draw_inverter(setup, machine, rng)
    setup.sensor_lag, setup.sampling_shift, age_s = _timing(machine, rng, late=setup.delay > 0)
    setup.sensors.encoder_latency = age_s
    setup.seed = int(rng.integers(2**62))
    _draw_hidden_iron_loss(setup, machine, rng)
    return setup


def bend_of(machine: MachineFile) -> float:
    """Return the slope of L_d at its bias, relative (1/A), where no flux map holds it; 0: none was seen."""
    return machine.seen("L_d_bend_per_a") if machine.flux_map is None else 0.0


def _draw_saturation(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw the inductances at currents of the steps, where L_d bends with its current and no flux map says how.

    L_d within half of the rated current either way, by its slope at the bias. How much of that the bias took off L_q is
    not known, up to the same share, nor what the steps of i_q take off: half of it.
    """
    bend_per_a, L_d = bend_of(machine), machine.estimates.get("L_d_h")
    if not bend_per_a or L_d is None:
        return
    out, bias_a = setup.machine, L_d.i_d_apk
    within_a = 0.5 * (machine.machine.I_nom_apk or 2.0 * bias_a)
    out.L_d *= max(LEAST_BENT, 1.0 + bend_per_a * (float(rng.uniform(-within_a, within_a)) - bias_a))
    out.L_q *= 1.0 + abs(bend_per_a) * bias_a * float(rng.uniform(-0.5, 1.0))


def _draw_eddy_currents(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw eddy currents about those that the inductances were identified with; none where there were none.

    Within a control period they are nothing but iron loss; slower ones are a branch, whose time constant the plant has
    once for both axes. At standstill such a loss is hardly told from a late sample; it brakes, and no more than B says:
    of a traction machine it came out 8 times too large, and drawn drives lost their current control.
    """
    sizes_s = [machine.seen(f"eddy_{axis}_s") for axis in "dq"]
    taus_s = [tau_s for axis in "dq" if (tau_s := machine.seen(f"eddy_{axis}_time_s"))]
    if not taus_s:
        return
    out, T_s = setup.machine, machine.inverter.T_s
    sizes_s = [float(rng.uniform(*SEEN_SHARES)) * size_s for size_s in sizes_s]
    tau_s = float(np.mean(taus_s)) * math.exp(rng.uniform(-1.0, 1.0) * math.log(EDDY_FACTOR))
    per_volt = [size_s / L for size_s, L in zip(sizes_s, (out.L_d, out.L_q), strict=True)]
    if np.mean(taus_s) < T_s:
        if sum(per_volt) > 0.0:
            out.R_iron = 2.0 / sum(per_volt)
            drag, most = iron_drag(out.pole_pairs, out.psi_f, out.R_iron), _most_friction(machine, out.B)
            if machine.machine.B_nms is not None and drag > most > 0.0:
                out.R_iron *= drag / most
                drag = most
            out.B = max(0.0, out.B - drag)  # identified as one
        return
    out.eddy_rate = 1.0 / max(tau_s, T_s)  # shorter than a step of the plant would not be integrated
    out.eddy_d, out.eddy_q = (amperes * out.eddy_rate for amperes in per_volt)


def _draw_hidden_iron_loss(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw an iron loss that no sample holds, where psi_f shows its current: a share of what brakes like friction.

    In the zero vector of a sample the core has no voltage. Within the pulses its current flows through the legs, and
    what the inverter loses depends on that: of a healthy drive whose loss was 4.9 %, i_q was at 1.01 of its band.
    """
    known, out = machine.machine, setup.machine
    rated_nm, rated_rad_s = known.torque_nm(0.0, known.I_nom_apk or 0.0), rad_s_from_rpm(known.n_nom_rpm or 0.0)
    seen = machine.conditions.get("unseen_current_a") and not (out.R_iron > 0.0 or out.eddy_rate > 0.0)
    if not seen or not known.B_nms or not out.psi_f or not rated_rad_s > 0.0:
        return
    most = min(_most_friction(machine, 0.0), IRON_LOSS * abs(rated_nm) / rated_rad_s)
    drag = most * float(rng.uniform(0.0, 1.0))
    if drag > 0.0:
        out.R_iron, setup.iron_hidden = iron_drag(out.pole_pairs, out.psi_f, 1.0) / drag, 1.0
        out.B = max(0.0, out.B - drag)


def _most_friction(machine: MachineFile, drawn_nms: float) -> float:
    """Return the viscous friction up to which an iron loss may brake: what was drawn, or the end of its interval.

    With what was drawn alone, a loss of 8 % that the inductances showed within 1 % was taken for less where B was known
    to no better than its value, and a healthy drive left its band.
    """
    return max(drawn_nms, (machine.machine.B_nms or 0.0) + NORMAL_95 * machine.std.get("B_nms", 0.0))


def _draw_harmonics(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw the 5th and 7th harmonic of the back-EMF.

    About what was identified, at any phase; of a back-EMF of which nothing was identified, within the usual range.
    """
    out, seen = setup.machine, machine.estimates
    for key, (name, order, most) in EMF_HARMONICS.items():
        found = seen.get(key)
        share = float(rng.uniform(*SEEN_SHARES)) if found is not None else float(rng.uniform(0.0, 1.0))
        flux = found.value if found is not None else most * out.psi_f / order
        setattr(out, name, float(rng.choice((-1.0, 1.0))) * share * flux)


def _draw_elastic_shaft(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Divide the inertia into the two masses that resonance and antiresonance tell, or that a shaft with play may have.

    Without either, nothing. A light rotor runs ahead within its play: 0.11 degrees and half of the inertia moved i_q by
    0.1 of 2.2 A after steps of 3 ms.
    """
    known, out = machine.machine, setup.machine
    if not (shafts := shafts_of(machine)):
        return
    shaft = shafts[0]
    if known.resonance_hz is None:
        shaft = shafts[int(rng.integers(len(shafts)))]
    elif hides_play(machine):
        shaft = by_more_torque(shaft, float(rng.uniform(0.0, 1.0)))
    if not shaft.elastic:
        return
    places = {"resonance_hz": shaft.resonance_hz, "antiresonance_hz": shaft.antiresonance_hz}
    halves = {name: doubt(machine, name, getattr(known, name) or place) for name, place in places.items()}
    w_r, w_a = (2.0 * math.pi * place * float(rng.uniform(*about(1.0, halves[name]))) for name, place in places.items())
    if w_a >= w_r:
        return
    out.J_load = out.J * (1.0 - (w_a / w_r) ** 2)
    out.J -= out.J_load
    out.coupling_stiffness = out.J_load * w_a**2
    zeta = shaft.zeta * math.exp(rng.uniform(-1.0, 1.0) * math.log(ZETA_FACTOR))
    out.coupling_damping = damping_nms_per_rad(out.coupling_stiffness, w_r, zeta)


def _draw_shaft_effects(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw what was identified along the shaft: drag, largest order of the cogging, errors and noise of the encoder."""
    out, sensors = setup.machine, setup.sensors
    sensors.encoder_lines = machine.seen("encoder_lines") or sensors.encoder_lines
    for name in ("encoder_once", "encoder_twice", "encoder_line", "encoder_line_twice"):
        if error_rad := machine.seen(f"{name}_rad"):
            setattr(sensors, name, float(rng.uniform(*SEEN_SHARES)) * error_rad)
    sensors.encoder_noise = machine.seen("encoder_noise_rad") or sensors.encoder_noise
    if drag := machine.seen("drag_nms2"):
        out.drag = float(rng.uniform(*SEEN_SHARES)) * drag
    torque_nm, periods = machine.seen("cogging_nm"), machine.seen("cogging_periods")
    if torque_nm and periods:
        out.cogging, out.cogging_periods = float(rng.uniform(*SEEN_SHARES)) * torque_nm, periods


def with_fine_cogging(setup: Setup, machine: MachineFile, share: float) -> None:
    """Give a drawn machine a share of the largest usual cogging, of a fine order, where none was looked for."""
    known, out = machine.machine, setup.machine
    if not (out.cogging or "cogging_nm" in machine.estimates):
        out.cogging = share * FINE_COGGING * abs(known.torque_nm(0.0, known.I_nom_apk or 0.0))
        out.cogging_periods = float(FINE_ORDER * known.pole_pairs)


def _timing(machine: MachineFile, rng: np.random.Generator, *, late: bool) -> tuple[float, float, float]:
    """Draw the lag of the current sensors, the sampling instant and the age of the encoder's angle (s).

    About what was identified, else a short lag, and half of the samples late. What lag and instant do together is known
    better than either: what one is drawn longer, the other is earlier. An old angle shows at speed what a late sample
    does: half of the drives have the one, half the other; the age is then all that the d voltage at speed shows, of
    which a late sample that the square waves at standstill show is only the middle.
    """
    shown = machine.conditions.get("shown_instant_s")
    age = shown if isinstance(shown, float) else 0.0
    lag, instant, T_s = machine.inverter.current_lag_s, machine.inverter.sampling_instant_s, machine.inverter.T_s
    where = float(rng.uniform(0.0, 1.0))
    if lag is None or instant is None:
        late_s = float(rng.uniform(0.0, LATE_SHARE)) * T_s if late and rng.random() < 0.5 else 0.0
        return where**3 * min(max(LAG_S, LAG_SHARES[0] * T_s), LAG_SHARES[1] * T_s), late_s, 0.0
    stds = [machine.estimates[name].std for name in (LAG, INSTANT) if name in machine.estimates]
    apart = (2.0 * where - 1.0) * TIMING_COVERAGE * math.hypot(*stds)
    shift = max(-T_s, min(T_s, instant - apart))
    lag_s, shift_s = max(0.0, lag + apart), shift if late else min(0.0, shift)
    if max(instant, age) > 0.0 and rng.random() < 0.5:
        return lag_s, 0.0, max(0.0, shift_s, age)
    return lag_s, shift_s, 0.0


def _draw_inverter(setup: Setup, machine: MachineFile, rng: np.random.Generator) -> None:
    """Draw the inverter's error: every other drive with each edge, where the ripple decides what a dead time does.

    The plateau is dead time and thresholds together; the knee is what charges a leg's output within the dead time.
    """
    inverter, out = machine.inverter, setup.inverter
    nominal = out.dead_time[2]
    dead = nominal * float(rng.uniform(1.0 - DEAD_SPREAD, 1.0 + DEAD_SPREAD))
    mismatch = MISMATCH_OF_LEGS * dead * float(rng.uniform(-1.0, 1.0))
    knee = out.i_knee * math.exp(rng.uniform(-1.0, 1.0) * math.log(KNEE_FACTOR))
    share = float(rng.uniform(0.0, LARGEST_DROP_SHARE))
    if rng.random() < 0.5:
        out.model, out.shape = MODELS.index("averaged"), int(rng.integers(SHAPES.index("atan"), len(SHAPES)))
        out.i_knee, out.dead_time[:] = knee, [dead] * 3
        return
    out.model = MODELS.index("switched")
    out.dead_time[:] = [(1.0 - share) * t for t in (dead + mismatch, dead - mismatch, dead)]
    drop = share * dead * setup.U_dc / inverter.T_s
    out.V_switch, out.V_diode = drop, drop
    capacitance = 0.5 * knee * (1.0 - share) * dead / setup.U_dc
    L = min(setup.machine.L_d, setup.machine.L_q)
    least = library().pmsm_inverter_smallest_capacitance(dead + abs(mismatch), L)
    out.capacitance = capacitance if capacitance >= least else 0.0


def _friction(machine: MachineFile, rng: np.random.Generator) -> tuple[float, float]:
    """Draw viscous (N m s) and Coulomb friction (N m)."""
    known = machine.machine
    torque = abs(known.torque_nm(0.0, known.I_nom_apk or known.I_max_apk or 0.0))
    omega = rad_s_from_rpm(known.n_nom_rpm or known.n_max_rpm or 3000.0)
    drawn = []
    for name, largest in (("B_nms", FRICTION_SHARE * torque / omega), ("tau_c_nm", FRICTION_SHARE * torque)):
        factor, value = math.exp(rng.uniform(-1.0, 1.0) * math.log(FRICTION_FACTOR)), getattr(known, name)
        off = float(rng.standard_normal()) * machine.std.get(name, 0.0)
        drawn.append(float(rng.uniform(0.0, largest)) if value is None else max(0.0, factor * value + off))
    return drawn[0], drawn[1]
