/* SPDX-License-Identifier: MIT */
/* Reference governor (Jercic, Iles, Zarko, Matusko, Automatika 58:4 (2017) 439-449, DOI 10.1080/00051144.2018.1453441).
 *
 * The governed reference v is the nearest to the request r for which the demanded voltage stays inside its limit, now
 * and later if v is held. Later voltages are rows |M_j v + c_j| <= V_j:
 *   paper rows: Euler prediction (19)-(27), rows 0..k_max, and a tightened steady-state row;
 *   offset-free rows: row 0 (the true output of the controller) and the steady state with the voltage that the
 *   integrators or the disturbance observer hold. With pole-zero cancellation the voltage moves on a straight segment
 *   between the two, so they are the whole admissible set.
 * Row 0 goes before the steady-state row, that before the current row, when not all can be met.
 */
#include "active_set.h"
#include "governor.h"

#define LANDING_REST PMSM_C(0.26)          /* deadbeat would be 0; the rest is for an inductance that is off */
#define LANDING_PERIODS PMSM_C(6.0)        /* before the end: farther off the error is not the way */
#define INSIDE PMSM_C(0.9999995)           /* of the limit: rounding leaves the modulator nothing to cut */
#define PRE_PROJECTION_MARGIN PMSM_C(0.99999)
#define APPROACH_STEPS 2u                  /* of a row in a period */
#define APPROACH_TRIES 6u                  /* periods for a corner, then the search begins again */
#define CORNER_FOUND 255u
#define EMPTY_MARGIN PMSM_C(1.00001)       /* on the square: rounding of a set that is just not empty */

static pmsm_real share_of_way(pmsm_dq p, pmsm_dq r, pmsm_dq v)
{
    if (v.d == r.d && v.q == r.q) {
        return PMSM_C(1.0);
    }
    const pmsm_dq way = {r.d - p.d, r.q - p.q};
    const pmsm_real square = pmsm_square(way);
    const pmsm_real along = (v.d - p.d) * way.d + (v.q - p.q) * way.q;
    return (square > PMSM_C(0.0)) ? pmsm_clamp(along / square, PMSM_C(0.0), PMSM_C(1.0)) : PMSM_C(0.0);
}

/* Mode observe: what the rows would have said; the reference passes. */
static void observe(pmsm_period *period, const pmsm_governor_rows *rows)
{
    pmsm_live *live = &period->state->live;
    uint32_t active = PMSM_BINDING_NONE;
    uint32_t steps = 0u;
    pmsm_dq v = period->reference;
    const uint32_t found = pmsm_governor_project(rows, period->reference, &v, &active, &steps);
    live->kappa = share_of_way(period->state->reference_held, period->reference, v);
    live->binding = (found == 1u) ? pmsm_governor_binding(rows, active) : (uint32_t)PMSM_BINDING_EMPTY;
    live->iterations += steps;
}

/* Whatever tolerance a solver left, and whatever direction the voltage took in the hexagon (row 0 knows the radius in
 * the direction of the request only): the demanded voltage ends inside its limit. */
static pmsm_dq meet_row_zero(pmsm_period *period, const pmsm_row *now, pmsm_dq v)
{
    const pmsm_dq w = pmsm_voltage_of(now, v);
    const pmsm_real square = pmsm_square(w);
    const pmsm_real V = pmsm_voltage_radius(period, w);
    period->u = w;
    if (square <= V * V) {
        return v;
    }
    const pmsm_real share = PMSM_C(1.0) - INSIDE * V / PMSM_SQRT(square);
    const pmsm_dq over = {share * w.d, share * w.q};
    period->u.d -= over.d;
    period->u.q -= over.q;
    v.d -= over.d / now->m_dd;
    v.q -= over.q / now->m_qq;
    return v;
}

/* One sample of a faster approach at the end of a transfer: what is left of the error after it is LANDING_REST. */
static pmsm_real land(pmsm_real i, pmsm_real r, pmsm_real L, pmsm_real K_p, pmsm_real T_s)
{
    const pmsm_real gain = (PMSM_C(1.0) - LANDING_REST) * L / (K_p * T_s);
    return (gain > PMSM_C(1.0)) ? i + gain * (r - i) : r;
}

/* An admissible request passes, but for the landing of a minimum-time transfer: that goes by the model alone. Far
 * from the end one that the voltage cannot make is none: cut, it goes along the error of now instead of along the way,
 * out of where the request is admissible, and the transfer would begin again. */
static pmsm_dq pass(pmsm_period *period, const pmsm_governor_rows *rows, uint32_t off_model, pmsm_dq r,
                    uint32_t *binding)
{
    pmsm_state *state = period->state;
    const uint32_t landing = state->landing;
    const pmsm_real left = state->time_to_go;
    state->landing = 0u;
    state->time_to_go = PMSM_C(0.0);
    if (landing == 0u || off_model != 0u) {
        return r;
    }
    const pmsm_dq v = {land(period->i_model.d, r.d, period->magnetics->L_d, rows->row[0].m_dd, state->derived.T_s),
                       land(period->i_model.q, r.q, period->magnetics->L_q, rows->row[0].m_qq, state->derived.T_s)};
    if (left > LANDING_PERIODS * state->derived.T_s &&
        pmsm_square(pmsm_voltage_of(&rows->row[0], v)) > rows->row[0].V * rows->row[0].V) {
        return r;
    }
    *binding = PMSM_BINDING_MINIMUM_TIME;
    return v;
}

/* The line search says itself what is admissible, and the octagon is inside the circle. */
static uint32_t asks_first(const pmsm_params *params)
{
    return (params->governor_mode == PMSM_GOVERNOR_PAPER || params->governor_mode == PMSM_GOVERNOR_BEST) ? 1u : 0u;
}

/* The current controllers act on the sampled current, their voltage a period later. */
static uint32_t acts_late(const pmsm_period *period)
{
    return (period->params->inverter_delay_periods >= 1.0F && period->state->derived.predicts == 0u) ? 1u : 0u;
}

/* A voltage that acts late meets another current than the sampled one: the transfer starts from the predicted one. */
static enum pmsm_transfer steer(pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq *v,
                                uint32_t *steps)
{
    const pmsm_dq seen = period->i_model;
    pmsm_dq from = pmsm_flux_here(period->magnetics, seen);
    if (acts_late(period) != 0u) {
        pmsm_predict_current(period);
        from = period->flux_model;
    }
    const enum pmsm_transfer found =
        pmsm_minimum_time(period, &rows->row[0], rows->offset, from, r, rows->may_start, v, steps);
    period->i_model = seen;
    return found;
}

/* An inadmissible request: along the minimum-time direction where that is asked for and possible, else what the solver
 * of the mode finds. Where there is no time for that, row 0 alone, unless it and the steady state cannot be met at once:
 * the smallest steady-state voltage is then the answer. So it is where the direction is barred by the current limit and
 * the voltage cannot hold the present current. */
static pmsm_dq restrain(pmsm_period *period, pmsm_governor_rows *rows, pmsm_dq r, uint32_t *binding, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_row *steady = &rows->row[rows->steady];
    pmsm_dq v = r;
    if (pmsm_has_option(period, PMSM_GOVERNOR_MINIMUM_TIME) == 0u || asks_first(period->params) == 0u) {
        return pmsm_governor_solve(period, rows, r, binding, steps);
    }
    if (period->looked > PMSM_LUT_NODES) { /* a transfer under way waits */
        *binding = 0u;
        return pmsm_governor_slide(rows, r, pmsm_project_row(&rows->row[0], r, steps), steps);
    }
    const uint32_t costly = (rows->may_start == 0u && period->looked > 0u) ? 1u : 0u; /* look-up and corner */
    const uint32_t busy = (period->steps > 0u || costly != 0u) ? 1u : 0u;
    const enum pmsm_transfer transfer = steer(period, rows, r, &v, steps);
    if (transfer == PMSM_TRANSFER_FOUND) {
        state->landing = (acts_late(period) == 0u) ? 1u : 0u; /* what is on its way would be asked for again */
        *binding = PMSM_BINDING_MINIMUM_TIME;
        return v;
    }
    if (busy == 0u && transfer == PMSM_TRANSFER_NONE && rows->may_start != 0u) {
        return pmsm_governor_solve(period, rows, r, binding, steps);
    }
    if (busy == 0u) {
        const pmsm_real hold = pmsm_square(pmsm_voltage_of(steady, period->i_model));
        v = pmsm_smallest_voltage(steady, &rows->row[0], steps);
        const uint32_t empty =
            (pmsm_square(pmsm_voltage_of(steady, v)) > EMPTY_MARGIN * steady->V * steady->V) ? 1u : 0u;
        period->flags |= (empty != 0u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
        if (empty != 0u || (transfer == PMSM_TRANSFER_BARRED && hold > period->V_max * period->V_max)) {
            *binding = PMSM_BINDING_EMPTY; /* out of the reach of the voltage: back into it first */
            return v;
        }
    }
    *binding = 0u;
    v = pmsm_project_row(&rows->row[0], r, steps);
    return (costly != 0u) ? v : pmsm_governor_slide(rows, r, v, steps);
}

/* v is the point of a row nearest to r, and outside the circle: the nearest point to r inside both, if there is one. */
static void meet_both(const pmsm_row *row, const pmsm_row *circle, pmsm_dq r, pmsm_dq *v, uint32_t *steps)
{
    const pmsm_real square = pmsm_square(r);
    const uint32_t inside = (square <= circle->V * circle->V) ? 1u : 0u;
    pmsm_dq outside = *v;
    if (inside == 0u) {
        const pmsm_real share = circle->V / PMSM_SQRT(square);
        outside.d = share * r.d;
        outside.q = share * r.q;
        if (pmsm_is_within(pmsm_voltage_of(row, outside), row->V) != 0u) {
            *v = outside;
            return;
        }
    }
    const pmsm_row *first = (inside != 0u) ? row : circle;
    const pmsm_row *second = (inside != 0u) ? circle : row;
    const pmsm_dq best = pmsm_smallest_voltage(second, first, steps);
    pmsm_dq corner;
    if (pmsm_project_pair(first, second, r, outside, best, &corner, steps) != 0u) {
        *v = corner;
    }
}

/* The reachable request: inside the steady-state row, and inside the current row where both can be met. The second is
 * costly, so unless a transfer is under way it is done in every other period, and what it was done for stands
 * meanwhile; the period between is for the rows, or to start a transfer. Nor is it done beside a step of the field
 * weakening, whose currents are within both rows but for what its margin does not cover. */
static pmsm_dq pre_project(pmsm_period *period, pmsm_governor_rows *rows, pmsm_dq r, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_row *last = &rows->row[rows->count - 1u];
    const uint32_t fresh = state->reachable_age;
    pmsm_row pre = rows->row[rows->steady];
    pre.V *= PRE_PROJECTION_MARGIN;
    pmsm_dq v = pmsm_project_row(&pre, r, steps);
    state->reachable_age = 0u;
    rows->reachable = 1u;
    if (rows->count <= rows->steady + 1u || pmsm_is_within(v, last->V) != 0u) {
        return v;
    }
    if (fresh != 0u && state->time_to_go <= PMSM_C(0.0)) {
        return state->reachable;
    }
    rows->may_start = 0u; /* and row 0 alone */
    if (period->steps > 0u) {
        return v;
    }
    meet_both(&pre, last, r, &v, steps);
    state->reachable = v;
    state->reachable_age = 1u;
    return v;
}

/* The same for little time: two steps of Newton's method in a period, which go on where the last period's ended.
 * Outside the current row they are for the row alone and for the corner of both in turn. Until that is found the
 * request stays on the row alone; the line search keeps it inside the current row. */
static pmsm_dq approach(pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_row *last = &rows->row[rows->count - 1u];
    pmsm_row pre = rows->row[rows->steady];
    pre.V *= PRE_PROJECTION_MARGIN;
    if (state->reachable_age != 0u) {
        state->reachable_age = 0u;
        const uint32_t found = pmsm_find_corner(last, &pre, r, 1u, &state->corner, steps);
        const uint32_t tries = (state->cornered < APPROACH_TRIES) ? state->cornered + 1u : 0u;
        state->cornered = (found != 0u) ? CORNER_FOUND : tries;
        return (found != 0u) ? state->corner : state->reachable;
    }
    const pmsm_dq v = pmsm_project_row_from(&pre, r, &state->reachable_multiplier, APPROACH_STEPS, steps);
    const pmsm_real square = pmsm_square(v);
    if (rows->count <= rows->steady + 1u || square <= last->V * last->V) {
        state->cornered = 0u;
        return v;
    }
    if (state->cornered == 0u) { /* on the circle, which is just outside the ellipse */
        const pmsm_real share = last->V / PMSM_SQRT(square);
        state->corner.d = share * v.d;
        state->corner.q = share * v.q;
    }
    state->reachable = v;
    state->reachable_age = 1u;
    return (state->cornered == CORNER_FOUND) ? state->corner : v;
}

static void choose(pmsm_period *period, pmsm_governor_rows *rows, uint32_t off_model)
{
    pmsm_live *live = &period->state->live;
    const pmsm_dq request = period->reference;
    uint32_t binding = PMSM_BINDING_NONE;
    uint32_t steps = period->steps;
    pmsm_dq r = request;
    if (pmsm_has_option(period, PMSM_GOVERNOR_PRE_PROJECTION) != 0u) {
        r = (period->params->governor_mode == PMSM_GOVERNOR_LINE) ? approach(period, rows, request, &steps)
                                                                  : pre_project(period, rows, request, &steps);
    }
    pmsm_dq v;
    if (asks_first(period->params) != 0u && pmsm_governor_admits(period, rows, r) != 0u) {
        v = pass(period, rows, off_model, r, &binding);
    } else {
        if (rows->built < rows->steady) {
            pmsm_governor_complete(period, rows);
        }
        v = restrain(period, rows, r, &binding, &steps);
    }
    v = meet_row_zero(period, &rows->row[0], v);
    period->flags |= (steps >= PMSM_PROJECTION_STEPS) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    if (v.d != request.d || v.q != request.q) {
        period->flags |= (uint32_t)PMSM_FLAG_GOVERNOR_ACTIVE;
        binding = (binding == PMSM_BINDING_NONE) ? (uint32_t)PMSM_BINDING_PRE_PROJECTION : binding;
    }
    live->kappa = share_of_way(period->state->reference_held, request, v);
    live->binding = binding;
    live->iterations += steps - period->steps;
    period->reference = v;
}

uint32_t pmsm_govern(pmsm_period *period)
{
    const pmsm_params *params = period->params;
    if (params->current_K_p_d_v_per_a <= 0.0F || params->current_K_p_q_v_per_a <= 0.0F || period->V_max <= 0 ||
        period->request->bias_bandwidth > PMSM_C(0.0)) {
        return 0u; /* the reference does not act on the voltage at once, or by other gains than the rows' */
    }
    const uint32_t off_model = (pmsm_governor_observes(params) != 0u) ? pmsm_governor_observe(period) : 0u;
    pmsm_governor_rows rows;
    pmsm_governor_build(period, &rows);
    if (params->governor_mode == PMSM_GOVERNOR_OBSERVE) {
        observe(period, &rows);
        return 0u;
    }
    choose(period, &rows, off_model);
    return 1u;
}
