/* SPDX-License-Identifier: MIT */
/* Current control with voltage amplitude and phase as inputs, selected by polar.mode (Miyajima, Fujimoto, Fujitsuna:
 * current control method with control inputs in polar coordinates for SPMSM based on linearized model).
 *
 * Laws 1 and 2 (polar_phase.c) and 3 and 4 are the paper's and belong to machines with L_d = L_q; they take the mean of
 * the two. Law 5 (regularised polar map with memory) and law 6 (polar_unified.c: equilibrium-scheduled with a
 * disturbance observer) hold for L_d != L_q as well.
 */
#include "polar.h"

#define LINEAR_PHASE_LIMIT (PMSM_C(0.5) * PMSM_PI)
#define LINEAR_PHASE_SCHEDULE (PMSM_C(0.45) * PMSM_PI)
#define SMALLEST_SHARE PMSM_C(1e-3)   /* of V: amplitude of the schedule, sign kept */
#define SLOW_SHARE PMSM_C(0.01)       /* of V: below it the d loop slows down, (37) */
#define FOLD (PMSM_C(0.5) * PMSM_PI + PMSM_C(0.2))

/* --- laws 3 and 4: linear range, section IV ------------------------------------------------------------------- */

/* (26)-(35): K_P = a1 L - R and K_I = a0 L of the equivalent time constant tau. */
typedef struct {
    pmsm_real K_p, K_i;
} cdm_gains;

static cdm_gains cdm(pmsm_real gamma, pmsm_real tau, pmsm_real L, pmsm_real R)
{
    const pmsm_real a1 = gamma / tau;
    const pmsm_real K_p = a1 * L - R;
    const cdm_gains gains = {pmsm_max(K_p, PMSM_C(0.0)), a1 / tau * L};
    return gains;
}

/* (15); printed without omega_e on K_e, kept as an ablation. At standstill there is no rotation voltage to follow. */
static pmsm_real decoupling_phase(const pmsm_period *period, const polar_plant *p, pmsm_dq i)
{
    if (pmsm_abs(p->omega) <= PMSM_C(0.0)) {
        return PMSM_C(0.0);
    }
    if (period->params->polar_mode == PMSM_POLAR_LINEAR_PRINTED) {
        return pmsm_arctan(p->omega * p->L * i.q, p->omega * p->L * i.d + p->psi);
    }
    return pmsm_arctan(p->L * i.q, p->L * i.d + p->psi);
}

static pmsm_real away_from_zero(pmsm_real V_a, pmsm_real smallest)
{
    return (V_a < PMSM_C(0.0)) ? pmsm_min(-smallest, V_a) : pmsm_max(smallest, V_a);
}

static uint32_t may_integrate(const pmsm_period *period, pmsm_real x, pmsm_real limit)
{
    const uint32_t inside = (pmsm_abs(x) <= limit) ? 1u : 0u;
    return inside | (((period->params->polar_options & PMSM_POLAR_NO_ANTI_WINDUP) != 0u) ? 1u : 0u);
}

static void linear_range(pmsm_period *period, const polar_plant *p)
{
    pmsm_polar_state *memory = &period->state->polar;
    const pmsm_params *params = period->params;
    const pmsm_real gamma = (pmsm_real)params->polar_gamma;
    const pmsm_real tau = (pmsm_real)params->polar_tau_s;
    const pmsm_dq i = period->i_model;
    const pmsm_dq e = {period->reference.d - i.d, period->reference.q - i.q};
    const pmsm_dq psi = {p->L * i.d + p->psi, p->L * i.q};
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(pmsm_clamp(memory->delta, -LINEAR_PHASE_SCHEDULE, LINEAR_PHASE_SCHEDULE), &sine, &cosine);

    const cdm_gains q = cdm(gamma, tau, p->L, p->R); /* (28), (29) */
    const pmsm_real V_raw =
        p->omega * PMSM_SQRT(pmsm_square(psi)) + (q.K_p * e.q + memory->integrator.q) / cosine;
    const pmsm_real V_a = pmsm_clamp(V_raw, -p->V, p->V);
    memory->integrator.q += (may_integrate(period, V_raw, p->V) != 0u) ? q.K_i * p->T_s * e.q : PMSM_C(0.0);

    const pmsm_real V_o = away_from_zero(V_a, SMALLEST_SHARE * p->V);
    const pmsm_real grip = pmsm_abs(V_o * cosine);
    const pmsm_real slow = SLOW_SHARE * p->V;
    const cdm_gains d = cdm(gamma, (grip < slow) ? tau * slow / grip : tau, p->L, p->R); /* (30), (31), (37) */
    const pmsm_real raw =
        decoupling_phase(period, p, i) - (d.K_p * e.d / (V_o * cosine)) + memory->integrator.d;
    const pmsm_real delta = pmsm_clamp(raw, -LINEAR_PHASE_LIMIT, LINEAR_PHASE_LIMIT);
    memory->integrator.d -= (may_integrate(period, raw, LINEAR_PHASE_LIMIT) != 0u)
                             ? d.K_i * p->T_s * e.d / (V_o * cosine)
                             : PMSM_C(0.0);
    pmsm_sincos(delta, &sine, &cosine);
    period->u.d = -V_a * sine;
    period->u.q = V_a * cosine;
    memory->delta = delta;
    memory->amplitude = V_a;
}

/* --- law 5: dq law, regularised polar map ---------------------------------------------------------------------- */

/* Nearest phase to the wish modulo pi, the slower the smaller the voltage; the amplitude is what the voltage has in
 * that direction. */
void pmsm_polar_map(pmsm_period *period, pmsm_dq v, pmsm_real eps)
{
    pmsm_polar_state *memory = &period->state->polar;
    pmsm_real delta = memory->delta;
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(delta, &sine, &cosine);
    const pmsm_real along = cosine * v.q - sine * v.d;
    const pmsm_real across = -(cosine * v.d + sine * v.q);
    const pmsm_real square = pmsm_square(v) * pmsm_square(v);
    const pmsm_real floor_square = (eps * eps) * (eps * eps);
    if (square > PMSM_C(0.0)) {
        delta += pmsm_arctan(across, along) * (square / (square + floor_square));
    }
    if (delta > FOLD) {
        delta -= PMSM_PI;
    } else if (delta < -FOLD) {
        delta += PMSM_PI;
    }
    pmsm_sincos(delta, &sine, &cosine);
    const pmsm_real V_a = cosine * v.q - sine * v.d;
    period->u.d = -V_a * sine;
    period->u.q = V_a * cosine;
    memory->delta = delta;
    memory->amplitude = V_a;
}

typedef struct {
    cdm_gains d, q;
} axis_gains;

static axis_gains regularised_gains(const pmsm_period *period)
{
    const pmsm_params *params = period->params;
    const pmsm_real gamma = (pmsm_real)params->polar_gamma;
    const pmsm_real tau = (pmsm_real)params->polar_tau_s;
    const axis_gains gains = {cdm(gamma, tau, (pmsm_real)params->motor_L_d_h, period->R_s),
                              cdm(gamma, tau, (pmsm_real)params->motor_L_q_h, period->R_s)};
    return gains;
}

/* What the law asks for without its integrators. */
static pmsm_dq regularised_base(const pmsm_period *period, const axis_gains *gains)
{
    const pmsm_real b = (pmsm_real)period->params->polar_b;
    const pmsm_dq i = period->i_model;
    const pmsm_dq model = pmsm_model_voltage(period, i);
    const pmsm_dq v = {gains->d.K_p * (b * period->reference.d - i.d) + (model.d - period->R_s * i.d),
                       gains->q.K_p * (b * period->reference.q - i.q) + (model.q - period->R_s * i.q)};
    return v;
}

/* With prediction the voltage acts one period later, when the integrators of a law without delay have seen this sample:
 * they take it before the law asks, not after. */
static uint32_t looks_ahead(const pmsm_params *params)
{
    return ((params->polar_options & PMSM_POLAR_PREDICT) != 0u && params->inverter_delay_periods >= 1.0F) ? 1u : 0u;
}

static void integrate(pmsm_period *period, const axis_gains *gains, pmsm_real T_s)
{
    pmsm_dq *integrator = &period->state->polar.integrator;
    integrator->d += gains->d.K_i * T_s * (period->reference.d - period->i.d);
    integrator->q += gains->q.K_i * T_s * (period->reference.q - period->i.q);
}

static void regularised(pmsm_period *period, const polar_plant *p)
{
    pmsm_polar_state *memory = &period->state->polar;
    const axis_gains gains = regularised_gains(period);
    if (looks_ahead(period->params) != 0u) {
        integrate(period, &gains, p->T_s);
    }
    const pmsm_dq base = regularised_base(period, &gains);
    const pmsm_dq v = {base.d + memory->integrator.d, base.q + memory->integrator.q};
    pmsm_polar_map(period, v, (pmsm_real)period->params->polar_eps_ratio * p->V);
}

/* Integrators of law 5: the error, and the voltage that was realised instead of the one the law asked for. */
static void regularised_settle(pmsm_period *period, pmsm_real T_s)
{
    pmsm_polar_state *memory = &period->state->polar;
    const axis_gains gains = regularised_gains(period);
    const pmsm_dq base = regularised_base(period, &gains);
    const pmsm_dq cut = {period->u_realised.d - (base.d + memory->integrator.d),
                         period->u_realised.q - (base.q + memory->integrator.q)};
    const pmsm_real back_d = (gains.d.K_p > PMSM_C(0.0)) ? cut.d / gains.d.K_p : PMSM_C(0.0);
    const pmsm_real back_q = (gains.q.K_p > PMSM_C(0.0)) ? cut.q / gains.q.K_p : PMSM_C(0.0);
    memory->integrator.d += gains.d.K_i * T_s * back_d;
    memory->integrator.q += gains.q.K_i * T_s * back_q;
    if (looks_ahead(period->params) == 0u) {
        integrate(period, &gains, T_s);
    }
}

/* --- selection --------------------------------------------------------------------------------------------------- */

static polar_plant plant_of(const pmsm_period *period, uint32_t mirrored)
{
    const pmsm_params *params = period->params;
    polar_plant p;
    p.R = period->R_s;
    p.L = PMSM_C(0.5) * ((pmsm_real)params->motor_L_d_h + (pmsm_real)params->motor_L_q_h);
    p.psi = (pmsm_real)params->motor_psi_f_wb;
    p.alpha = p.R / p.L;
    p.omega = (mirrored != 0u) ? pmsm_abs(period->omega_e) : period->omega_e;
    p.V = (pmsm_real)params->polar_V_a_max_ratio * period->V_max;
    p.T_s = period->state->derived.T_s;
    return p;
}

static uint32_t is_phase_law(uint32_t mode)
{
    return (mode == PMSM_POLAR_CONVENTIONAL || mode == PMSM_POLAR_PROPOSED) ? 1u : 0u;
}

/* Steady-state voltage of a current, the voltage the model lacks included. */
static pmsm_dq holding_voltage(const pmsm_period *period, pmsm_dq i)
{
    pmsm_dq v = pmsm_model_voltage(period, i);
    v.d += period->state->disturbance.d;
    v.q += period->state->disturbance.q;
    return v;
}

/* With the switch, the phase law takes over when the voltage of law 5 leaves the circle for a reference that cannot be
 * held inside it, and law 5 when the reference can be held again and the current is no longer weakened. Each starts
 * from the voltage that holds the present current. */
static uint32_t use_linear_law(pmsm_period *period, const polar_plant *p)
{
    pmsm_polar_state *memory = &period->state->polar;
    const axis_gains gains = regularised_gains(period);
    const pmsm_dq base = regularised_base(period, &gains);
    pmsm_observe_disturbance(period, pmsm_filter_weight((pmsm_real)period->params->polar_omega_dob_rad_s * p->T_s));
    const uint32_t fits = pmsm_is_within(holding_voltage(period, period->reference), p->V);
    if (memory->linear != 0u) {
        const pmsm_dq v = {base.d + memory->integrator.d, base.q + memory->integrator.q};
        if ((fits | pmsm_is_within(v, p->V)) != 0u) {
            return 1u;
        }
        pmsm_polar_phase_start(period, p, holding_voltage(period, period->i_model));
        memory->linear = 0u;
        return 0u;
    }
    if (fits == 0u || period->i_model.d < period->reference.d) {
        return 0u;
    }
    const pmsm_dq v = holding_voltage(period, period->i_model);
    memory->integrator.d = v.d - base.d;
    memory->integrator.q = v.q - base.q;
    memory->delta = pmsm_arctan(-v.d, v.q);
    memory->linear = 1u;
    return 1u;
}

static void start(pmsm_period *period, const polar_plant *p)
{
    pmsm_polar_state *memory = &period->state->polar;
    const axis_gains gains = regularised_gains(period);
    const pmsm_dq base = regularised_base(period, &gains);
    const pmsm_dq v = pmsm_model_voltage(period, period->i_model);
    const uint32_t mode = period->params->polar_mode;
    memory->started = 1u;
    memory->linear = 1u;
    if (is_phase_law(mode) != 0u) {
        pmsm_polar_phase_start(period, p, v);
    }
    if (mode == PMSM_POLAR_REGULARISED || (period->params->polar_options & PMSM_POLAR_LINEAR_RANGE) != 0u) {
        memory->integrator.d = v.d - base.d;
        memory->integrator.q = v.q - base.q;
        memory->delta = pmsm_arctan(-v.d, v.q);
    }
}

void pmsm_polar_demand(pmsm_period *period)
{
    const uint32_t mode = period->params->polar_mode;
    const polar_plant p = plant_of(period, is_phase_law(mode));
    if (!(p.V > PMSM_C(0.0))) {
        return; /* no link voltage: no phase to speak of */
    }
    if (looks_ahead(period->params) != 0u) {
        pmsm_predict_current(period);
    }
    if (period->state->polar.started == 0u) {
        start(period, &p);
    }
    if (mode == PMSM_POLAR_UNIFIED) {
        pmsm_polar_unified(period, &p);
    } else if (mode == PMSM_POLAR_REGULARISED) {
        regularised(period, &p);
    } else if (is_phase_law(mode) == 0u) {
        linear_range(period, &p);
    } else if ((period->params->polar_options & PMSM_POLAR_LINEAR_RANGE) != 0u && use_linear_law(period, &p) != 0u) {
        regularised(period, &p);
    } else {
        pmsm_polar_phase(period, &p);
    }
    period->V_max = p.V;
}

void pmsm_polar_settle(pmsm_period *period)
{
    const pmsm_params *params = period->params;
    const uint32_t switched = ((params->polar_options & PMSM_POLAR_LINEAR_RANGE) != 0u &&
                               period->state->polar.linear != 0u) ? 1u : 0u;
    if (params->polar_mode == PMSM_POLAR_REGULARISED || (is_phase_law(params->polar_mode) & switched) != 0u) {
        regularised_settle(period, period->state->derived.T_s);
    } else if (params->polar_mode == PMSM_POLAR_UNIFIED) {
        pmsm_polar_unified_settle(period);
    }
}
