/* Exact projection on intersections of ellipses in the plane.
 *
 * At the optimum at most two rows are active (an LP-type problem of dimension 2). One row: Newton's method on
 * 1/|w| = 1/V, monotone from multiplier 0. Two rows: Newton's method on the concave dual in the two multipliers.
 */
#include "pmsm_projection.h"

#include "pmsm_math.h"

#ifdef PMSM_REAL_DOUBLE
#define ROW_TOLERANCE 1e-11     /* | |w| - V | / V of a single-row projection */
#define PAIR_TOLERANCE 1e-12    /* | |w|^2/V^2 - 1 | / 2 of a two-row projection */
#define VIOLATION 1e-10         /* |w|^2/V^2 - 1 that counts as satisfied */
#define STALL 1e-7              /* the same, when rounding keeps a row from coming closer */
#define SINGULAR 1e-13          /* relative determinant below which two normals count as parallel */
#define ROUNDING 1e-15          /* relative error of a dual value */
#else
#define ROW_TOLERANCE 1e-6F
#define PAIR_TOLERANCE 2e-6F
#define VIOLATION 5e-6F
#define STALL 2e-5F
#define SINGULAR 1e-6F
#define ROUNDING 3e-7F
#endif
#define PAIR_STEPS 16u          /* of the dual iteration */
#define NONE 255u

typedef struct { /* symmetric 2x2 */
    pmsm_real a, b, c; /* [[a, b], [b, c]] */
} symmetric;

static pmsm_dq solve(symmetric s, pmsm_dq x)
{
    const pmsm_real inverse = PMSM_C(1.0) / (s.a * s.c - s.b * s.b);
    pmsm_dq y;
    y.d = (s.c * x.d - s.b * x.q) * inverse;
    y.q = (s.a * x.q - s.b * x.d) * inverse;
    return y;
}

static pmsm_dq times(symmetric s, pmsm_dq x)
{
    pmsm_dq y;
    y.d = s.a * x.d + s.b * x.q;
    y.q = s.b * x.d + s.c * x.q;
    return y;
}

static pmsm_real dot(pmsm_dq x, pmsm_dq y)
{
    return x.d * y.d + x.q * y.q;
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
    pmsm_dq w;
    w.d = (row->m_dd * v.d + row->m_dq * v.q) + row->c_d;
    w.q = (row->m_qd * v.d + row->m_qq * v.q) + row->c_q;
    return w;
}

static pmsm_real excess(const pmsm_row *row, pmsm_dq v)
{
    return pmsm_square(pmsm_row_voltage(row, v)) / (row->V * row->V) - PMSM_C(1.0);
}

/* (E + lambda K) w = a with |w| = V, K = M M^T: the multiplier of the row, for |a| > V. */
static pmsm_dq shrink(symmetric K, pmsm_dq a, pmsm_real V, pmsm_real *lambda, uint32_t *steps)
{
    pmsm_dq w = a;
    *lambda = PMSM_C(0.0);
    for (uint32_t k = 0u; k < PMSM_PROJECTION_ROUNDS; k++) {
        const pmsm_real square = pmsm_square(w);
        const pmsm_real size = PMSM_SQRT(square);
        if (size - V <= ROW_TOLERANCE * V) {
            break;
        }
        symmetric S = {PMSM_C(1.0) + *lambda * K.a, *lambda * K.b, PMSM_C(1.0) + *lambda * K.c};
        const pmsm_dq z = solve(S, times(K, w));
        *lambda += ((size - V) / V) * square / dot(w, z);
        S.a = PMSM_C(1.0) + *lambda * K.a;
        S.b = *lambda * K.b;
        S.c = PMSM_C(1.0) + *lambda * K.c;
        w = solve(S, a);
        (*steps)++;
    }
    return w;
}

pmsm_dq pmsm_project_row(const pmsm_row *row, pmsm_dq r, uint32_t *steps)
{
    const pmsm_dq a = pmsm_row_voltage(row, r);
    if (pmsm_square(a) <= row->V * row->V) {
        return r;
    }
    const symmetric K = {row->m_dd * row->m_dd + row->m_dq * row->m_dq, row->m_dd * row->m_qd + row->m_dq * row->m_qq,
                         row->m_qd * row->m_qd + row->m_qq * row->m_qq};
    pmsm_real lambda;
    const pmsm_dq w = shrink(K, a, row->V, &lambda, steps);
    const pmsm_dq step = transposed_times(row, w);
    pmsm_dq v;
    v.d = r.d - lambda * step.d;
    v.q = r.q - lambda * step.q;
    return v;
}

/* --- two rows active: concave dual in (l1, l2) >= 0, rows scaled to V = 1 ------------------------------------- */

typedef struct {
    symmetric G;  /* A^T A */
    pmsm_dq h;    /* A^T d */
    pmsm_real e;  /* |d|^2 - 1 */
} quadratic;

typedef struct {
    pmsm_dq v;
    pmsm_dq n[2]; /* gradients of g */
    pmsm_real g[2];
    symmetric H;
    pmsm_real value; /* of the dual */
} dual_point;

static quadratic scaled(const pmsm_row *row)
{
    const pmsm_real s = PMSM_C(1.0) / row->V;
    const pmsm_real dd = row->m_dd * s;
    const pmsm_real dq = row->m_dq * s;
    const pmsm_real qd = row->m_qd * s;
    const pmsm_real qq = row->m_qq * s;
    const pmsm_real c_d = row->c_d * s;
    const pmsm_real c_q = row->c_q * s;
    const quadratic q = {{dd * dd + qd * qd, dd * dq + qd * qq, dq * dq + qq * qq},
                         {dd * c_d + qd * c_q, dq * c_d + qq * c_q},
                         c_d * c_d + c_q * c_q - PMSM_C(1.0)};
    return q;
}

static void evaluate(const quadratic rows[2], pmsm_dq r, const pmsm_real l[2], dual_point *point)
{
    const symmetric H = {PMSM_C(1.0) + l[0] * rows[0].G.a + l[1] * rows[1].G.a,
                         l[0] * rows[0].G.b + l[1] * rows[1].G.b,
                         PMSM_C(1.0) + l[0] * rows[0].G.c + l[1] * rows[1].G.c};
    const pmsm_dq right = {r.d - l[0] * rows[0].h.d - l[1] * rows[1].h.d,
                           r.q - l[0] * rows[0].h.q - l[1] * rows[1].h.q};
    point->H = H;
    point->v = solve(H, right);
    const pmsm_dq step = {point->v.d - r.d, point->v.q - r.q};
    point->value = PMSM_C(0.5) * pmsm_square(step);
    for (uint32_t k = 0u; k < 2u; k++) {
        const pmsm_dq Gv = times(rows[k].G, point->v);
        point->n[k].d = Gv.d + rows[k].h.d;
        point->n[k].q = Gv.q + rows[k].h.q;
        point->g[k] = PMSM_C(0.5) * ((dot(point->v, point->n[k]) + dot(point->v, rows[k].h)) + rows[k].e);
        point->value += l[k] * point->g[k];
    }
}

/* Newton step of the dual on the multipliers that are free. */
static void newton_step(const dual_point *point, const pmsm_real l[2], pmsm_real step[2])
{
    const pmsm_dq y0 = solve(point->H, point->n[0]);
    const pmsm_dq y1 = solve(point->H, point->n[1]);
    const pmsm_real D[2] = {dot(point->n[0], y0), dot(point->n[1], y1)};
    const pmsm_real across = dot(point->n[0], y1);
    const pmsm_real *g = point->g;
    const pmsm_real floor_det = SINGULAR * D[0] * D[1];
    const uint32_t fixed0 = (l[0] <= PMSM_C(0.0) && g[0] < PMSM_C(0.0)) ? 1u : 0u;
    const uint32_t fixed1 = (l[1] <= PMSM_C(0.0) && g[1] < PMSM_C(0.0)) ? 1u : 0u;
    pmsm_real det = D[0] * D[1] - across * across;
    det = (det > floor_det) ? det : floor_det;
    step[0] = (fixed0 != 0u) ? PMSM_C(0.0) : (fixed1 != 0u) ? g[0] / D[0] : (g[0] * D[1] - g[1] * across) / det;
    step[1] = (fixed1 != 0u) ? PMSM_C(0.0) : (fixed0 != 0u) ? g[1] / D[1] : (g[1] * D[0] - g[0] * across) / det;
    for (uint32_t k = 0u; k < 2u; k++) {
        const uint32_t other = 1u - k;
        if (l[k] + step[k] < PMSM_C(0.0)) { /* this one goes to its bound, the other answers alone */
            step[k] = -l[k];
            step[other] = (g[other] - across * step[k]) / D[other];
            step[other] = (l[other] + step[other] < PMSM_C(0.0)) ? -l[other] : step[other];
            break;
        }
    }
}

static uint32_t is_solved(const dual_point *point, const pmsm_real l[2])
{
    uint32_t good = 1u;
    for (uint32_t k = 0u; k < 2u; k++) {
        const pmsm_real g = point->g[k];
        const uint32_t touches = (pmsm_abs(g) <= PAIR_TOLERANCE) ? 1u : 0u;
        const uint32_t idle = (l[k] <= PMSM_C(0.0) && g < PMSM_C(0.0)) ? 1u : 0u;
        good &= touches | idle;
    }
    return good;
}

static pmsm_real start_multiplier(const pmsm_row *row, pmsm_dq r, uint32_t *steps)
{
    const pmsm_dq a = pmsm_row_voltage(row, r);
    if (pmsm_square(a) <= row->V * row->V) {
        return PMSM_C(0.0);
    }
    const symmetric K = {row->m_dd * row->m_dd + row->m_dq * row->m_dq, row->m_dd * row->m_qd + row->m_dq * row->m_qq,
                         row->m_qd * row->m_qd + row->m_qq * row->m_qq};
    pmsm_real lambda;
    (void)shrink(K, a, row->V, &lambda, steps);
    return PMSM_C(0.5) * lambda * (row->V * row->V);
}

/* Can both rows be met at all? The smallest |w| of the one on the disc of the other tells, in few steps. */
static uint32_t pair_is_feasible(const pmsm_row *first, const pmsm_row *second, uint32_t *steps)
{
    const pmsm_dq v = pmsm_smallest_voltage(second, first, steps);
    return (excess(second, v) <= VIOLATION) ? 1u : 0u;
}

/* Returns 1 and the point when both rows can be met at once. */
static uint32_t project_pair(const pmsm_row *first, const pmsm_row *second, pmsm_dq r, pmsm_dq *v, uint32_t *steps)
{
    if (pair_is_feasible(first, second, steps) == 0u) {
        return 0u;
    }
    const quadratic rows[2] = {scaled(first), scaled(second)};
    pmsm_real l[2] = {start_multiplier(first, r, steps), start_multiplier(second, r, steps)};
    dual_point point;
    evaluate(rows, r, l, &point);
    for (uint32_t k = 0u; k < PAIR_STEPS; k++) {
        if (is_solved(&point, l) != 0u) {
            break;
        }
        pmsm_real step[2];
        newton_step(&point, l, step);
        dual_point next;
        pmsm_real trial[2];
        for (uint32_t cut = 0u; cut < 4u; cut++) { /* the dual must not decrease */
            trial[0] = l[0] + step[0];
            trial[1] = l[1] + step[1];
            evaluate(rows, r, trial, &next);
            (*steps)++;
            if (next.value >= point.value - ROUNDING * pmsm_abs(point.value)) {
                break;
            }
            step[0] *= PMSM_C(0.4);
            step[1] *= PMSM_C(0.4);
        }
        l[0] = trial[0];
        l[1] = trial[1];
        point = next;
    }
    *v = point.v;
    return (point.g[0] <= STALL && point.g[1] <= STALL) ? 1u : 0u;
}

/* --- active set ---------------------------------------------------------------------------------------------- */

static uint32_t most_violated(const pmsm_row *rows, uint32_t count, pmsm_dq v, pmsm_real *worst)
{
    uint32_t index = 0u;
    *worst = excess(&rows[0], v);
    for (uint32_t k = 1u; k < count; k++) {
        const pmsm_real g = excess(&rows[k], v);
        if (g > *worst) {
            *worst = g;
            index = k;
        }
    }
    return index;
}

typedef struct { /* indices of the active rows, NONE when free */
    uint32_t row[2];
} basis;

static uint32_t satisfies(const pmsm_row *rows, const basis *b, uint32_t skip, pmsm_dq v)
{
    for (uint32_t k = 0u; k < 2u; k++) {
        if (b->row[k] != NONE && b->row[k] != skip && excess(&rows[b->row[k]], v) > VIOLATION) {
            return 0u;
        }
    }
    return 1u;
}

/* The new basis after row k turned out violated: k alone, or k with one of the old rows. 0: there is none. */
static uint32_t exchange(const pmsm_row *rows, uint32_t k, pmsm_dq r, basis *b, pmsm_dq *v, uint32_t *steps)
{
    pmsm_dq x = pmsm_project_row(&rows[k], r, steps);
    if (satisfies(rows, b, NONE, x) != 0u) {
        b->row[0] = k;
        b->row[1] = NONE;
        *v = x;
        return 1u;
    }
    for (uint32_t j = 0u; j < 2u; j++) {
        const uint32_t other = b->row[j];
        if (other != NONE && project_pair(&rows[k], &rows[other], r, &x, steps) != 0u &&
            satisfies(rows, b, other, x) != 0u) {
            b->row[0] = k;
            b->row[1] = other;
            *v = x;
            return 1u;
        }
    }
    return 0u;
}

uint32_t pmsm_project_rows(const pmsm_row *rows, uint32_t count, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                           uint32_t *steps)
{
    pmsm_dq x = r;
    basis b = {{NONE, NONE}};
    for (uint32_t round = 0u; round < PMSM_PROJECTION_ROUNDS; round++) {
        pmsm_real worst;
        const uint32_t k = most_violated(rows, count, x, &worst);
        const uint32_t again = (k == b.row[0] || k == b.row[1]) ? 1u : 0u;
        if (worst <= VIOLATION || (again != 0u && worst <= STALL)) {
            *v = x;
            *active = b.row[0];
            return ((b.row[0] != NONE) ? 1u : 0u) + ((b.row[1] != NONE) ? 1u : 0u);
        }
        if (again != 0u || exchange(rows, k, r, &b, &x, steps) == 0u) {
            return PMSM_PROJECTION_EMPTY;
        }
    }
    return PMSM_PROJECTION_EMPTY;
}

pmsm_dq pmsm_smallest_voltage(const pmsm_row *goal, const pmsm_row *limit, uint32_t *steps)
{
    /* coordinates y = M_l v + c_l: minimise |B y + f| over the disc |y| <= V_l */
    const pmsm_real inverse = PMSM_C(1.0) / (limit->m_dd * limit->m_qq - limit->m_dq * limit->m_qd);
    const pmsm_row back = {limit->m_qq * inverse, -limit->m_dq * inverse, -limit->m_qd * inverse,
                           limit->m_dd * inverse, PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0)};
    const pmsm_dq centre = {-limit->c_d, -limit->c_q};
    const pmsm_dq v_centre = pmsm_row_voltage(&back, centre);
    const pmsm_dq f = pmsm_row_voltage(goal, v_centre);
    const pmsm_row B = {goal->m_dd * back.m_dd + goal->m_dq * back.m_qd, goal->m_dd * back.m_dq + goal->m_dq * back.m_qq,
                        goal->m_qd * back.m_dd + goal->m_qq * back.m_qd, goal->m_qd * back.m_dq + goal->m_qq * back.m_qq,
                        PMSM_C(0.0), PMSM_C(0.0), PMSM_C(1.0)};
    const symmetric G = {B.m_dd * B.m_dd + B.m_qd * B.m_qd, B.m_dd * B.m_dq + B.m_qd * B.m_qq,
                         B.m_dq * B.m_dq + B.m_qq * B.m_qq};
    const pmsm_dq right = transposed_times(&B, f);
    pmsm_real mu = SINGULAR * (G.a + G.c); /* keeps a singular goal solvable */
    pmsm_dq y = {PMSM_C(0.0), PMSM_C(0.0)};
    for (uint32_t k = 0u; k < PMSM_PROJECTION_ROUNDS; k++) { /* Newton on 1/|y| = 1/V, monotone from below */
        const symmetric S = {G.a + mu, G.b, G.c + mu};
        y = solve(S, right);
        const pmsm_real square = pmsm_square(y);
        const pmsm_real size = PMSM_SQRT(square);
        if (size <= limit->V * (PMSM_C(1.0) + ROW_TOLERANCE)) {
            break;
        }
        mu += ((size - limit->V) / limit->V) * square / dot(y, solve(S, y));
        (*steps)++;
    }
    const pmsm_real size = PMSM_SQRT(pmsm_square(y));
    const pmsm_real scale = (size > limit->V) ? -limit->V / size : PMSM_C(-1.0);
    const pmsm_dq point = {scale * y.d - limit->c_d, scale * y.q - limit->c_q};
    return pmsm_row_voltage(&back, point);
}

/* --- half planes --------------------------------------------------------------------------------------------- */

typedef struct {
    const pmsm_dq *a;
    const pmsm_real *b;
    pmsm_dq r;
} half_planes;

/* a v - b, relative to the size of the terms. */
static pmsm_real beyond(const half_planes *h, uint32_t k, pmsm_dq v)
{
    const pmsm_real size = pmsm_abs(h->a[k].d * v.d) + pmsm_abs(h->a[k].q * v.q) + pmsm_abs(h->b[k]);
    return (dot(h->a[k], v) - h->b[k]) / (size + PMSM_C(1e-30));
}

/* Corner of two lines, if r sees it from inside the cone of their normals. */
static uint32_t corner(const half_planes *h, uint32_t k, uint32_t other, pmsm_dq *v)
{
    const pmsm_dq n1 = h->a[k];
    const pmsm_dq n2 = h->a[other];
    const pmsm_real det = n1.d * n2.q - n1.q * n2.d;
    if (pmsm_abs(det) <= SINGULAR * PMSM_SQRT(pmsm_square(n1) * pmsm_square(n2))) {
        return 0u;
    }
    v->d = (h->b[k] * n2.q - h->b[other] * n1.q) / det;
    v->q = (h->b[other] * n1.d - h->b[k] * n2.d) / det;
    const pmsm_dq pull = {h->r.d - v->d, h->r.q - v->q};
    const pmsm_real l1 = (pull.d * n2.q - pull.q * n2.d) / det;
    const pmsm_real l2 = (pull.q * n1.d - pull.d * n1.q) / det;
    return (l1 >= PMSM_C(0.0) && l2 >= PMSM_C(0.0)) ? 1u : 0u;
}

static uint32_t respects(const half_planes *h, const basis *b, uint32_t skip, pmsm_dq v)
{
    for (uint32_t k = 0u; k < 2u; k++) {
        if (b->row[k] != NONE && b->row[k] != skip && beyond(h, b->row[k], v) > VIOLATION) {
            return 0u;
        }
    }
    return 1u;
}

static uint32_t exchange_line(const half_planes *h, uint32_t k, basis *b, pmsm_dq *v)
{
    const pmsm_dq n = h->a[k];
    const pmsm_real lambda = (dot(n, h->r) - h->b[k]) / pmsm_square(n);
    pmsm_dq x = {h->r.d - lambda * n.d, h->r.q - lambda * n.q};
    if (respects(h, b, NONE, x) != 0u) {
        b->row[0] = k;
        b->row[1] = NONE;
        *v = x;
        return 1u;
    }
    for (uint32_t j = 0u; j < 2u; j++) {
        const uint32_t other = b->row[j];
        if (other != NONE && corner(h, k, other, &x) != 0u && respects(h, b, other, x) != 0u) {
            b->row[0] = k;
            b->row[1] = other;
            *v = x;
            return 1u;
        }
    }
    return 0u;
}

uint32_t pmsm_project_half_planes(const pmsm_dq *a, const pmsm_real *b, uint32_t count, pmsm_dq r, pmsm_dq *v,
                                  uint32_t *active, uint32_t *steps)
{
    const half_planes h = {a, b, r};
    pmsm_dq x = r;
    basis set = {{NONE, NONE}};
    for (uint32_t round = 0u; round < 2u * PMSM_PROJECTION_ROUNDS; round++) {
        uint32_t k = 0u;
        pmsm_real worst = beyond(&h, 0u, x);
        for (uint32_t j = 1u; j < count; j++) {
            const pmsm_real g = beyond(&h, j, x);
            k = (g > worst) ? j : k;
            worst = (g > worst) ? g : worst;
        }
        const uint32_t again = (k == set.row[0] || k == set.row[1]) ? 1u : 0u;
        if (worst <= VIOLATION || (again != 0u && worst <= STALL)) {
            *v = x;
            *active = set.row[0];
            return ((set.row[0] != NONE) ? 1u : 0u) + ((set.row[1] != NONE) ? 1u : 0u);
        }
        if (again != 0u || exchange_line(&h, k, &set, &x) == 0u) {
            return PMSM_PROJECTION_EMPTY;
        }
        (*steps)++;
    }
    return PMSM_PROJECTION_EMPTY;
}
