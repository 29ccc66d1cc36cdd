/* SPDX-License-Identifier: MIT */
/* Exact projection on intersections of ellipses in the plane.
 *
 * At the optimum at most two rows are active (an LP-type problem of dimension 2), so rows are exchanged one at a time.
 * One active row: Newton's method on 1/|w| = 1/V for its multiplier, monotone from 0. Two active rows: Newton's method
 * for the corner, after a test whether the two can be met at once; the sign of the multipliers tells the right corner.
 */
#include "active_set.h"

#define NONE PMSM_PROJECTION_NONE

#ifdef PMSM_REAL_DOUBLE
#define ROW_TOLERANCE 1e-11  /* | |w| - V | / V of a single-row projection */
#define PAIR_TOLERANCE 1e-12 /* | |w|^2/V^2 - 1 | at a corner */
#else
#define ROW_TOLERANCE 1e-6F
#define PAIR_TOLERANCE 1e-6F
#endif

typedef struct { /* symmetric 2x2 */
    pmsm_real a, b, c; /* [[a, b], [b, c]] */
} symmetric;

typedef struct { /* the same with the reciprocal of its determinant */
    symmetric s;
    pmsm_real inverse;
} factor;

static factor shifted_identity(symmetric K, pmsm_real lambda)
{
    factor f;
    f.s.a = PMSM_C(1.0) + lambda * K.a;
    f.s.b = lambda * K.b;
    f.s.c = PMSM_C(1.0) + lambda * K.c;
    f.inverse = PMSM_C(1.0) / (f.s.a * f.s.c - f.s.b * f.s.b);
    return f;
}

static factor shifted(symmetric G, pmsm_real mu)
{
    factor f;
    f.s.a = G.a + mu;
    f.s.b = G.b;
    f.s.c = G.c + mu;
    f.inverse = PMSM_C(1.0) / (f.s.a * f.s.c - f.s.b * f.s.b);
    return f;
}

static pmsm_dq solve(const factor *f, pmsm_dq x)
{
    pmsm_dq y;
    y.d = (f->s.c * x.d - f->s.b * x.q) * f->inverse;
    y.q = (f->s.a * x.q - f->s.b * x.d) * f->inverse;
    return y;
}

static pmsm_dq times(symmetric s, pmsm_dq x)
{
    pmsm_dq y;
    y.d = s.a * x.d + s.b * x.q;
    y.q = s.b * x.d + s.c * x.q;
    return y;
}

static pmsm_dq transposed_times(const pmsm_row *row, pmsm_dq w)
{
    pmsm_dq y;
    y.d = row->m_dd * w.d + row->m_qd * w.q;
    y.q = row->m_dq * w.d + row->m_qq * w.q;
    return y;
}

pmsm_dq pmsm_row_voltage(const pmsm_row *row, pmsm_dq v)
{
    return pmsm_voltage_of(row, v);
}

/* |w|^2/V^2 - 1, the reciprocal of V^2 being at hand. */
static pmsm_real excess(const pmsm_row *row, pmsm_real inverse, pmsm_dq v)
{
    return pmsm_square(pmsm_voltage_of(row, v)) * inverse - PMSM_C(1.0);
}

/* --- one row active ---------------------------------------------------------------------------------------------- */

pmsm_dq pmsm_project_row_from(const pmsm_row *row, pmsm_dq r, pmsm_real *multiplier, uint32_t most, uint32_t *steps)
{
    const pmsm_dq a = pmsm_voltage_of(row, r);
    pmsm_real square = pmsm_square(a);
    if (square <= row->V * row->V) {
        *multiplier = PMSM_C(0.0);
        return r;
    }
    /* (E + lambda K) w = a with |w| = V, K = M M^T; v = r - lambda M^T w */
    const symmetric K = {row->m_dd * row->m_dd + row->m_dq * row->m_dq, row->m_dd * row->m_qd + row->m_dq * row->m_qq,
                         row->m_qd * row->m_qd + row->m_qq * row->m_qq};
    const pmsm_real enough = row->V * (PMSM_C(1.0) + ROW_TOLERANCE);
    const uint32_t last = (*steps + most < PMSM_PROJECTION_STEPS) ? *steps + most : PMSM_PROJECTION_STEPS;
    factor S = {{PMSM_C(1.0), PMSM_C(0.0), PMSM_C(1.0)}, PMSM_C(1.0)};
    pmsm_real lambda = *multiplier;
    pmsm_real least = PMSM_C(0.0); /* of |w| at a first guess: beyond its zero Newton's method comes back below it */
    pmsm_dq w = a;
    if (lambda > PMSM_C(0.0)) {
        S = shifted_identity(K, lambda);
        w = solve(&S, a);
        square = pmsm_square(w);
        least = row->V * (PMSM_C(1.0) - ROW_TOLERANCE);
    }
    while (*steps < last) {
        const pmsm_real size = PMSM_SQRT(square);
        if (size <= enough && size >= least) {
            break;
        }
        const pmsm_dq z = solve(&S, times(K, w));
        lambda += (size - row->V) * square / (row->V * pmsm_dot(w, z));
        lambda = pmsm_max(lambda, PMSM_C(0.0));
        least = PMSM_C(0.0);
        S = shifted_identity(K, lambda);
        w = solve(&S, a);
        square = pmsm_square(w);
        (*steps)++;
    }
    *multiplier = lambda;
    const pmsm_dq step = transposed_times(row, w);
    const pmsm_dq v = {r.d - lambda * step.d, r.q - lambda * step.q};
    return v;
}

pmsm_dq pmsm_project_row(const pmsm_row *row, pmsm_dq r, uint32_t *steps)
{
    pmsm_real multiplier = PMSM_C(0.0);
    return pmsm_project_row_from(row, r, &multiplier, PMSM_PROJECTION_STEPS, steps);
}

/* --- two rows active --------------------------------------------------------------------------------------------- */

static pmsm_dq reference_of(const pmsm_row *row, pmsm_dq w)
{
    const pmsm_real inverse = PMSM_C(1.0) / (row->m_dd * row->m_qq - row->m_dq * row->m_qd);
    const pmsm_real d = w.d - row->c_d;
    const pmsm_real q = w.q - row->c_q;
    const pmsm_dq v = {(row->m_qq * d - row->m_dq * q) * inverse, (row->m_dd * q - row->m_qd * d) * inverse};
    return v;
}

static pmsm_real square_of_change(const pmsm_row *row, pmsm_dq step)
{
    const pmsm_dq change = {row->m_dd * step.d + row->m_dq * step.q, row->m_qd * step.d + row->m_qq * step.q};
    return pmsm_square(change);
}

/* Newton's method for the corner where both rows are met with equality; 1 when it is the optimum, that is when r - v is
 * a non-negative combination of the two outward normals. The rows are quadratic, so what a step leaves of |w|^2 - V^2
 * is the square of the change of w: known without looking again. */
uint32_t pmsm_find_corner(const pmsm_row *first, const pmsm_row *second, pmsm_dq r, uint32_t most, pmsm_dq *v,
                          uint32_t *steps)
{
    const pmsm_real limit_1 = first->V * first->V;
    const pmsm_real limit_2 = second->V * second->V;
    for (uint32_t k = 0u; k < most && *steps < PMSM_PROJECTION_STEPS; k++) {
        const pmsm_dq w1 = pmsm_voltage_of(first, *v);
        const pmsm_dq w2 = pmsm_voltage_of(second, *v);
        const pmsm_real f1 = PMSM_C(0.5) * (pmsm_square(w1) - limit_1);
        const pmsm_real f2 = PMSM_C(0.5) * (pmsm_square(w2) - limit_2);
        const pmsm_dq n1 = transposed_times(first, w1);
        const pmsm_dq n2 = transposed_times(second, w2);
        const pmsm_real det = n1.d * n2.q - n1.q * n2.d;
        if (det * det <= PMSM_PROJECTION_SINGULAR * (pmsm_square(n1) * pmsm_square(n2))) {
            return 0u;
        }
        const pmsm_real inverse = PMSM_C(1.0) / det;
        const pmsm_dq step = {(f1 * n2.q - f2 * n1.q) * inverse, (f2 * n1.d - f1 * n2.d) * inverse};
        v->d -= step.d;
        v->q -= step.q;
        *steps += PMSM_CORNER_COST;
        if (square_of_change(first, step) <= PAIR_TOLERANCE * limit_1 &&
            square_of_change(second, step) <= PAIR_TOLERANCE * limit_2) {
            const pmsm_dq pull = {r.d - v->d, r.q - v->q};
            const pmsm_real l1 = (pull.d * n2.q - pull.q * n2.d) * inverse;
            const pmsm_real l2 = (pull.q * n1.d - pull.d * n1.q) * inverse;
            return (l1 >= PMSM_C(0.0) && l2 >= PMSM_C(0.0)) ? 1u : 0u;
        }
    }
    return 0u;
}

/* The point of the first row's boundary above the point t of the chord from a to b (voltages of the row). */
static pmsm_dq on_arc(const pmsm_row *first, pmsm_dq a, pmsm_dq b, pmsm_real t)
{
    const pmsm_dq chord = {a.d + t * (b.d - a.d), a.q + t * (b.q - a.q)};
    const pmsm_real scale = first->V / PMSM_SQRT(pmsm_square(chord));
    const pmsm_dq w = {scale * chord.d, scale * chord.q};
    return reference_of(first, w);
}

/* Both rows with equality, 0: there is no such optimum. outside is on the first row and violates the second, whose
 * voltage is smallest at best of all points of the first row's disc; if it is too large even there, the two cannot be
 * met at once. On the boundary of the first row the excess of the second grows from that point like a parabola, which
 * tells where to start Newton's method: also the short lens of two rows that hardly meet has its corners where the
 * parabola says. */
uint32_t pmsm_project_pair(const pmsm_row *first, const pmsm_row *second, pmsm_dq r, pmsm_dq outside, pmsm_dq best,
                             pmsm_dq *v, uint32_t *steps)
{
    const pmsm_real inverse = PMSM_C(1.0) / (second->V * second->V);
    const pmsm_real depth = -excess(second, inverse, best);
    if (depth < -PMSM_PROJECTION_VIOLATION) {
        return 0u;
    }
    const pmsm_dq a = pmsm_voltage_of(first, outside);
    const pmsm_dq b = pmsm_voltage_of(first, best);
    const pmsm_real within = pmsm_max(depth, PMSM_C(0.0));
    const pmsm_real share = PMSM_SQRT(within / (within + excess(second, inverse, outside)));
    *v = on_arc(first, a, b, PMSM_C(1.0) - share);
    return pmsm_find_corner(first, second, r, PMSM_CORNER_STEPS, v, steps);
}

pmsm_dq pmsm_smallest_voltage(const pmsm_row *goal, const pmsm_row *limit, uint32_t *steps)
{
    /* coordinates y = M_l v + c_l: minimise |B y + f| over the disc |y| <= V_l */
    const pmsm_real inverse = PMSM_C(1.0) / (limit->m_dd * limit->m_qq - limit->m_dq * limit->m_qd);
    const pmsm_row back = {limit->m_qq * inverse, -limit->m_dq * inverse, -limit->m_qd * inverse,
                           limit->m_dd * inverse, PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0)};
    const pmsm_dq centre = {-limit->c_d, -limit->c_q};
    const pmsm_dq f = pmsm_voltage_of(goal, pmsm_voltage_of(&back, centre));
    const pmsm_row B = {goal->m_dd * back.m_dd + goal->m_dq * back.m_qd,
                        goal->m_dd * back.m_dq + goal->m_dq * back.m_qq,
                        goal->m_qd * back.m_dd + goal->m_qq * back.m_qd,
                        goal->m_qd * back.m_dq + goal->m_qq * back.m_qq,
                        PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0)};
    const symmetric G = {B.m_dd * B.m_dd + B.m_qd * B.m_qd, B.m_dd * B.m_dq + B.m_qd * B.m_qq,
                         B.m_dq * B.m_dq + B.m_qq * B.m_qq};
    const pmsm_dq right = transposed_times(&B, f);
    const pmsm_real enough = limit->V * (PMSM_C(1.0) + ROW_TOLERANCE);
    pmsm_real mu = PMSM_PROJECTION_SINGULAR * (G.a + G.c); /* keeps a singular goal solvable */
    pmsm_real size = PMSM_C(0.0);
    pmsm_dq y = {PMSM_C(0.0), PMSM_C(0.0)};
    for (;;) { /* Newton on 1/|y| = 1/V, monotone from below */
        const factor S = shifted(G, mu);
        y = solve(&S, right);
        const pmsm_real square = pmsm_square(y);
        size = PMSM_SQRT(square);
        if (size <= enough || *steps >= PMSM_PROJECTION_STEPS) {
            break;
        }
        mu += (size - limit->V) * square / (limit->V * pmsm_dot(y, solve(&S, y)));
        (*steps)++;
    }
    const pmsm_real scale = (size > limit->V) ? -limit->V / size : PMSM_C(-1.0);
    const pmsm_dq point = {scale * y.d - limit->c_d, scale * y.q - limit->c_q};
    return pmsm_voltage_of(&back, point);
}

/* --- active set -------------------------------------------------------------------------------------------------- */

static uint32_t most_violated(const pmsm_active_set *set, pmsm_dq v, pmsm_real *worst)
{
    uint32_t index = 0u;
    *worst = excess(&set->row[0], set->inverse[0], v);
    for (uint32_t k = 1u; k < set->count; k++) {
        const pmsm_real g = excess(&set->row[k], set->inverse[k], v);
        if (g > *worst) {
            *worst = g;
            index = k;
        }
    }
    return index;
}

/* Does v satisfy the active rows? */
static uint32_t satisfies(const pmsm_active_set *set, uint32_t k, pmsm_dq v)
{
    return (k == NONE || excess(&set->row[k], set->inverse[k], v) <= PMSM_PROJECTION_VIOLATION) ? 1u : 0u;
}

/* The new basis after row k turned out violated in v: k alone, or k with one of the old rows. 0: there is none. */
static uint32_t exchange(pmsm_active_set *set, uint32_t k, uint32_t *steps)
{
    const pmsm_dq r = set->r;
    const pmsm_dq alone = pmsm_project_row(&set->row[k], r, steps);
    const uint32_t inside = (alone.d == r.d && alone.q == r.q) ? 1u : 0u; /* r itself is on neither boundary then */
    const uint32_t met[2] = {satisfies(set, set->basis[0], alone), satisfies(set, set->basis[1], alone)};
    if ((met[0] & met[1]) != 0u) {
        set->basis[0] = k;
        set->basis[1] = NONE;
        set->v = alone;
        return 1u;
    }
    for (uint32_t j = 0u; j < 2u; j++) {
        const uint32_t other = set->basis[j];
        if (met[j] != 0u) {
            continue;
        }
        const uint32_t first = (inside != 0u) ? other : k;
        const uint32_t second = (inside != 0u) ? k : other;
        const pmsm_dq best = pmsm_smallest_voltage(&set->row[second], &set->row[first], steps);
        pmsm_dq x;
        if (pmsm_project_pair(&set->row[first], &set->row[second], r, (inside != 0u) ? set->v : alone, best, &x,
                         steps) != 0u &&
            satisfies(set, set->basis[1u - j], x) != 0u) {
            set->basis[0] = k;
            set->basis[1] = other;
            set->v = x;
            return 1u;
        }
    }
    return 0u;
}

uint32_t pmsm_projection_extend(pmsm_active_set *set, uint32_t count, uint32_t *steps)
{
    for (uint32_t k = set->count; k < count; k++) {
        set->inverse[k] = PMSM_C(1.0) / (set->row[k].V * set->row[k].V);
    }
    set->count = count;
    for (uint32_t round = 0u; round < PMSM_PROJECTION_ROUNDS; round++) {
        pmsm_real worst;
        const uint32_t k = most_violated(set, set->v, &worst);
        const uint32_t again = (k == set->basis[0] || k == set->basis[1]) ? 1u : 0u;
        if (worst <= PMSM_PROJECTION_VIOLATION || (again != 0u && worst <= PMSM_PROJECTION_STALL)) {
            return ((set->basis[0] != NONE) ? 1u : 0u) + ((set->basis[1] != NONE) ? 1u : 0u);
        }
        if (again != 0u || exchange(set, k, steps) == 0u) {
            return PMSM_PROJECTION_EMPTY;
        }
    }
    return PMSM_PROJECTION_EMPTY;
}

uint32_t pmsm_project_rows(const pmsm_row *rows, uint32_t count, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                           uint32_t *steps)
{
    pmsm_active_set set;
    pmsm_projection_begin(&set, rows, r);
    const uint32_t status = pmsm_projection_extend(&set, count, steps);
    if (status != PMSM_PROJECTION_EMPTY) {
        *v = set.v;
        *active = set.basis[0];
    }
    return status;
}
