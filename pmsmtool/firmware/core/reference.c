/* SPDX-License-Identifier: MIT */
/* From what is asked for (speed, torque) to a current request, within the current the machine may carry. */
#include "pmsm_period.h"

#include <stddef.h>

pmsm_real pmsm_torque(const pmsm_params *params, const pmsm_magnetics *m, pmsm_dq i)
{
    const pmsm_real psi_d = m->psi_f + m->L_d_app * i.d;
    const pmsm_real psi_q = m->L_q_app * i.q;
    return PMSM_C(1.5) * (pmsm_real)params->motor_pole_pairs * (psi_d * i.q - psi_q * i.d);
}

/* Thermal budget: the square of the current above I_cont^2, scaled so that I_max uses it up in I_max_time. The
 * increments are far below the resolution of a float near 1, hence the carry (Kahan). */
void pmsm_update_i2t(pmsm_period *period)
{
    pmsm_state *state = period->state;
    const pmsm_real I_cont = (pmsm_real)period->params->protection_I_cont_apk;
    const pmsm_real increment =
        state->derived.i2t_rate * (pmsm_square(period->i) - I_cont * I_cont) - state->i2t_carry;
    const pmsm_real sum = state->i2t + increment;
    state->i2t_carry = (sum - state->i2t) - increment;
    state->i2t = sum;
    if (sum <= PMSM_C(0.0) || sum >= PMSM_C(1.0)) {
        state->i2t = (sum <= PMSM_C(0.0)) ? PMSM_C(0.0) : PMSM_C(1.0);
        state->i2t_carry = PMSM_C(0.0);
    }
    if (state->i2t >= PMSM_C(1.0)) {
        state->i2t_exhausted = 1u;
    } else if (state->i2t < PMSM_C(0.9)) {
        state->i2t_exhausted = 0u;
    }
    period->flags |= (state->i2t_exhausted != 0u) ? (uint32_t)PMSM_FLAG_I2T : 0u;
}

pmsm_real pmsm_current_limit(const pmsm_period *period)
{
    const pmsm_real I_max = (pmsm_real)period->params->motor_I_max_apk;
    const pmsm_real I_cont = (pmsm_real)period->params->protection_I_cont_apk;
    const uint32_t no_overload = (period->params->motor_I_max_time_s <= 0.0F) ? 1u : 0u;
    return ((period->state->i2t_exhausted | no_overload) != 0u && I_cont < I_max) ? I_cont : I_max;
}

/* Field-weakening current first: i_d keeps its value up to the limit, i_q gets what is left. */
pmsm_dq pmsm_limit_current(pmsm_period *period, pmsm_dq i)
{
    const pmsm_real limit = pmsm_current_limit(period);
    if (pmsm_is_within(i, limit) != 0u) {
        return i;
    }
    period->flags |= (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
    i.d = pmsm_clamp(i.d, -limit, limit);
    const pmsm_real i_q = PMSM_SQRT(pmsm_max(limit * limit - i.d * i.d, PMSM_C(0.0)));
    i.q = (i.q < PMSM_C(0.0)) ? -i_q : i_q;
    return i;
}

/* (34) of Jercic et al. 2017: i_q = T/(1.5 p (psi + (L_d - L_q) i_d)) at the loss-minimising i_d. */
static pmsm_dq direct_current(const pmsm_period *period, pmsm_real tau)
{
    const pmsm_params *params = period->params;
    pmsm_dq i;
    i.d = (pmsm_real)params->field_weakening_i_d_lm_a;
    const pmsm_real saliency = (pmsm_real)params->motor_L_d_app_h - (pmsm_real)params->motor_L_q_app_h;
    const pmsm_real k =
        period->state->derived.torque_per_flux * ((pmsm_real)params->motor_psi_f_wb + saliency * i.d);
    i.q = (k > PMSM_C(0.0)) ? tau / k : PMSM_C(0.0);
    return i;
}

#define LINK_RATE PMSM_C(500.0) /* 1/s, of the mean that tells whether the link falls */

/* Where a falling link will be. Leading a current away from where the voltage cannot hold it takes longer than the
 * voltage takes to fall, most of all while braking, when the EMF drives it on. */
static pmsm_real link_ahead(pmsm_state *state, pmsm_real U_dc)
{
    const pmsm_real weight = pmsm_clamp(state->derived.T_s * LINK_RATE, PMSM_C(0.0), PMSM_C(1.0));
    const pmsm_real before = state->U_dc_slow; /* 0: the last period had no use for it */
    state->U_dc_slow = (before > PMSM_C(0.0)) ? before + weight * (U_dc - before) : U_dc;
    const pmsm_real fall = U_dc - state->U_dc_slow;
    return (fall < PMSM_C(0.0) && U_dc > -fall) ? U_dc + fall : U_dc;
}

pmsm_dq pmsm_torque_to_current(pmsm_period *period, pmsm_real tau)
{
    const pmsm_params *params = period->params;
    pmsm_dq i;
    const uint32_t mode = params->field_weakening_mode;
    period->U_ahead = link_ahead(period->state, period->U_dc);
    if (mode == PMSM_FW_LUT && params->lut_format != PMSM_LUT_NONE && period->lut != NULL) {
        i = pmsm_lookup(period, tau, pmsm_current_limit(period));
#if PMSM_LAW_FIELD_WEAKENING
    } else if (mode != PMSM_FW_OFF && mode != PMSM_FW_LUT) {
        i = pmsm_field_weakening(period, tau);
#endif
    } else {
        i = direct_current(period, tau);
    }
    const pmsm_real i_d_min = (pmsm_real)params->field_weakening_i_d_min_a;
    if (i.d < i_d_min) {
        i.d = i_d_min;
        period->flags |= (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
    }
    i = pmsm_limit_current(period, i);
    period->state->tau_granted = pmsm_torque(params, &period->state->derived.nominal, i);
    return i;
}

static pmsm_real notch(pmsm_state *state, pmsm_real x)
{
    const pmsm_derived *d = &state->derived;
    if (d->notch_b0 == PMSM_C(0.0)) {
        return x;
    }
    const pmsm_real y = d->notch_b0 * x + state->notch_1;
    state->notch_1 = d->notch_b1 * (x - y) + state->notch_2;
    state->notch_2 = d->notch_b2 * x - d->notch_a2 * y;
    return y;
}

/* What the limits left of the last torque: an integrator must not charge against them. The 5 % are for the
 * interpolation error of a table, which is no limit. */
static pmsm_real torque_cut(const pmsm_state *state)
{
    const pmsm_real granted = state->tau_granted / PMSM_C(0.95);
    const pmsm_real asked = state->tau_speed;
    if (asked > PMSM_C(0.0)) {
        return (granted < asked) ? pmsm_max(granted, PMSM_C(0.0)) - asked : PMSM_C(0.0);
    }
    return (granted > asked) ? pmsm_min(granted, PMSM_C(0.0)) - asked : PMSM_C(0.0);
}

static pmsm_real speed_update(pmsm_period *period)
{
    pmsm_state *state = period->state;
    const pmsm_params *params = period->params;
    const pmsm_real T = state->derived.speed_period;
    const pmsm_reference *request = period->request;
    const uint32_t positioned = (request->mode == PMSM_MODE_POSITION) ? 1u : 0u;
    const pmsm_real slope = (pmsm_real)params->speed_acceleration_rpm_per_s / PMSM_RPM * T;
    const pmsm_real change = request->omega_M_ref - state->omega_ref_ramped;
    state->omega_ref_ramped += (positioned != 0u) ? change : pmsm_clamp(change, -slope, slope);

    const pmsm_real K_p = (pmsm_real)params->speed_K_p_nms_per_rad;
    const pmsm_real tau_max = (pmsm_real)params->speed_tau_max_nm;
    const pmsm_real error = state->omega_ref_ramped - state->omega_filtered;
    const pmsm_real ahead = (positioned != 0u) ? request->tau_ref : PMSM_C(0.0);
    const pmsm_real tau = K_p * error + state->speed_integrator + ahead;
    const pmsm_real limited = pmsm_clamp(tau, -tau_max, tau_max);
    const pmsm_real cut = (limited - tau) + torque_cut(state);
    const pmsm_real back = (K_p > PMSM_C(0.0)) ? cut / K_p : PMSM_C(0.0);
    state->speed_integrator += (T * (pmsm_real)params->speed_K_i_nm_per_rad) * (error + back);
    return pmsm_clamp(notch(state, limited), -tau_max, tau_max);
}

pmsm_real pmsm_speed_control(pmsm_period *period)
{
    pmsm_state *state = period->state;
    if (state->speed_count == 0u) {
        state->tau_speed = speed_update(period);
        state->speed_count = period->params->speed_decimation;
    }
    state->speed_count--;
    return state->tau_speed;
}
