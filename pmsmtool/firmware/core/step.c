/* SPDX-License-Identifier: MIT */
/* One PWM period. */
#include "pmsm_period.h"

#include <stddef.h>

#define BANDWIDTH_LEAST PMSM_C(1e-3) /* rad/s, of the bias loop */
#define LINK_LEAST PMSM_C(1e-3)      /* V; duty ratios divide by it */
#define SHORT_ENDS PMSM_C(0.9)       /* of the speed at which a short circuit began */

void pmsm_init(pmsm_state *state)
{
    const pmsm_state zero = {0};
    *state = zero;
    state->live.kappa = PMSM_C(1.0);
    state->live.binding = 255u;
}

void pmsm_parameters_changed(pmsm_state *state)
{
    if (state->prepared == 1u) {
        state->prepared = 2u;
    }
}

/* Forget everything but the thermal budget: what is energised next starts from rest. */
static void reset_controllers(pmsm_state *state, pmsm_real omega_M)
{
    const pmsm_dq zero = {PMSM_C(0.0), PMSM_C(0.0)};
    const pmsm_polar_state no_polar = {0};
    state->integrator = zero;
    state->voltage_committed = zero;
    state->voltage_before = zero;
    state->harmonic_committed = zero;
    state->harmonic_before = zero;
    state->harmonic_flux = zero;
    state->harmonic_mean = zero;
    state->reference_held = zero;
    state->reference_realised = zero;
    state->disturbance = zero;
    state->news_before = zero;
    state->news_mean = zero;
    state->fw_reference = zero;
    state->time_to_go = PMSM_C(0.0);
    state->landing = 0u;
    state->reachable_age = 0u;
    state->reachable_multiplier = PMSM_C(0.0);
    state->cornered = 0u;
    state->fw_left = 0u;
    state->speed_integrator = PMSM_C(0.0);
    state->notch_1 = PMSM_C(0.0);
    state->notch_2 = PMSM_C(0.0);
    state->tau_speed = PMSM_C(0.0);
    state->tau_granted = PMSM_C(0.0);
    state->omega_filtered = omega_M;
    state->omega_ref_ramped = omega_M;
    state->fw_count = 0u;
    state->fw_tau = PMSM_C(0.0);
    state->fw_U_dc = PMSM_C(0.0);
    state->U_dc_slow = PMSM_C(0.0);
    state->fw_empty = 0u;
    state->fw_multiplier = PMSM_C(0.0);
    state->fw_corner_state = 0u;
    state->lut_cut = 0u;
    state->speed_count = 0u;
    state->polar = no_polar;
}

#define INPUT_MOST PMSM_C(1e7) /* A, V, N m, rad/s, K: far above every drive's, far below what overflows */

/* Every comparison with NaN is false, and a sum of sizes shows each of them. A bandwidth may be zero, not tiny: gains
 * divide. */
static uint32_t is_usable(const pmsm_measurement *m, const pmsm_reference *r, pmsm_real turn, pmsm_real advance)
{
    const pmsm_real T = (m->T_winding == m->T_winding) ? m->T_winding : PMSM_C(0.0);
    const pmsm_real sampled = pmsm_abs(m->i_a) + pmsm_abs(m->i_b) + pmsm_abs(m->i_c) + pmsm_abs(m->U_dc) + pmsm_abs(T);
    const pmsm_real asked = pmsm_abs(r->i_d_ref) + pmsm_abs(r->i_q_ref) + pmsm_abs(r->tau_ref) +
                            pmsm_abs(r->omega_M_ref) + pmsm_abs(r->u_d_inject) + pmsm_abs(r->u_q_inject) +
                            pmsm_abs(r->bias_bandwidth);
    const uint32_t tiny = (r->bias_bandwidth > PMSM_C(0.0) && r->bias_bandwidth < BANDWIDTH_LEAST) ? 1u : 0u;
    return (sampled + asked <= INPUT_MOST && pmsm_abs(turn) <= PMSM_PI &&
            pmsm_abs(m->theta_e) + pmsm_abs(advance) <= PMSM_ANGLE_MAX && r->mode <= (uint32_t)PMSM_MODE_POSITION &&
            tiny == 0u)
               ? 1u
               : 0u;
}

static pmsm_real winding_resistance(const pmsm_params *params, pmsm_real T_winding)
{
    const pmsm_real rise = T_winding - (pmsm_real)params->motor_T_ref_c;
    const pmsm_real R_s = (pmsm_real)params->motor_R_s_ohm;
    /* no sensor shows as NaN: the value at the reference temperature stays */
    return (rise == rise) ? R_s * (PMSM_C(1.0) + (pmsm_real)params->motor_alpha_R_per_k * rise) : R_s;
}

static void transform(pmsm_period *period, const pmsm_measurement *m, pmsm_real advance)
{
    const pmsm_abc phases = {m->i_a, m->i_b, m->i_c};
    pmsm_sincos(m->theta_e, &period->sine, &period->cosine);
    pmsm_sincos(m->theta_e + advance, &period->sine_out, &period->cosine_out);
    period->i = pmsm_park(pmsm_clarke(phases), period->sine, period->cosine);
    period->i_model = period->i;
    period->omega_e = m->omega_e;
    period->omega_M = m->omega_e / period->state->derived.pole_pairs;
    period->U_dc = (m->U_dc > LINK_LEAST) ? m->U_dc : PMSM_C(0.0);
    period->V_max = (pmsm_real)period->params->inverter_voltage_utilisation * period->U_dc;
    period->R_s = winding_resistance(period->params, m->T_winding);
}

/* The current the mode asks for. */
static pmsm_dq current_request(pmsm_period *period)
{
    const pmsm_reference *request = period->request;
    if (request->mode == PMSM_MODE_CURRENT) {
        period->state->U_dc_slow = PMSM_C(0.0);
        const pmsm_dq asked = {request->i_d_ref, request->i_q_ref};
        return pmsm_limit_current(period, asked);
    }
    const pmsm_real tau = (request->mode == PMSM_MODE_TORQUE) ? request->tau_ref : pmsm_speed_control(period);
    return pmsm_torque_to_current(period, tau);
}

/* A bias loop has the gains that its experiment expects. */
static void follow_saturation(pmsm_period *period, pmsm_dq i)
{
    if (period->state->derived.saturates != 0u && period->lut != NULL &&
        period->request->bias_bandwidth <= PMSM_C(0.0)) {
        pmsm_saturate(period, i);
    }
}

/* At the voltage limit i_q lags its reference: the field-weakening current takes no more than what i_q itself leaves of
 * the limit, as long as the voltage still reduces i_q there. Where the EMF drives i_q on, only weaker flux helps. */
static void hold_weakening(pmsm_period *period)
{
    const uint32_t limited = period->state->live.flags & (uint32_t)PMSM_FLAG_VOLTAGE_LIMITED; /* in the last period */
    if (limited == 0u || period->request->mode == PMSM_MODE_CURRENT) {
        return;
    }
    const pmsm_real limit = pmsm_current_limit(period);
    const pmsm_real rest = limit * limit - period->i_model.q * period->i_model.q;
    if (rest > PMSM_C(0.0) && pmsm_abs(pmsm_model_voltage(period, period->i_model).q) < period->V_max) {
        period->reference.d = pmsm_clamp(period->reference.d, -PMSM_SQRT(rest), limit);
    }
}

static void field_oriented(pmsm_period *period, pmsm_output *output)
{
    if (period->state->derived.predicts != 0u) {
        pmsm_predict_current(period);
        follow_saturation(period, period->i_model);
    }
#if PMSM_LAW_GOVERNOR
    const uint32_t governed = (period->params->governor_mode != PMSM_GOVERNOR_OFF) ? pmsm_govern(period) : 0u;
#else
    const uint32_t governed = 0u;
#endif
    if (governed == 0u) {
        hold_weakening(period);
        pmsm_current_demand(period);
    }
    pmsm_modulate(period, output);
    pmsm_current_integrate(period);
}

#if PMSM_LAW_POLAR
static void polar(pmsm_period *period, pmsm_output *output)
{
    pmsm_polar_demand(period);
    pmsm_modulate(period, output);
    pmsm_polar_settle(period);
}
#endif

static void control(pmsm_period *period, pmsm_output *output)
{
    pmsm_live *live = &period->state->live;
    follow_saturation(period, period->i);
    const pmsm_dq request = current_request(period);
    live->i_d_req = request.d;
    live->i_q_req = request.q;
    period->reference = request;
#if PMSM_LAW_POLAR
    if (period->params->polar_mode != PMSM_POLAR_OFF && period->request->bias_bandwidth <= PMSM_C(0.0)) {
        polar(period, output);
    } else {
        field_oriented(period, output);
    }
#else
    field_oriented(period, output);
#endif
    period->state->reference_held = period->reference;
}

static void inject_only(pmsm_period *period, pmsm_output *output)
{
    period->u.d = period->request->u_d_inject;
    period->u.q = period->request->u_q_inject;
    pmsm_modulate(period, output);
    period->state->U_dc_slow = PMSM_C(0.0);
    period->state->integrator.d = PMSM_C(0.0);
    period->state->integrator.q = PMSM_C(0.0);
    period->state->live.i_d_req = PMSM_C(0.0);
    period->state->live.i_q_req = PMSM_C(0.0);
}

static void gates_off(pmsm_state *state, pmsm_output *output, pmsm_real omega_M)
{
    reset_controllers(state, omega_M);
    output->duty_a = PMSM_C(0.5);
    output->duty_b = PMSM_C(0.5);
    output->duty_c = PMSM_C(0.5);
    output->u_alpha = PMSM_C(0.0);
    output->u_beta = PMSM_C(0.0);
    output->gates = 0u;
    state->live.i_d_req = PMSM_C(0.0);
    state->live.i_q_req = PMSM_C(0.0);
}

/* A fault: gates off. Above the speed of the parameters the diodes would rectify the EMF into the link: the lower
 * switches short the windings there. Not both in turn around that speed, hence the lower end. */
static void react(pmsm_state *state, const pmsm_params *params, pmsm_real omega_e, pmsm_output *output)
{
    const pmsm_real from = (pmsm_real)params->protection_n_short_circuit_rpm;
    const pmsm_real omega_M = omega_e / state->derived.pole_pairs;
    const pmsm_real rpm = pmsm_abs(omega_M) * PMSM_RPM;
    const pmsm_real limit = (state->shorted != 0u) ? SHORT_ENDS * from : from;
    gates_off(state, output, omega_M);
    state->shorted = (from > PMSM_C(0.0) && rpm > limit) ? 1u : 0u;
    if (state->shorted != 0u) {
        output->duty_a = PMSM_C(0.0);
        output->duty_b = PMSM_C(0.0);
        output->duty_c = PMSM_C(0.0);
        output->gates = 1u;
    }
}

/* A period without usable inputs or result: the first holds the last voltage, the second is a fault. */
static void bad_period(pmsm_state *state, const pmsm_params *params, uint32_t fault, pmsm_output *output)
{
    pmsm_live *live = &state->live;
    if (state->bad_periods != 0u && state->fault == (uint32_t)PMSM_FAULT_NONE) {
        state->fault = fault;
    }
    state->bad_periods = 1u;
    live->flags = (uint32_t)PMSM_FLAG_HELD;
    if (state->fault != (uint32_t)PMSM_FAULT_NONE) {
        react(state, params, live->omega_e, output); /* at the last known speed */
        live->flags = (uint32_t)PMSM_FLAG_FAULT;
    } else {
        pmsm_hold_output(state, output);
        state->voltage_before = state->voltage_committed;
        state->voltage_committed.d = output->u_alpha;
        state->voltage_committed.q = output->u_beta;
    }
    state->gates_before = output->gates;
}

void pmsm_reset_fault(pmsm_state *state)
{
    state->fault = (uint32_t)PMSM_FAULT_NONE;
    state->bad_periods = 0u;
    state->shorted = 0u;
    state->gates_before = 0u;
}

static void publish(pmsm_period *period, const pmsm_measurement *m)
{
    pmsm_live *live = &period->state->live;
    live->i_d = period->i.d;
    live->i_q = period->i.q;
    if (period->state->derived.overmodulates != 0u) {
        live->i_d += period->i_harmonic.d;
        live->i_q += period->i_harmonic.q;
    }
    live->i_d_ref = period->reference.d;
    live->i_q_ref = period->reference.q;
    live->u_d = period->u.d;
    live->u_q = period->u.q;
    live->u_d_lim = period->u_realised.d + period->u_compensation.d;
    live->u_q_lim = period->u_realised.q + period->u_compensation.q;
    live->theta_e = pmsm_wrap(m->theta_e);
    live->omega_e = m->omega_e;
    live->tau = pmsm_torque(period->params, period->magnetics, period->i);
    live->flags = period->flags;
}

void pmsm_step(pmsm_state *state, const pmsm_params *params, const uint32_t *lut, const pmsm_measurement *measurement,
               const pmsm_reference *reference, pmsm_output *output)
{
    const pmsm_dq zero = {PMSM_C(0.0), PMSM_C(0.0)};
    pmsm_period period;
    if (state->prepared != 1u) {
        const uint32_t fresh = (state->prepared == 0u) ? 1u : 0u;
        pmsm_prepare(state, params);
        if (fresh != 0u) {
            state->omega_filtered = measurement->omega_e / state->derived.pole_pairs;
            state->omega_ref_ramped = state->omega_filtered;
        }
    }
    const pmsm_real turn = state->derived.T_s * measurement->omega_e;
    const pmsm_real advance =
        (pmsm_real)params->inverter_delay_periods * state->derived.T_s * measurement->omega_e;
    if (is_usable(measurement, reference, turn, advance) == 0u) {
        bad_period(state, params, (uint32_t)PMSM_FAULT_INPUT, output);
        return;
    }
    period.params = params;
    period.lut = lut;
    period.magnetics = &state->derived.nominal;
    period.request = reference;
    period.state = state;
    period.reference = zero;
    period.u = zero;
    period.u_realised = zero;
    period.u_compensation = zero;
    period.sine_half = PMSM_C(0.0);
    period.cosine_half = PMSM_C(0.0); /* not known yet */
    period.flags = 0u;
    period.steps = 0u;
    period.looked = 0u;
    state->live.kappa = PMSM_C(1.0);
    state->live.binding = PMSM_BINDING_NONE;
    state->live.iterations = 0u;
    transform(&period, measurement, advance);
    pmsm_update_i2t(&period);
    if (state->derived.overmodulates != 0u) {
        pmsm_remove_harmonics(&period);
    }
    state->omega_filtered += state->derived.speed_filter * (period.omega_M - state->omega_filtered);
    if (state->fault != (uint32_t)PMSM_FAULT_NONE || reference->mode == PMSM_MODE_FAULT) {
        react(state, params, measurement->omega_e, output);
        period.flags |= (state->fault != (uint32_t)PMSM_FAULT_NONE) ? (uint32_t)PMSM_FLAG_FAULT : 0u;
    } else if (reference->mode == PMSM_MODE_OFF) {
        gates_off(state, output, period.omega_M);
        state->shorted = 0u;
    } else {
        if (reference->mode == PMSM_MODE_VOLTAGE) {
            inject_only(&period, output);
        } else {
            control(&period, output);
        }
        const pmsm_real duties = (output->duty_a + output->duty_b) + output->duty_c;
        if (!(duties >= PMSM_C(0.0))) { /* whatever stands in the memory: from rest again */
            const pmsm_dq committed = state->voltage_committed;
            reset_controllers(state, period.omega_M);
            state->voltage_committed = committed;
            bad_period(state, params, (uint32_t)PMSM_FAULT_RESULT, output);
            return;
        }
        state->shorted = 0u;
        state->voltage_before = state->voltage_committed;
        state->voltage_committed.d = output->u_alpha;
        state->voltage_committed.q = output->u_beta;
        if (state->derived.overmodulates != 0u) {
            state->harmonic_before = state->harmonic_committed;
            state->harmonic_committed = period.u_harmonic;
        }
    }
    state->bad_periods = 0u;
    state->gates_before = output->gates;
    state->U_dc_before = period.U_dc;
    state->current_before = period.i;
    publish(&period, measurement);
}
