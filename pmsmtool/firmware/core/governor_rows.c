/* SPDX-License-Identifier: MIT */
/* The governor's rows |M_j v + c_j| <= V_j: voltage now, predicted, in the steady state; current. */
#include "governor.h"

static uint32_t is_offset_free(const pmsm_params *params)
{
    const uint32_t mode = params->governor_mode;
    return (mode == PMSM_GOVERNOR_PAPER || mode == PMSM_GOVERNOR_LINEARISED) ? 0u : 1u;
}

/* Voltage beside the nominal model that holds in the steady state. */
static pmsm_dq steady_offset(const pmsm_period *period, const pmsm_row *now)
{
    pmsm_dq offset = {PMSM_C(0.0), PMSM_C(0.0)};
    if (is_offset_free(period->params) == 0u) {
        return offset;
    }
    if (pmsm_governor_observes(period->params) != 0u) {
        return period->state->disturbance;
    }
    /* the demand that would keep the current where it is, minus the model's: the integrators' share */
    const pmsm_dq hold = pmsm_voltage_of(now, period->i_model);
    const pmsm_dq model = pmsm_model_voltage(period, period->i_model);
    offset.d = hold.d - model.d;
    offset.q = hold.q - model.q;
    return offset;
}

static void set_steady_row(const pmsm_period *period, pmsm_dq offset, pmsm_row *row)
{
    const pmsm_params *params = period->params;
    row->m_dd = period->R_s;
    row->m_dq = -period->omega_e * period->magnetics->L_q_app;
    row->m_qd = period->omega_e * period->magnetics->L_d_app;
    row->m_qq = period->R_s;
    row->c_d = offset.d;
    row->c_q = offset.q + period->omega_e * period->magnetics->psi_f;
    row->V = (PMSM_C(1.0) - (pmsm_real)params->governor_eps) * period->V_max;
}

/* One axis of the Euler model: current, integrator (V), both from the present state and per ampere of reference. */
typedef struct {
    pmsm_real K_p, K_i_T, T_per_L, R;
    pmsm_real i, x;           /* with reference 0 */
    pmsm_real i_unit, x_unit; /* from rest, reference 1 A */
} axis_model;

typedef struct {
    axis_model d, q;
    pmsm_real X_d, X_q, emf; /* ohm, ohm, V */
} prediction;

static axis_model axis(pmsm_real T_s, pmsm_real R, pmsm_real L, pmsm_real K_p, float K_i, pmsm_real i, pmsm_real x)
{
    const axis_model a = {K_p, T_s * (pmsm_real)K_i, T_s / L, R, i, x, PMSM_C(0.0), PMSM_C(0.0)};
    return a;
}

static prediction begin_prediction(const pmsm_period *period)
{
    const pmsm_params *p = period->params;
    const pmsm_state *state = period->state;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_magnetics *m = period->magnetics;
    const prediction s = {
        axis(T_s, period->R_s, m->L_d, m->K_p.d, p->current_K_i_d_v_per_as, period->i_model.d, state->integrator.d),
        axis(T_s, period->R_s, m->L_q, m->K_p.q, p->current_K_i_q_v_per_as, period->i_model.q, state->integrator.q),
        period->omega_e * m->L_d_app,
        period->omega_e * m->L_q_app,
        period->omega_e * m->psi_f};
    return s;
}

static void advance(axis_model *a)
{
    const pmsm_real u = a->x - a->K_p * a->i;
    const pmsm_real u_unit = a->K_p * (PMSM_C(1.0) - a->i_unit) + a->x_unit;
    a->x -= a->K_i_T * a->i;
    a->i += a->T_per_L * (u - a->R * a->i);
    a->x_unit += a->K_i_T * (PMSM_C(1.0) - a->i_unit);
    a->i_unit += a->T_per_L * (u_unit - a->R * a->i_unit);
}

/* Rows 1..k_max of (31). */
void pmsm_governor_complete(const pmsm_period *period, pmsm_governor_rows *rows)
{
    prediction s = begin_prediction(period);
    axis_model *d = &s.d;
    axis_model *q = &s.q;
    for (; rows->built < rows->steady; rows->built++) {
        advance(d);
        advance(q);
        pmsm_row *row = &rows->row[rows->built];
        row->m_dd = d->K_p * (PMSM_C(1.0) - d->i_unit) + d->x_unit;
        row->m_dq = -s.X_q * q->i_unit;
        row->m_qd = s.X_d * d->i_unit;
        row->m_qq = q->K_p * (PMSM_C(1.0) - q->i_unit) + q->x_unit;
        row->c_d = (d->x - d->K_p * d->i) - s.X_q * q->i;
        row->c_q = (q->x - q->K_p * q->i) + s.X_d * d->i + s.emf;
        row->V = period->V_max;
    }
}

/* One axis under a reference that is held; u is the demand at the present current. */
static pmsm_real follow(axis_model *a, pmsm_real r, pmsm_real u)
{
    const pmsm_real x = a->x + a->K_i_T * (r - a->i);
    a->i += a->T_per_L * (u - a->R * a->i);
    a->x = x;
    return a->K_p * (r - a->i) + x;
}

/* Rows 1..k_max for one request only: the demand along its own trajectory, at a third of what the rows cost. */
static uint32_t prediction_admits(const pmsm_period *period, uint32_t last, pmsm_dq r)
{
    prediction s = begin_prediction(period);
    const pmsm_real limit = period->V_max * period->V_max;
    pmsm_dq u = {s.d.K_p * (r.d - s.d.i) + s.d.x, s.q.K_p * (r.q - s.q.i) + s.q.x};
    for (uint32_t j = 1u; j <= last; j++) {
        u.d = follow(&s.d, r.d, u.d);
        u.q = follow(&s.q, r.q, u.q);
        const pmsm_dq w = {u.d - s.X_q * s.q.i, u.q + (s.X_d * s.d.i + s.emf)};
        if (pmsm_square(w) > limit) {
            return 0u;
        }
    }
    return 1u;
}

static uint32_t prediction_rows(const pmsm_params *params)
{
    const uint32_t mode = params->governor_mode;
    const uint32_t limit = (mode == PMSM_GOVERNOR_PAPER) ? PMSM_GOVERNOR_ROWS : PMSM_POLYGON_ROWS;
    if (is_offset_free(params) != 0u) {
        return 0u;
    }
    return (params->governor_k_max < limit) ? params->governor_k_max : limit - 1u;
}

void pmsm_governor_build(pmsm_period *period, pmsm_governor_rows *rows)
{
    pmsm_row *now = &rows->row[0];
    pmsm_current_row(period, now);
    if (period->state->derived.hexagon != 0u) {
        now->V = pmsm_voltage_radius(period, pmsm_voltage_of(now, period->reference));
    }
    rows->may_start = 1u;
    rows->reachable = 0u;
    rows->built = 1u;
    rows->steady = 1u + prediction_rows(period->params);
    rows->offset = steady_offset(period, now);
    set_steady_row(period, rows->offset, &rows->row[rows->steady]);
    rows->count = rows->steady + 1u;
    if (pmsm_has_option(period, PMSM_GOVERNOR_CURRENT_ROW) != 0u) {
        const pmsm_row row = {PMSM_C(1.0), PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0), PMSM_C(0.0), PMSM_C(0.0),
                              (pmsm_real)period->params->governor_I_transient_apk};
        rows->row[rows->count] = row;
        rows->count++;
    }
}

uint32_t pmsm_governor_admits(const pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r)
{
    if (pmsm_is_within(pmsm_voltage_of(&rows->row[0], r), rows->row[0].V) == 0u) {
        return 0u;
    }
    for (uint32_t k = rows->steady; k < rows->count; k++) {
        if (pmsm_is_within(pmsm_voltage_of(&rows->row[k], r), rows->row[k].V) == 0u) {
            return 0u;
        }
    }
    return (rows->steady > 1u) ? prediction_admits(period, rows->steady - 1u, r) : 1u;
}
