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
#include "pmsm_period.h"

#define ROWS_MAX (PMSM_GOVERNOR_ROWS + 2u) /* prediction, steady state, current */
#define POLYGON 8u                         /* faces that stand for the circle in the linearised mode */
#define POLYGON_ROWS 16u
#define POLYGON_INNER PMSM_C(0.92387953251128675613) /* cos(pi/8): the polygon lies inside the circle */
#define LANDING_REST PMSM_C(0.26)          /* deadbeat would be 0; the rest is for an inductance that is off */
#define EMPTY_MARGIN PMSM_C(1.00001)       /* on the square: rounding of a set that is just not empty */
#define PRE_PROJECTION_MARGIN PMSM_C(0.99999)

typedef struct {
    pmsm_row row[ROWS_MAX];
    uint32_t count;
    uint32_t steady;   /* index of the steady-state row; the current row follows it when it is there */
    pmsm_row pre;      /* steady-state row of the pre-projection */
    pmsm_dq offset;    /* V, beside the nominal model in the steady state */
    uint32_t may_start;/* 0: this period has no time left to start a minimum-time transfer, or for more than row 0 */
    uint32_t smallest_known;
    pmsm_dq smallest;  /* A, of the smallest steady-state voltage under row 0 */
} rows_of_period;

static uint32_t has_option(const pmsm_period *period, uint32_t option)
{
    return ((period->params->governor_options & option) != 0u) ? 1u : 0u;
}

static uint32_t is_offset_free(const pmsm_params *params)
{
    const uint32_t mode = params->governor_mode;
    return (mode == PMSM_GOVERNOR_PAPER || mode == PMSM_GOVERNOR_LINEARISED) ? 0u : 1u;
}

/* The line search takes the integrators' word: it is the law for little processing time. */
static uint32_t uses_observer(const pmsm_params *params)
{
    const uint32_t mode = params->governor_mode;
    const uint32_t able = (mode == PMSM_GOVERNOR_BEST || mode == PMSM_GOVERNOR_OBSERVE) ? 1u : 0u;
    return (able != 0u && params->governor_observer_gain > 0.0F) ? 1u : 0u;
}

/* Voltage beside the nominal model that holds in the steady state. */
static pmsm_dq steady_offset(const pmsm_period *period, const pmsm_row *now)
{
    pmsm_dq offset = {PMSM_C(0.0), PMSM_C(0.0)};
    if (is_offset_free(period->params) == 0u) {
        return offset;
    }
    if (uses_observer(period->params) != 0u) {
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
    row->m_dq = -period->omega_e * (pmsm_real)params->motor_L_q_app_h;
    row->m_qd = period->omega_e * (pmsm_real)params->motor_L_d_app_h;
    row->m_qq = period->R_s;
    row->c_d = offset.d;
    row->c_q = offset.q + period->omega_e * (pmsm_real)params->motor_psi_f_wb;
    row->V = (PMSM_C(1.0) - (pmsm_real)params->governor_eps) * period->V_max;
}

/* One axis of the Euler model: current, integrator (V), both from the present state and per ampere of reference. */
typedef struct {
    pmsm_real K_p, K_i_T, T_per_L, R;
    pmsm_real i, x;           /* with reference 0 */
    pmsm_real i_unit, x_unit; /* from rest, reference 1 A */
} axis_model;

static axis_model axis(pmsm_real T_s, pmsm_real R, float L, float K_p, float K_i, pmsm_real i, pmsm_real x)
{
    const axis_model a = {(pmsm_real)K_p, T_s * (pmsm_real)K_i, T_s / (pmsm_real)L, R, i, x, PMSM_C(0.0),
                          PMSM_C(0.0)};
    return a;
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
static void add_prediction_rows(const pmsm_period *period, rows_of_period *rows, uint32_t limit)
{
    const pmsm_params *p = period->params;
    const pmsm_state *state = period->state;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_real omega = period->omega_e;
    const uint32_t last = (p->governor_k_max < limit) ? p->governor_k_max : limit - 1u;
    axis_model d = axis(T_s, period->R_s, p->motor_L_d_h, p->current_K_p_d_v_per_a, p->current_K_i_d_v_per_as,
                        period->i_model.d, state->integrator.d);
    axis_model q = axis(T_s, period->R_s, p->motor_L_q_h, p->current_K_p_q_v_per_a, p->current_K_i_q_v_per_as,
                        period->i_model.q, state->integrator.q);
    const pmsm_real X_d = omega * (pmsm_real)p->motor_L_d_app_h;
    const pmsm_real X_q = omega * (pmsm_real)p->motor_L_q_app_h;
    const pmsm_real emf = omega * (pmsm_real)p->motor_psi_f_wb;
    for (uint32_t j = 1u; j <= last; j++) {
        advance(&d);
        advance(&q);
        pmsm_row *row = &rows->row[rows->count];
        row->m_dd = d.K_p * (PMSM_C(1.0) - d.i_unit) + d.x_unit;
        row->m_dq = -X_q * q.i_unit;
        row->m_qd = X_d * d.i_unit;
        row->m_qq = q.K_p * (PMSM_C(1.0) - q.i_unit) + q.x_unit;
        row->c_d = (d.x - d.K_p * d.i) - X_q * q.i;
        row->c_q = (q.x - q.K_p * q.i) + X_d * d.i + emf;
        row->V = period->V_max;
        rows->count++;
    }
}

static void add_current_row(const pmsm_period *period, rows_of_period *rows)
{
    const pmsm_row row = {PMSM_C(1.0), PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0), PMSM_C(0.0), PMSM_C(0.0),
                          (pmsm_real)period->params->governor_I_transient_apk};
    rows->row[rows->count] = row;
    rows->count++;
}

static void build_rows(pmsm_period *period, rows_of_period *rows)
{
    pmsm_row *now = &rows->row[0];
    pmsm_current_row(period, now);
    if (period->hexagon != 0u) {
        now->V = pmsm_voltage_radius(period, pmsm_voltage_of(now, period->reference));
    }
    rows->count = 1u;
    rows->may_start = 1u;
    rows->smallest_known = 0u;
    if (period->params->governor_mode == PMSM_GOVERNOR_PAPER) {
        add_prediction_rows(period, rows, PMSM_GOVERNOR_ROWS);
    } else if (period->params->governor_mode == PMSM_GOVERNOR_LINEARISED) {
        add_prediction_rows(period, rows, POLYGON_ROWS);
    }
    rows->steady = rows->count;
    rows->offset = steady_offset(period, now);
    set_steady_row(period, rows->offset, &rows->row[rows->count]);
    rows->count++;
    rows->pre = rows->row[rows->steady];
    rows->pre.V *= PRE_PROJECTION_MARGIN;
    if (has_option(period, PMSM_GOVERNOR_CURRENT_ROW) != 0u) {
        add_current_row(period, rows);
    }
}

static uint32_t binding_of(const rows_of_period *rows, uint32_t active)
{
    if (active < rows->steady) {
        return active;
    }
    if (active == PMSM_BINDING_NONE) {
        return PMSM_BINDING_NONE;
    }
    return (active == rows->steady) ? (uint32_t)PMSM_BINDING_STEADY_STATE : (uint32_t)PMSM_BINDING_CURRENT;
}

/* --- solvers: 1 and v, or 0 when the rows have no common point ------------------------------------------------- */

/* Voltage rows first, the current row only on top of their solution, which stands when all cannot be met at once.
 * Returns 1, 0 when the current row had to be given up, PMSM_PROJECTION_EMPTY when the voltage rows have no common
 * point. */
static uint32_t solve_exact(const rows_of_period *rows, pmsm_dq r, pmsm_dq *v, uint32_t *active, uint32_t *steps)
{
    pmsm_active_set set;
    pmsm_projection_begin(&set, rows->row, r);
    if (rows->smallest_known != 0u) {
        set.limit = 0u;
        set.goal = rows->steady;
        set.smallest = rows->smallest;
    }
    if (pmsm_projection_extend(&set, rows->steady + 1u, steps) == PMSM_PROJECTION_EMPTY) {
        return PMSM_PROJECTION_EMPTY;
    }
    *v = set.v;
    *active = set.basis[0];
    if (rows->count > rows->steady + 1u) {
        if (pmsm_projection_extend(&set, rows->count, steps) == PMSM_PROJECTION_EMPTY) {
            return 0u;
        }
        *v = set.v;
        *active = set.basis[0];
    }
    return 1u;
}

/* The circle of each row replaced by an inscribed octagon: [18] of the paper keeps its voltage rows linear. */
static uint32_t solve_linearised(const rows_of_period *rows, uint32_t count, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                                 uint32_t *steps)
{
    static const pmsm_real half = PMSM_C(0.70710678118654752440);
    const pmsm_dq normal[POLYGON] = {{1, 0}, {half, half}, {0, 1}, {-half, half},
                                     {-1, 0}, {-half, -half}, {0, -1}, {half, -half}};
    pmsm_dq a[POLYGON * (POLYGON_ROWS + 2u)];
    pmsm_real b[POLYGON * (POLYGON_ROWS + 2u)];
    for (uint32_t j = 0u; j < count; j++) {
        const pmsm_row *row = &rows->row[j];
        for (uint32_t k = 0u; k < POLYGON; k++) {
            const pmsm_dq n = normal[k];
            a[POLYGON * j + k].d = row->m_dd * n.d + row->m_qd * n.q;
            a[POLYGON * j + k].q = row->m_dq * n.d + row->m_qq * n.q;
            b[POLYGON * j + k] = POLYGON_INNER * row->V - (n.d * row->c_d + n.q * row->c_q);
        }
    }
    const uint32_t status = pmsm_project_half_planes(a, b, POLYGON * count, r, v, active, steps);
    *active = (*active == PMSM_BINDING_NONE) ? *active : *active / POLYGON;
    return (status != PMSM_PROJECTION_EMPTY) ? 1u : 0u;
}

/* Share of the way from p to r that a row allows; the root is clamped, so it can never extrapolate. */
static pmsm_real row_share(const pmsm_row *row, pmsm_dq p, pmsm_dq way, pmsm_real slack)
{
    const pmsm_dq a = pmsm_voltage_of(row, p);
    const pmsm_dq e = {row->m_dd * way.d + row->m_dq * way.q, row->m_qd * way.d + row->m_qq * way.q};
    const pmsm_real aa = pmsm_square(e);
    const pmsm_real bb = a.d * e.d + a.q * e.q;
    const pmsm_real limit = row->V * row->V;
    pmsm_real cc = pmsm_square(a) - limit;
    if (cc > slack * limit) {
        return PMSM_C(-1.0); /* p itself is outside */
    }
    cc = (cc > PMSM_C(0.0)) ? PMSM_C(0.0) : cc;
    const pmsm_real root = PMSM_SQRT(bb * bb - aa * cc);
    if (bb > PMSM_C(0.0)) {
        return -cc / (bb + root);
    }
    return (aa > PMSM_C(0.0)) ? (root - bb) / aa : PMSM_C(1.0);
}

/* A reference whose voltage is that of v in direction, and V in size. */
static pmsm_dq scale_voltage(const pmsm_row *row, pmsm_dq v)
{
    const pmsm_dq w = pmsm_voltage_of(row, v);
    const pmsm_real share = PMSM_C(1.0) - row->V / PMSM_SQRT(pmsm_square(w));
    const pmsm_real inverse = share / (row->m_dd * row->m_qq - row->m_dq * row->m_qd);
    const pmsm_dq x = {v.d - (row->m_qq * w.d - row->m_dq * w.q) * inverse,
                       v.q - (row->m_dd * w.q - row->m_qd * w.d) * inverse};
    return x;
}

/* Line search from the last governed reference. When that one became inadmissible (speed or U_dc moved), its
 * steady-state voltage is scaled down; row 0 is met afterwards in any case. Beyond the current row that row is given
 * up: a reference that stays there does not follow what the voltage can hold, and the current runs away. */
static uint32_t solve_line(const pmsm_period *period, const rows_of_period *rows, pmsm_dq r, pmsm_dq *v,
                           uint32_t *active, uint32_t *steps)
{
    const pmsm_row *steady = &rows->row[rows->steady];
    const pmsm_dq p = period->state->reference_held;
    const pmsm_dq way = {r.d - p.d, r.q - p.q};
    const pmsm_real slack = (pmsm_real)period->params->governor_slack;
    pmsm_real kappa = PMSM_C(1.0);
    for (uint32_t k = 0u; k < rows->count && kappa >= PMSM_C(0.0); k++) {
        const pmsm_real share = row_share(&rows->row[k], p, way, slack);
        if (share < kappa && (k <= rows->steady || share >= PMSM_C(0.0))) {
            kappa = share;
            *active = k;
        }
    }
    (*steps)++;
    if (kappa >= PMSM_C(0.0)) {
        v->d = p.d + kappa * way.d;
        v->q = p.q + kappa * way.q;
        return 1u;
    }
    const uint32_t outside = (pmsm_square(pmsm_voltage_of(steady, p)) > steady->V * steady->V) ? 1u : 0u;
    *v = (outside != 0u) ? scale_voltage(steady, p) : p;
    return 1u;
}

/* Where not all rows can be met the current row is given up; where row 0 and the steady state exclude each other, the
 * smallest steady-state voltage that row 0 allows is taken. Row 0 always can be met, so the inverter's limit holds in
 * any case. */
static pmsm_dq solve(pmsm_period *period, const rows_of_period *rows, pmsm_dq r, uint32_t *binding, uint32_t *steps)
{
    const uint32_t mode = period->params->governor_mode;
    uint32_t active = PMSM_BINDING_NONE;
    uint32_t found = 0u;
    pmsm_dq v = r;
    if (mode == PMSM_GOVERNOR_LINE) {
        found = solve_line(period, rows, r, &v, &active, steps);
    } else if (mode == PMSM_GOVERNOR_LINEARISED) {
        found = solve_linearised(rows, rows->count, r, &v, &active, steps);
        period->flags |= (found == 0u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    }
    if (found == 0u) {
        active = PMSM_BINDING_NONE;
        found = solve_exact(rows, r, &v, &active, steps);
    }
    period->flags |= (found != 1u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    if (found == PMSM_PROJECTION_EMPTY) {
        *binding = PMSM_BINDING_EMPTY;
        return pmsm_smallest_voltage(&rows->row[rows->steady], &rows->row[0], steps);
    }
    *binding = binding_of(rows, active);
    return v;
}

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
static void observe(pmsm_period *period, const rows_of_period *rows)
{
    pmsm_live *live = &period->state->live;
    uint32_t active = PMSM_BINDING_NONE;
    uint32_t steps = 0u;
    pmsm_dq v = period->reference;
    const uint32_t found = solve_exact(rows, period->reference, &v, &active, &steps);
    live->kappa = share_of_way(period->state->reference_held, period->reference, v);
    live->binding = (found == 1u) ? binding_of(rows, active) : (uint32_t)PMSM_BINDING_EMPTY;
    live->iterations += steps;
}

/* Whatever tolerance a solver left, and whatever direction the voltage took in the hexagon (row 0 knows the radius in
 * the direction of the request only): the demanded voltage ends inside its limit. */
static pmsm_dq meet_row_zero(const pmsm_period *period, const pmsm_row *now, pmsm_dq v)
{
    const pmsm_dq w = pmsm_voltage_of(now, v);
    const pmsm_real square = pmsm_square(w);
    const pmsm_real V = pmsm_voltage_radius(period, w);
    if (square <= V * V) {
        return v;
    }
    const pmsm_real share = PMSM_C(1.0) - V / PMSM_SQRT(square);
    v.d -= share * w.d / now->m_dd;
    v.q -= share * w.q / now->m_qq;
    return v;
}

/* One sample of a faster approach at the end of a transfer: what is left of the error after it is LANDING_REST. */
static pmsm_real land(pmsm_real i, pmsm_real r, pmsm_real L, pmsm_real K_p, pmsm_real T_s)
{
    const pmsm_real gain = (PMSM_C(1.0) - LANDING_REST) * L / (K_p * T_s);
    return (gain > PMSM_C(1.0)) ? i + gain * (r - i) : r;
}

/* An admissible request passes, but for the landing of a minimum-time transfer. */
static pmsm_dq pass(pmsm_period *period, const rows_of_period *rows, pmsm_dq r, uint32_t *binding)
{
    pmsm_state *state = period->state;
    const pmsm_params *p = period->params;
    const uint32_t landing = state->landing;
    state->landing = 0u;
    state->time_to_go = PMSM_C(0.0);
    if (landing == 0u) {
        return r;
    }
    const pmsm_dq v = {land(period->i_model.d, r.d, (pmsm_real)p->motor_L_d_h, rows->row[0].m_dd, state->derived.T_s),
                       land(period->i_model.q, r.q, (pmsm_real)p->motor_L_q_h, rows->row[0].m_qq, state->derived.T_s)};
    *binding = PMSM_BINDING_MINIMUM_TIME;
    return v;
}

/* The line search says itself what is admissible, and the octagon is inside the circle. */
static uint32_t asks_first(const pmsm_params *params)
{
    return (params->governor_mode == PMSM_GOVERNOR_PAPER || params->governor_mode == PMSM_GOVERNOR_BEST) ? 1u : 0u;
}

/* An inadmissible request: along the minimum-time direction where that is asked for and possible, else what the solver
 * of the mode finds. Whether row 0 and the steady state can be met at once is settled first: an empty set changes what
 * the direction may do to the current, and the smallest steady-state voltage is then the answer. So it is where the
 * direction is barred by the current limit and the voltage cannot hold the present current; where it can, row 0. */
static pmsm_dq restrain(pmsm_period *period, rows_of_period *rows, pmsm_dq r, uint32_t *binding, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_row *steady = &rows->row[rows->steady];
    if (has_option(period, PMSM_GOVERNOR_MINIMUM_TIME) == 0u || asks_first(period->params) == 0u) {
        return solve(period, rows, r, binding, steps);
    }
    pmsm_dq v = pmsm_smallest_voltage(steady, &rows->row[0], steps);
    const uint32_t empty = (pmsm_square(pmsm_voltage_of(steady, v)) > EMPTY_MARGIN * steady->V * steady->V) ? 1u : 0u;
    rows->smallest_known = 1u;
    rows->smallest = v;
    *binding = PMSM_BINDING_EMPTY;
    period->flags |= (empty != 0u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    const enum pmsm_transfer transfer = pmsm_minimum_time(period, &rows->row[0], rows->offset, r, rows->may_start, &v);
    if (transfer == PMSM_TRANSFER_FOUND) {
        state->landing = 1u;
        *binding = PMSM_BINDING_MINIMUM_TIME;
        return v;
    }
    const uint32_t barred = (transfer == PMSM_TRANSFER_BARRED) ? 1u : 0u;
    const pmsm_real hold = pmsm_square(pmsm_voltage_of(steady, period->i_model));
    if (empty != 0u || (barred != 0u && hold > period->V_max * period->V_max)) {
        return v; /* out of the reach of the voltage: back into it first */
    }
    if (barred != 0u || transfer == PMSM_TRANSFER_SOUGHT || rows->may_start == 0u) { /* little time: row 0 only */
        *binding = 0u;
        return pmsm_project_row(&rows->row[0], r, steps);
    }
    return solve(period, rows, r, binding, steps);
}

static uint32_t is_admissible(const rows_of_period *rows, pmsm_dq r)
{
    for (uint32_t k = 0u; k < rows->count; k++) {
        if (pmsm_square(pmsm_voltage_of(&rows->row[k], r)) > rows->row[k].V * rows->row[k].V) {
            return 0u;
        }
    }
    return 1u;
}

/* The reachable request: inside the steady-state row, and inside the current row where both can be met. The second is
 * costly, so unless a transfer is under way it is done in every other period, and what it was done for stands
 * meanwhile; the period between is for the rows, or to start a transfer. */
static pmsm_dq pre_project(pmsm_period *period, rows_of_period *rows, pmsm_dq r, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_row *last = &rows->row[rows->count - 1u];
    const uint32_t fresh = state->reachable_age;
    pmsm_dq v = pmsm_project_row(&rows->pre, r, steps);
    state->reachable_age = 0u;
    if (rows->count <= rows->steady + 1u || pmsm_square(v) <= last->V * last->V) {
        return v;
    }
    if (fresh != 0u && state->time_to_go <= PMSM_C(0.0)) {
        return state->reachable;
    }
    const pmsm_row both[2] = {rows->pre, *last};
    uint32_t active;
    (void)pmsm_project_rows(both, 2u, r, &v, &active, steps); /* v stays where there is no common point */
    rows->may_start = 0u;
    state->reachable = v;
    state->reachable_age = 1u;
    return v;
}

static void choose(pmsm_period *period, rows_of_period *rows)
{
    pmsm_live *live = &period->state->live;
    const pmsm_dq request = period->reference;
    uint32_t binding = PMSM_BINDING_NONE;
    uint32_t steps = 0u;
    pmsm_dq r = request;
    if (has_option(period, PMSM_GOVERNOR_PRE_PROJECTION) != 0u) {
        r = pre_project(period, rows, request, &steps);
    }
    pmsm_dq v = (asks_first(period->params) != 0u && is_admissible(rows, r) != 0u)
                    ? pass(period, rows, r, &binding)
                    : restrain(period, rows, r, &binding, &steps);
    v = meet_row_zero(period, &rows->row[0], v);
    if (v.d != request.d || v.q != request.q) {
        period->flags |= (uint32_t)PMSM_FLAG_GOVERNOR_ACTIVE;
        binding = (binding == PMSM_BINDING_NONE) ? (uint32_t)PMSM_BINDING_PRE_PROJECTION : binding;
    }
    live->kappa = share_of_way(period->state->reference_held, request, v);
    live->binding = binding;
    live->iterations += steps;
    period->reference = v;
}

void pmsm_govern(pmsm_period *period)
{
    const pmsm_params *params = period->params;
    if (params->current_K_p_d_v_per_a <= 0.0F || params->current_K_p_q_v_per_a <= 0.0F || period->V_max <= 0 ||
        period->request->bias_bandwidth > PMSM_C(0.0)) {
        return; /* the reference does not act on the voltage at once, or by other gains than the rows' */
    }
    if (uses_observer(params) != 0u) {
        pmsm_observe_disturbance(period, (pmsm_real)params->governor_observer_gain);
    }
    rows_of_period rows;
    build_rows(period, &rows);
    if (params->governor_mode == PMSM_GOVERNOR_OBSERVE) {
        observe(period, &rows);
    } else {
        choose(period, &rows);
    }
}
