/* SPDX-License-Identifier: MIT */
/* Solvers on the governor's rows: exact, linearised, line search. */
#include "active_set.h"
#include "governor.h"

#define POLYGON 8u /* faces that stand for the circle in the linearised mode */
#define POLYGON_INNER PMSM_C(0.92387953251128675613) /* cos(pi/8): the polygon lies inside the circle */

#define SLIDE_STEPS 3u                /* of the search for the corner */
#define SLIDE_SHARE PMSM_C(1.02)      /* of the current limit: nothing slides at rest in its corner with the steady state */
#define SLIDE_MARGIN PMSM_C(1.0001)   /* on the square, of the rows in what was found */

pmsm_dq pmsm_governor_slide(const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq v, uint32_t *steps)
{
    const pmsm_row *now = &rows->row[0];
    if (rows->count <= rows->steady + 1u) {
        return v;
    }
    pmsm_row circle = rows->row[rows->count - 1u];
    circle.V *= SLIDE_SHARE;
    const pmsm_real limit = circle.V * circle.V;
    const pmsm_real square = pmsm_square(v);
    if (square <= limit) {
        return v;
    }
    const pmsm_real share = circle.V / PMSM_SQRT(square);
    pmsm_dq corner = {share * v.d, share * v.q};
    (void)pmsm_find_corner(now, &circle, r, SLIDE_STEPS, &corner, steps);
    const uint32_t within = (pmsm_square(corner) <= SLIDE_MARGIN * limit &&
                             pmsm_square(pmsm_voltage_of(now, corner)) <= SLIDE_MARGIN * now->V * now->V)
                                ? 1u
                                : 0u;
    return (within != 0u) ? corner : v;
}

uint32_t pmsm_governor_project(const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                               uint32_t *steps)
{
    pmsm_active_set set;
    pmsm_projection_begin(&set, rows->row, r);
    if (pmsm_projection_extend(&set, rows->steady + 1u, steps) == PMSM_PROJECTION_EMPTY) {
        return PMSM_PROJECTION_EMPTY;
    }
    *v = set.v;
    *active = set.basis[0];
    if (rows->count > rows->steady + 1u) {
        if (rows->reachable != 0u) { /* row 0 alone holds it back: an exact exchange would take the rest of the period */
            *v = (set.basis[1] == PMSM_PROJECTION_NONE) ? pmsm_governor_slide(rows, r, set.v, steps) : set.v;
            return 1u;
        }
        if (pmsm_projection_extend(&set, rows->count, steps) == PMSM_PROJECTION_EMPTY) {
            return 0u;
        }
        *v = set.v;
        *active = set.basis[0];
    }
    return 1u;
}

/* The circle of each row replaced by an inscribed octagon: [18] of the paper keeps its voltage rows linear. */
static uint32_t solve_linearised(const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                                 uint32_t *steps)
{
    static const pmsm_real half = PMSM_C(0.70710678118654752440);
    const pmsm_dq normal[POLYGON] = {{1, 0}, {half, half}, {0, 1}, {-half, half},
                                     {-1, 0}, {-half, -half}, {0, -1}, {half, -half}};
    pmsm_dq a[POLYGON * (PMSM_POLYGON_ROWS + 2u)];
    pmsm_real b[POLYGON * (PMSM_POLYGON_ROWS + 2u)];
    for (uint32_t j = 0u; j < rows->count; j++) {
        const pmsm_row *row = &rows->row[j];
        for (uint32_t k = 0u; k < POLYGON; k++) {
            const pmsm_dq n = normal[k];
            a[POLYGON * j + k].d = row->m_dd * n.d + row->m_qd * n.q;
            a[POLYGON * j + k].q = row->m_dq * n.d + row->m_qq * n.q;
            b[POLYGON * j + k] = POLYGON_INNER * row->V - (n.d * row->c_d + n.q * row->c_q);
        }
    }
    const uint32_t status = pmsm_project_half_planes(a, b, POLYGON * rows->count, r, v, active, steps);
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
    cc = pmsm_min(PMSM_C(0.0), cc);
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
 * up: a reference that stays there does not follow what the voltage can hold, and the current runs away. 0: a row was
 * given up. */
static uint32_t solve_line(const pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq *v,
                           uint32_t *active)
{
    const pmsm_row *steady = &rows->row[rows->steady];
    const pmsm_dq p = period->state->reference_held;
    const pmsm_dq way = {r.d - p.d, r.q - p.q};
    const pmsm_real slack = (pmsm_real)period->params->governor_slack;
    pmsm_real kappa = PMSM_C(1.0);
    uint32_t all = 1u;
    for (uint32_t k = 0u; k < rows->count && kappa >= PMSM_C(0.0); k++) {
        const pmsm_real share = row_share(&rows->row[k], p, way, slack);
        all = (share < PMSM_C(0.0)) ? 0u : all;
        if (share < kappa && (k <= rows->steady || share >= PMSM_C(0.0))) {
            kappa = share;
            *active = k;
        }
    }
    if (kappa >= PMSM_C(0.0)) {
        v->d = p.d + kappa * way.d;
        v->q = p.q + kappa * way.q;
        return all;
    }
    const uint32_t outside = (pmsm_square(pmsm_voltage_of(steady, p)) > steady->V * steady->V) ? 1u : 0u;
    *v = (outside != 0u) ? scale_voltage(steady, p) : p;
    return 0u;
}

/* Where not all rows can be met the current row is given up; where row 0 and the steady state exclude each other, the
 * smallest steady-state voltage that row 0 allows is taken. Row 0 always can be met, so the inverter's limit holds in
 * any case. */
pmsm_dq pmsm_governor_solve(pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r, uint32_t *binding,
                            uint32_t *steps)
{
    const uint32_t mode = period->params->governor_mode;
    uint32_t active = PMSM_BINDING_NONE;
    uint32_t found = 0u;
    uint32_t exchanges = 0u;
    pmsm_dq v = r;
    if (mode == PMSM_GOVERNOR_LINE) {
        found = solve_line(period, rows, r, &v, &active);
        exchanges = 1u;
    } else if (mode == PMSM_GOVERNOR_LINEARISED) {
        found = solve_linearised(rows, r, &v, &active, &exchanges);
        period->flags |= (found == 0u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    }
    if (mode != PMSM_GOVERNOR_LINE && found == 0u) {
        active = PMSM_BINDING_NONE;
        found = pmsm_governor_project(rows, r, &v, &active, steps);
    }
    period->state->live.iterations += exchanges;
    period->flags |= (found != 1u) ? (uint32_t)PMSM_FLAG_GOVERNOR_FALLBACK : 0u;
    if (found == PMSM_PROJECTION_EMPTY) {
        *binding = PMSM_BINDING_EMPTY;
        return pmsm_smallest_voltage(&rows->row[rows->steady], &rows->row[0], steps);
    }
    *binding = pmsm_governor_binding(rows, active);
    return v;
}
