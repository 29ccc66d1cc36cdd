/* SPDX-License-Identifier: MIT */
/* Current controller: PI with decoupling, emf feed-forward and realizable-reference anti-windup.
 *
 *   u_d = K_p e_d + x_d - omega_e L_q i_q          e = reference - i
 *   u_q = K_p e_q + x_q + omega_e (L_d i_d + psi)  x += T_s K_i (e + (u_realised - u)/K_p)
 *
 * The correction is the reference that the limited voltage would have realised (Hanus, Kinnaert, Henrotte,
 * Automatica 23 (1987) 729-739). With the one-step predictor the proportional part and the decoupling see the
 * predicted current, the integrators the sampled one against the reference of the last period, so that neither a model
 * error nor the delay itself charges them.
 */
#include "pmsm_period.h"

typedef struct {
    pmsm_dq K_p;
    pmsm_dq K_i;
} current_gains;

/* A bias loop is the PI of the machine's own time constant at the bandwidth asked for: its gain at the frequency of
 * an injection is bias_bandwidth/omega of the winding's impedance, so it does not fight it. */
static current_gains select_gains(const pmsm_period *period)
{
    const pmsm_params *params = period->params;
    const pmsm_real bandwidth = period->request->bias_bandwidth;
    current_gains gains;
    if (bandwidth > PMSM_C(0.0)) {
        gains.K_p.d = bandwidth * period->magnetics->L_d;
        gains.K_p.q = bandwidth * period->magnetics->L_q;
        gains.K_i.d = bandwidth * (pmsm_real)params->motor_R_s_ohm;
        gains.K_i.q = gains.K_i.d;
        return gains;
    }
    gains.K_p = period->magnetics->K_p;
    gains.K_i.d = (pmsm_real)params->current_K_i_d_v_per_as;
    gains.K_i.q = (pmsm_real)params->current_K_i_q_v_per_as;
    return gains;
}

/* Rotation voltages of a current, as far as the options ask for them. */
static pmsm_dq feed_forward(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_params *params = period->params;
    pmsm_dq u = {PMSM_C(0.0), PMSM_C(0.0)};
    pmsm_real psi_d = PMSM_C(0.0);
    if ((params->current_options & PMSM_CURRENT_DECOUPLING) != 0u) {
        u.d = -(period->omega_e * period->magnetics->L_q_app) * i.q;
        psi_d = period->magnetics->L_d_app * i.d;
    }
    if ((params->current_options & PMSM_CURRENT_EMF) != 0u) {
        psi_d += period->magnetics->psi_f;
    }
    u.q = period->omega_e * psi_d;
    return u;
}

static pmsm_dq demand(const pmsm_period *period, pmsm_dq K_p, pmsm_dq reference)
{
    const pmsm_state *state = period->state;
    const pmsm_dq i = period->i_model;
    const pmsm_dq rotation = feed_forward(period, i);
    const pmsm_dq u = {K_p.d * (reference.d - i.d) + state->integrator.d + rotation.d + period->request->u_d_inject,
                       K_p.q * (reference.q - i.q) + state->integrator.q + rotation.q + period->request->u_q_inject};
    return u;
}

void pmsm_current_demand(pmsm_period *period)
{
    period->u = demand(period, select_gains(period).K_p, period->reference);
}

pmsm_dq pmsm_hold_voltage(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_dq rotation = feed_forward(period, i);
    const pmsm_dq u = {period->state->integrator.d + rotation.d, period->state->integrator.q + rotation.q};
    return u;
}

void pmsm_current_row(const pmsm_period *period, pmsm_row *row)
{
    const pmsm_dq zero = {PMSM_C(0.0), PMSM_C(0.0)};
    const pmsm_dq K_p = period->magnetics->K_p; /* the governor does not run with a bias loop */
    const pmsm_dq u = demand(period, K_p, zero);
    row->m_dd = K_p.d;
    row->m_dq = PMSM_C(0.0);
    row->m_qd = PMSM_C(0.0);
    row->m_qq = K_p.q;
    row->c_d = u.d;
    row->c_q = u.q;
    row->V = period->V_max;
}

pmsm_dq pmsm_model_voltage(const pmsm_period *period, pmsm_dq i)
{
    pmsm_dq u;
    u.d = period->R_s * i.d - period->omega_e * period->magnetics->L_q_app * i.q;
    u.q = period->R_s * i.q +
          period->omega_e * (period->magnetics->L_d_app * i.d + period->magnetics->psi_f);
    return u;
}

pmsm_dq pmsm_lost_voltage(const pmsm_period *period, pmsm_dq *inductive)
{
    const pmsm_state *state = period->state;
    const pmsm_params *params = period->params;
    const pmsm_dq held = (params->inverter_delay_periods >= 1.0F) ? state->voltage_before : state->voltage_committed;
    const pmsm_ab stator = {held.d, held.q};
    const pmsm_real sine = -period->sine_half;
    const pmsm_real cosine = period->cosine_half;
    const pmsm_real sine_mean = period->sine * cosine + period->cosine * sine;
    const pmsm_real cosine_mean = period->cosine * cosine - period->sine * sine;
    const pmsm_dq u = pmsm_park(stator, sine_mean, cosine_mean);
    const pmsm_dq i = {PMSM_C(0.5) * (period->i.d + state->current_before.d),
                       PMSM_C(0.5) * (period->i.q + state->current_before.q)};
    const pmsm_dq model = pmsm_model_voltage(period, i);
    const pmsm_real rate = PMSM_C(1.0) / state->derived.T_s;
    const pmsm_real slope_d = (period->i.d - state->current_before.d) * rate;
    const pmsm_real slope_q = (period->i.q - state->current_before.q) * rate;
    inductive->d = period->magnetics->L_d * slope_d;
    inductive->q = period->magnetics->L_q * slope_q;
    const pmsm_dq lost = {u.d - model.d - inductive->d, u.q - model.q - inductive->q};
    return lost;
}

void pmsm_observe_disturbance(pmsm_period *period, pmsm_real gain)
{
    pmsm_dq *held = &period->state->disturbance;
    pmsm_dq inductive;
    pmsm_turn_half(period);
    const pmsm_dq lost = pmsm_lost_voltage(period, &inductive);
    held->d += gain * (lost.d - held->d);
    held->q += gain * (lost.q - held->q);
}

/* What the limiter took, as a change of the reference. A controller without a proportional part has none: at the limit
 * it follows the current, that is, it holds. */
static pmsm_real realised(pmsm_real reference, pmsm_real i, pmsm_real cut, pmsm_real K_p)
{
    if (cut == PMSM_C(0.0)) {
        return reference;
    }
    return (K_p > PMSM_C(0.0)) ? reference + cut / K_p : i;
}

void pmsm_current_integrate(pmsm_period *period)
{
    pmsm_state *state = period->state;
    const current_gains gains = select_gains(period);
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_dq i = period->i;
    pmsm_dq cut = {PMSM_C(0.0), PMSM_C(0.0)};
    if ((period->params->current_options & PMSM_CURRENT_BACK_CALCULATION) != 0u) {
        cut.d = period->u_realised.d - period->u.d;
        cut.q = period->u_realised.q - period->u.q;
    }
    pmsm_dq target = {realised(period->reference.d, i.d, cut.d, gains.K_p.d),
                      realised(period->reference.q, i.q, cut.q, gains.K_p.q)};
    const pmsm_dq now = target;
    if (state->derived.predicts != 0u) {
        target = state->reference_realised; /* the sampled current answers to the reference of the last period */
    }
    state->integrator.d += T_s * gains.K_i.d * (target.d - i.d);
    state->integrator.q += T_s * gains.K_i.q * (target.q - i.q);
    state->reference_realised = now;
}

/* Current at the start of the next period under the voltage that acts in this one. Flux in the stator frame is
 * integrated with the resistance drop at the mean current, then seen from the rotor turned by omega_e T_s. */
void pmsm_predict_current(pmsm_period *period)
{
    const pmsm_real T_s = period->state->derived.T_s;
    const pmsm_ab committed = {period->state->voltage_committed.d, period->state->voltage_committed.q};
    const pmsm_dq u = pmsm_park(committed, period->sine, period->cosine);
    const pmsm_dq psi = {period->magnetics->L_d_app * period->i.d + period->magnetics->psi_f,
                         period->magnetics->L_q_app * period->i.q};
    const pmsm_real drop = PMSM_C(0.5) * T_s * period->R_s;
    pmsm_turn_half(period);
    const pmsm_real half = period->sine_half;
    const pmsm_real sine = PMSM_C(2.0) * half * period->cosine_half;
    const pmsm_real cosine = PMSM_C(1.0) - PMSM_C(2.0) * half * half;
    const pmsm_dq lost = period->state->disturbance; /* what an observer found missing, zero without one */
    const pmsm_ab fixed = {psi.d + T_s * (u.d - lost.d) - drop * period->i.d,
                           psi.q + T_s * (u.q - lost.q) - drop * period->i.q};
    const pmsm_dq turned = pmsm_park(fixed, sine, cosine);
    /* half of the drop belongs to the new current itself: i = i_k + L^-1 (turned - drop i - psi) solved for i */
    const pmsm_real L_d = period->magnetics->L_d;
    const pmsm_real L_q = period->magnetics->L_q;
    pmsm_dq next;
    next.d = (L_d * period->i.d + (turned.d - psi.d)) / (L_d + drop);
    next.q = (L_q * period->i.q + (turned.q - psi.q)) / (L_q + drop);
    period->i_model = next;
    period->flux_model.d = turned.d - drop * next.d;
    period->flux_model.q = turned.q - drop * next.q;
}
