/* SPDX-License-Identifier: MIT */
/* Field weakening as an optimisation, Jercic et al. 2017, section 4:
 *
 *   minimise h1 (T* - T(x))^2 + h2 (i_d - i_dLM)^2   subject to |v(x)| <= V_m, |x| <= I_m               (43), (44)
 *
 * The voltage row uses what the integrators hold, v = (K_i I_ed - w L_q i_q, K_i I_eq + w (psi + L_d i_d)) (42), so
 * errors of R_s, L and psi do not matter in the steady state; the uncompensated variant takes the nominal ellipse (33).
 * Solved by projected gradient steps with Armijo's rule (45)-(48), or by FISTA with restart. One call per N_fw periods;
 * an accelerated call that has used up its time goes on in the next period from where it is. The accelerated variant
 * also puts R_s into the row: (41) takes R_s i for constant from call to call, which lets i_q swing where the ellipse
 * is flat.
 * The search is kept to i_d <= max(0, i_dLM), where the cost is well behaved for salient machines, and to
 * i_d >= i_d_min.
 */
#include "active_set.h"
#include "pmsm_period.h"

#define STEPS_MOST 14u               /* Newton steps that an accelerated call may take in a period, */
#define STEPS_FALLING 12u            /* while the link falls: the governor needs the others; */
#define STEPS_LEFT 3u                /* with as many left it goes on in the next period */
#define FALLING PMSM_C(0.99)         /* of the link's voltage, where it is going to be */
#define CORNER_STEPS 4u              /* of Newton's method for the corner, from near it */
#define CORNER_NONE 0u
#define CORNER_KNOWN 1u
#define CORNER_DOUBTED 2u            /* none was found: the two rows may have no common point */
#define ITERATION_STEPS 3u           /* an iteration without its projection takes as long as so many of them */
#define STEP_END PMSM_C(2e-5)        /* A: a smaller change ends the iteration */
#define HALVINGS 8u                  /* of an Armijo step */
#define TORQUE_EVENT PMSM_C(0.02)    /* of rated torque: a larger change of the request is answered at once */
#define LINK_EVENT PMSM_C(0.02)      /* of the link's voltage, likewise */
#define WITHIN PMSM_C(1.000002)       /* on the square: rounding of a point on a row's boundary */
#define IGNORED_SHARE PMSM_C(1e-3)   /* below this share of V_m the rotation voltage of I_m does not matter */

typedef struct {
    pmsm_row row[2];       /* current circle, voltage ellipse */
    uint32_t rows;
    pmsm_real d_min, d_max;
    pmsm_real h1, h2, i_d_lm, tau;
    pmsm_real k_t, k_s;    /* T = (k_t + k_s i_d) i_q */
    uint32_t empty;        /* 1: no current satisfied both rows at the last projection */
    uint32_t steps;        /* Newton steps so far, of those that a period may take */
    pmsm_real multiplier;  /* of the voltage row in the last projection: the next one is near */
    uint32_t corner_state; /* of that projection, whether it was on both rows */
    pmsm_dq corner;
    uint32_t accelerated;
    uint32_t left;         /* iterations that an accelerated call still may take */
} problem;

static pmsm_row voltage_row(const pmsm_period *period)
{
    const pmsm_params *p = period->params;
    const pmsm_real omega = period->omega_e;
    const pmsm_real R = (p->field_weakening_mode == PMSM_FW_ACCELERATED) ? period->R_s : PMSM_C(0.0);
    pmsm_row row = {R, -omega * period->magnetics->L_q_app, omega * period->magnetics->L_d_app, R,
                    PMSM_C(0.0), omega * period->magnetics->psi_f,
                    (PMSM_C(1.0) - (pmsm_real)p->field_weakening_margin) *
                        ((pmsm_real)p->inverter_voltage_utilisation * period->U_ahead)};
    if (p->field_weakening_mode != PMSM_FW_UNCOMPENSATED) { /* through the voltage that holds the present current */
        const pmsm_dq hold = pmsm_hold_voltage(period, period->i);
        row.c_d = hold.d - (row.m_dd * period->i.d + row.m_dq * period->i.q);
        row.c_q = hold.q - (row.m_qd * period->i.d + row.m_qq * period->i.q);
    }
    return row;
}

static problem state_problem(const pmsm_period *period, pmsm_real tau)
{
    const pmsm_params *p = period->params;
    const pmsm_real I_m = pmsm_current_limit(period);
    const pmsm_row voltage = voltage_row(period);
    const pmsm_real rotation = (pmsm_abs(voltage.m_qd) + pmsm_abs(voltage.m_dq)) * I_m;
    const pmsm_real i_d_lm = (pmsm_real)p->field_weakening_i_d_lm_a;
    const problem q = {
        {{1, 0, 0, 1, 0, 0, I_m}, voltage},
        (rotation > IGNORED_SHARE * voltage.V) ? 2u : 1u,
        (pmsm_real)p->field_weakening_i_d_min_a,
        pmsm_max(i_d_lm, PMSM_C(0.0)),
        (pmsm_real)p->field_weakening_h1,
        (pmsm_real)p->field_weakening_h2,
        i_d_lm,
        tau,
        period->state->derived.torque_per_flux * period->magnetics->psi_f,
        period->state->derived.torque_per_flux * (period->magnetics->L_d_app - period->magnetics->L_q_app),
        period->state->fw_empty,
        0u,
        period->state->fw_multiplier,
        period->state->fw_corner_state,
        period->state->fw_reference,
        (p->field_weakening_mode == PMSM_FW_ACCELERATED) ? 1u : 0u,
        0u};
    return q;
}

/* Interval of i_q that a row leaves at a given i_d, intersected with [low, high]; 0 when there is none. */
static uint32_t cut_interval(const pmsm_row *row, pmsm_real d, pmsm_real *low, pmsm_real *high)
{
    const pmsm_dq on_axis = {d, PMSM_C(0.0)};
    const pmsm_dq a = pmsm_row_voltage(row, on_axis);
    const pmsm_real A = row->m_dq * row->m_dq + row->m_qq * row->m_qq;
    const pmsm_real B = a.d * row->m_dq + a.q * row->m_qq;
    const pmsm_real D = B * B - A * (pmsm_square(a) - row->V * row->V);
    if (D < PMSM_C(0.0) || A <= PMSM_C(0.0)) {
        const pmsm_real nearest = (A > PMSM_C(0.0)) ? pmsm_clamp(-B / A, *low, *high) : PMSM_C(0.0);
        *low = nearest;
        *high = nearest;
        return 0u;
    }
    const pmsm_real root = PMSM_SQRT(D);
    const pmsm_real from = pmsm_clamp((-B - root) / A, *low, *high);
    const pmsm_real to = pmsm_clamp((-B + root) / A, *low, *high);
    const uint32_t common = ((-B + root) / A >= *low && (-B - root) / A <= *high) ? 1u : 0u;
    *low = from;
    *high = to;
    return common;
}

/* Nearest point on the line of a bound of i_d. */
static pmsm_dq project_on_bound(problem *q, pmsm_real d, pmsm_real i_q)
{
    const pmsm_real I_m = q->row[0].V;
    const pmsm_real reach = PMSM_SQRT(pmsm_max(I_m * I_m - d * d, PMSM_C(0.0)));
    pmsm_real low = -reach;
    pmsm_real high = reach;
    if (q->rows > 1u && cut_interval(&q->row[1], d, &low, &high) == 0u) {
        q->empty = 1u;
    }
    const pmsm_dq x = {d, pmsm_clamp(i_q, low, high)};
    return x;
}

static uint32_t is_within(const pmsm_row *row, pmsm_dq x)
{
    return (pmsm_square(pmsm_voltage_of(row, x)) <= WITHIN * row->V * row->V) ? 1u : 0u;
}

static pmsm_dq on_circle(pmsm_dq x, pmsm_real radius)
{
    const pmsm_real scale = radius / PMSM_SQRT(pmsm_square(x));
    const pmsm_dq v = {scale * x.d, scale * x.q};
    return v;
}

/* The point of the circle with the smallest voltage; 1: even that is outside the ellipse, as far as the steps told. */
static uint32_t is_empty(problem *q, pmsm_dq *smallest)
{
    *smallest = pmsm_smallest_voltage(&q->row[1], &q->row[0], &q->steps);
    return (q->steps < PMSM_PROJECTION_STEPS && is_within(&q->row[1], *smallest) == 0u) ? 1u : 0u;
}

/* Nearest point of current circle and voltage ellipse: that of the one which the other admits, else their corner. A
 * corner to which y is drawn by both rows is the optimum wherever the search began: it begins where the last one was,
 * else at the nearest point of the ellipse, moved inwards on to the circle, which is just outside the ellipse. Where
 * that finds none, the next projection begins with the smallest voltage. Empty: the point of the circle with that,
 * flagged. */
static pmsm_dq nearest(problem *q, pmsm_dq y)
{
    const pmsm_row *circle = &q->row[0];
    const pmsm_row *ellipse = &q->row[1];
    const pmsm_dq x = (pmsm_is_within(y, circle->V) != 0u) ? y : on_circle(y, circle->V);
    if (q->rows < 2u || is_within(ellipse, x) != 0u) {
        q->empty = 0u;
        return x;
    }
    pmsm_dq smallest;
    const uint32_t doubted = (q->corner_state == CORNER_DOUBTED || q->empty != 0u) ? 1u : 0u;
    q->empty = (doubted != 0u) ? is_empty(q, &smallest) : 0u;
    if (q->empty != 0u) {
        return smallest;
    }
    pmsm_dq corner = q->corner;
    if (q->corner_state == CORNER_KNOWN) {
        if (pmsm_find_corner(circle, ellipse, y, CORNER_STEPS, &corner, &q->steps) != 0u) {
            q->corner = corner;
            return corner;
        }
        q->corner_state = CORNER_DOUBTED;
    }
    const pmsm_dq alone = pmsm_project_row_from(ellipse, y, &q->multiplier, PMSM_PROJECTION_STEPS, &q->steps);
    if (is_within(circle, alone) != 0u) {
        q->corner_state = CORNER_NONE;
        return alone;
    }
    corner = on_circle(alone, circle->V);
    const uint32_t found =
        (doubted != 0u) ? pmsm_project_pair(circle, ellipse, y, corner, smallest, &corner, &q->steps)
                        : pmsm_find_corner(circle, ellipse, y, CORNER_STEPS, &corner, &q->steps);
    q->corner_state = (found != 0u || doubted != 0u) ? CORNER_KNOWN : CORNER_DOUBTED;
    q->corner = corner;
    if (found == 0u) {
        q->steps = PMSM_PROJECTION_STEPS; /* the next period goes on from here */
    }
    return corner;
}

/* The same from nothing, with all the steps of a period. */
static pmsm_dq nearest_anew(problem *q, pmsm_dq y)
{
    pmsm_dq x = y;
    uint32_t active;
    uint32_t steps = 0u;
    uint32_t more = 0u;
    q->empty = 0u;
    if (pmsm_project_rows(q->row, q->rows, y, &x, &active, &steps) == PMSM_PROJECTION_EMPTY) {
        x = pmsm_smallest_voltage(&q->row[1], &q->row[0], &more);
        q->empty = 1u;
    }
    q->steps += steps + more;
    return x;
}

/* Projection on (44) and the bounds of i_d. */
static pmsm_dq project(problem *q, pmsm_dq y)
{
    const pmsm_dq x = (q->accelerated != 0u) ? nearest(q, y) : nearest_anew(q, y);
    if (x.d > q->d_max) {
        return project_on_bound(q, q->d_max, y.q);
    }
    if (x.d < q->d_min) {
        return project_on_bound(q, q->d_min, y.q);
    }
    return x;
}

static pmsm_real torque_error(const problem *q, pmsm_dq x)
{
    return q->tau - (q->k_t + q->k_s * x.d) * x.q;
}

static pmsm_real cost(const problem *q, pmsm_dq x)
{
    const pmsm_real e = torque_error(q, x);
    const pmsm_real off = x.d - q->i_d_lm;
    return q->h1 * e * e + q->h2 * off * off;
}

static pmsm_dq gradient(const problem *q, pmsm_dq x)
{
    const pmsm_real e = torque_error(q, x);
    const pmsm_dq g = {PMSM_C(2.0) * (q->h2 * (x.d - q->i_d_lm) - q->h1 * e * q->k_s * x.q),
                       PMSM_C(-2.0) * q->h1 * e * (q->k_t + q->k_s * x.d)};
    return g;
}

static pmsm_real distance(pmsm_dq x, pmsm_dq y)
{
    return pmsm_abs(x.d - y.d) + pmsm_abs(x.q - y.q);
}

/* (45)-(48) with gamma = 1. */
static pmsm_dq gradient_steps(problem *q, const pmsm_params *params, pmsm_dq x)
{
    const pmsm_real sigma = (pmsm_real)params->field_weakening_sigma;
    x = project(q, x);
    for (uint32_t k = 0u; k < params->field_weakening_iterations && q->empty == 0u; k++) {
        const pmsm_dq g = gradient(q, x);
        const pmsm_real now = cost(q, x);
        pmsm_real beta = (pmsm_real)params->field_weakening_beta;
        pmsm_dq z = x;
        for (uint32_t l = 0u; l < HALVINGS; l++) {
            const pmsm_dq y = {x.d - beta * g.d, x.q - beta * g.q};
            z = project(q, y);
            if (cost(q, z) <= now - sigma * (g.d * (x.d - z.d) + g.q * (x.q - z.q))) {
                break;
            }
            beta *= PMSM_C(0.5);
        }
        q->steps++;
        const pmsm_real change = distance(z, x);
        x = z;
        if (change < STEP_END) {
            break;
        }
    }
    return x;
}

/* FISTA (Beck, Teboulle, DOI 10.1137/080716542) with gradient restart, step 1/L from a local bound of the curvature. A
 * projection that used up the period's steps is not taken: the next period goes on from its multiplier, and with the
 * momentum of the last iteration. */
static void accelerated_steps(problem *q, pmsm_state *state)
{
    const uint32_t last = PMSM_PROJECTION_STEPS - STEPS_LEFT;
    pmsm_real t = state->fw_momentum;
    pmsm_dq x = state->fw_reference;
    pmsm_dq y = state->fw_ahead;
    while (q->left > 0u && q->steps < last) {
        const pmsm_real e = torque_error(q, y);
        const pmsm_real slope = q->k_t + q->k_s * y.d;
        const pmsm_real side = q->k_s * y.q;
        const pmsm_real curvature = PMSM_C(2.1) * q->h1 * (slope * slope + side * side + pmsm_abs(q->k_s * e)) +
                                    PMSM_C(2.0) * q->h2;
        if (curvature <= PMSM_C(0.0)) {
            q->left = 0u;
            break;
        }
        const pmsm_real step = PMSM_C(1.0) / curvature;
        const pmsm_dq g = gradient(q, y);
        const pmsm_dq down = {y.d - step * g.d, y.q - step * g.q};
        q->steps += ITERATION_STEPS;
        const pmsm_dq z = project(q, down);
        q->left--;
        if (q->steps >= PMSM_PROJECTION_STEPS && q->empty == 0u) {
            break;
        }
        if ((y.d - z.d) * (z.d - x.d) + (y.q - z.q) * (z.q - x.q) > PMSM_C(0.0)) {
            t = PMSM_C(1.0);
        }
        const pmsm_real t_next = PMSM_C(0.5) * (PMSM_C(1.0) + PMSM_SQRT(PMSM_C(1.0) + PMSM_C(4.0) * t * t));
        const pmsm_real ahead = (t - PMSM_C(1.0)) / t_next;
        const pmsm_real change = distance(z, x);
        y.d = z.d + ahead * (z.d - x.d);
        y.q = z.q + ahead * (z.q - x.q);
        x = z;
        t = t_next;
        if (change < STEP_END || q->empty != 0u) {
            q->left = 0u;
        }
    }
    state->fw_momentum = t;
    state->fw_reference = x;
    state->fw_ahead = y;
}

static uint32_t is_due(const pmsm_period *period, pmsm_real tau)
{
    const pmsm_state *state = period->state;
    const pmsm_params *params = period->params;
    if (state->fw_count == 0u) {
        return 1u;
    }
    const pmsm_real rated =
        state->derived.torque_per_flux * (pmsm_real)params->motor_psi_f_wb * (pmsm_real)params->motor_I_nom_apk;
    const uint32_t event = (pmsm_abs(tau - state->fw_tau) > TORQUE_EVENT * rated ||
                            pmsm_abs(period->U_ahead - state->fw_U_dc) > LINK_EVENT * state->fw_U_dc)
                               ? 1u
                               : 0u;
    return (params->field_weakening_mode == PMSM_FW_ACCELERATED) ? event : 0u;
}

pmsm_dq pmsm_field_weakening(pmsm_period *period, pmsm_real tau)
{
    pmsm_state *state = period->state;
    const pmsm_params *params = period->params;
    if (is_due(period, tau) != 0u) {
        state->fw_count = params->field_weakening_N_fw;
        state->fw_left = params->field_weakening_iterations;
        state->fw_tau = tau;
        state->fw_U_dc = period->U_ahead;
        state->fw_momentum = PMSM_C(1.0);
        state->fw_ahead = state->fw_reference;
    }
    if (state->fw_left > 0u) {
        problem q = state_problem(period, tau);
        q.left = state->fw_left;
        if (q.accelerated != 0u) {
            const uint32_t falls = (period->U_ahead < FALLING * period->U_dc) ? 1u : 0u;
            const uint32_t before = PMSM_PROJECTION_STEPS - ((falls != 0u) ? STEPS_FALLING : STEPS_MOST);
            q.steps = before;
            accelerated_steps(&q, state);
            state->fw_left = q.left;
            q.steps -= before;
            period->steps += q.steps;
        } else {
            state->fw_reference = gradient_steps(&q, params, state->fw_reference);
            state->fw_left = 0u;
        }
        state->fw_multiplier = q.multiplier;
        state->fw_corner_state = q.corner_state;
        state->fw_empty = q.empty;
        state->live.iterations += q.steps;
    }
    state->fw_count--;
    period->flags |= (state->fw_empty != 0u) ? (uint32_t)PMSM_FLAG_FW_EMPTY : 0u;
    return state->fw_reference;
}
