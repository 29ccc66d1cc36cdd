/* SPDX-License-Identifier: MIT */
/* Current references of least loss over torque x speed x voltage.
 *
 * Constant-torque contours: along t = T* the squared voltage is R^2 h + 2 R w T* + w^2 g with h = |i|^2, g = |psi|^2,
 * so one traced contour per torque (nodes with h and g) serves every speed and voltage: a cell is a scan of products
 * to bracket |v| = V, then Newton in (t, |v|^2) on the machine itself.
 * Torques beyond the limits of a speed take the nearest torque there is (torque_limits.c).
 */
#include "lookup_table.h"

#include "torque_contour.h"

#include <math.h>
#include <stddef.h>

#define BINDING 1e-5         /* a limit binds within this, relative */
#define FULL_VOLTAGE 1e-12   /* a node at the limit counts as inside, relative; the stored point is exact to 1e-13 */
#define NEARLY_FULL 0.02     /* squared voltage above the limit that a measured map may feign, relative */
#define NEWTON_STEPS 12
#define NEWTON_DONE 4e-15    /* residual of torque and voltage, relative */
#define SAME_TORQUE 1e-10    /* torques that are one, relative to the range of a speed */
#define UNSOLVED 255

/* ---- cell ------------------------------------------------------------------------------------------ */

/* Whether a point of a short piece of a contour lies between its ends. */
static int32_t between(const pmsm_point *a, const pmsm_point *b, const pmsm_point *at)
{
    const double d = b->d - a->d, q = b->q - a->q, along = (at->d - a->d) * d + (at->q - a->q) * q;
    return along >= 0.0 && along <= d * d + q * q;
}

/* Both torque and squared voltage by Newton between two nodes; the bracketed root where that strays, or finds the far
 * end of an admissible arc, which lies beyond them. */
static int32_t voltage_point(const pmsm_curve *curve, const pmsm_point *a, const pmsm_point *b, double f_a, double f_b,
                             pmsm_point *at)
{
    const double x = f_a / (f_a - f_b), reach = fabs(b->d - a->d) + fabs(b->q - a->q);
    const double d = a->d + x * (b->d - a->d), q = a->q + x * (b->q - a->q);
    double before = INFINITY, error = INFINITY;
    pmsm_plane_at(curve->plane, d, q, at);
    for (int32_t k = 0; k < NEWTON_STEPS && fabs(at->d - d) + fabs(at->q - q) <= reach; k++) {
        const double e_t = at->t - curve->level;
        const double e_v = pmsm_voltage_squared(curve->plane, at, curve->omega) - curve->V2;
        double gradient[2], det;
        error = fabs(e_t) / (sqrt(at->g * at->h) + fabs(curve->level)) + fabs(e_v) / curve->V2;
        if (error <= NEWTON_DONE || !(error < before))
            break;
        before = error;
        pmsm_voltage_gradient(curve->plane, at, curve->omega, gradient);
        det = at->t_d * gradient[1] - at->t_q * gradient[0];
        if (det == 0.0)
            break;
        pmsm_plane_at(curve->plane, at->d - (gradient[1] * e_t - at->t_q * e_v) / det,
                      at->q - (at->t_d * e_v - gradient[0] * e_t) / det, at);
    }
    return (error <= 16.0 * NEWTON_DONE && between(a, b, at)) || pmsm_curve_root(curve, PMSM_AT_VOLTAGE, a, b, at);
}

typedef struct {
    const pmsm_plane *plane;
    double omega, V2;
    double R2, w2, room; /* |v|^2 <= V^2 is R2 h + w2 g <= room on the contour */
} demand;

static double excess(const demand *want, const pmsm_point *at)
{
    return want->R2 * at->h + want->w2 * at->g - want->room;
}

static int32_t admissible(const demand *want, const pmsm_point *at)
{
    return excess(want, at) <= FULL_VOLTAGE * want->V2;
}

/* An admissible arc between two nodes: its point of least voltage. */
static int32_t arc_between(const demand *want, const pmsm_curve *curve, const pmsm_point *a, const pmsm_point *b,
                           pmsm_point *inside)
{
    return pmsm_curve_root(curve, PMSM_AT_VOLTAGE_EXTREME, a, b, inside) && admissible(want, inside);
}

/* The first admissible part of a side begins between the node returned and *inside; -1: at the start of the side,
 * PMSM_CONTOUR_NODES: there is none. *next: the first node after *inside. */
static int32_t first_admissible(const demand *want, const pmsm_curve *curve, const pmsm_branch *on, pmsm_point *inside,
                                int32_t *next)
{
    double before = INFINITY, f = excess(want, &on->at[0]);
    for (int32_t k = 0; k < on->n; k++) {
        const pmsm_point *at = &on->at[k];
        const int32_t touches = f <= FULL_VOLTAGE * want->V2;
        double after = INFINITY;
        *next = k + 1;
        *inside = *at;
        if (f < 0.0)
            return k - 1;
        if (k + 1 < on->n)
            after = excess(want, at + 1);
        if (touches || (f <= before && f <= after)) { /* an arc between nodes shows as a least node beside it */
            if (k > 0 && arc_between(want, curve, at - 1, at, inside)) {
                *next = k;
                return k - 1;
            }
            if (touches) {
                *inside = *at;
                return k - 1;
            }
            if (k + 1 < on->n && arc_between(want, curve, at, at + 1, inside))
                return k;
        }
        before = f;
        f = after;
    }
    return PMSM_CONTOUR_NODES;
}

/* With iron loss the least total loss lies further along the admissible part of the contour: from *at by *b to the
 * nodes that follow, or to the far end of that part. */
static void least_loss(const demand *want, const pmsm_curve *curve, const pmsm_branch *on, const pmsm_point *b,
                       int32_t next, pmsm_point *at)
{
    pmsm_point a = *at, from = *at, to = *at, root;
    int32_t inside = 1;
    double loss = pmsm_plane_loss(want->plane, at, want->omega);
    for (;; b = &on->at[next++]) {
        double ahead;
        inside = admissible(want, b);
        if (!inside && !voltage_point(curve, b, &from, excess(want, b), excess(want, &from), &to))
            break;
        if (inside)
            to = *b;
        ahead = pmsm_plane_loss(want->plane, &to, want->omega);
        if (ahead < loss) {
            a = from; /* the minimum lies between the last but one point and the next */
            *at = to;
            loss = ahead;
        }
        if (ahead > loss || !inside || next >= on->n)
            break;
        from = to;
    }
    if (pmsm_curve_root(curve, PMSM_AT_LOSS_EXTREME, &a, &to, &root)
        && pmsm_plane_loss(want->plane, &root, want->omega) <= loss && admissible(want, &root))
        *at = root;
}

typedef struct {
    pmsm_point at;
    int32_t have;
} least_found;

static void consider(least_found *best, const pmsm_point *at)
{
    if (!best->have || at->h < best->at.h)
        best->at = *at;
    best->have = 1;
}

/* The least current between two points of a contour: ends and minima of the admissible part of that piece. */
static void least_between(const demand *want, const pmsm_curve *curve, const pmsm_point *a, const pmsm_point *b,
                          least_found *best)
{
    const int32_t a_in = admissible(want, a), b_in = admissible(want, b);
    pmsm_point end, least;
    if (!a_in && !b_in) {
        pmsm_point inside;
        if (arc_between(want, curve, a, b, &inside)) {
            least_between(want, curve, a, &inside, best);
            least_between(want, curve, &inside, b, best);
        }
        return;
    }
    if (b_in)
        consider(best, b);
    if (a_in != b_in && voltage_point(curve, a, b, excess(want, a), excess(want, b), &end) && admissible(want, &end)) {
        consider(best, &end);
        if (a_in)
            b = &end;
        else
            a = &end;
    }
    if (pmsm_curve_root(curve, PMSM_AT_CURRENT_EXTREME, a, b, &least) && admissible(want, &least))
        consider(best, &least);
}

/* Least loss on one side of the contour; 0 when no point of it is admissible. */
static int32_t solve_side(const demand *want, pmsm_curve *curve, const pmsm_branch *on, pmsm_point *at)
{
    pmsm_point inside;
    int32_t next;
    const int32_t behind = first_admissible(want, curve, on, &inside, &next);
    if (behind == PMSM_CONTOUR_NODES)
        return 0;
    *at = inside;
    if (behind >= 0) {
        const double f_a = excess(want, &on->at[behind]), f_b = excess(want, &inside);
        if (f_b < 0.0 && !voltage_point(curve, &on->at[behind], &inside, f_a, f_b, at))
            return 0;
    }
    if (want->plane->loss) {
        least_loss(want, curve, on, &inside, next, at);
    } else if (!on->rising) {
        least_found best = {*at, 1};
        for (const pmsm_point *a = &inside; next < on->n; a = &on->at[next++])
            least_between(want, curve, a, &on->at[next], &best);
        *at = best.at;
    }
    return 1;
}

static int32_t solve_cell(pmsm_contour *c, const pmsm_plane *plane, double omega, double V, pmsm_point *at)
{
    demand want = {plane, omega, V * V, plane->R * plane->R, omega * omega, 0.0};
    want.room = want.V2 - 2.0 * plane->R * omega * c->curve.level;
    c->curve.omega = omega;
    c->curve.V2 = want.V2;
    for (int32_t side = 0; side < 2; side++) {
        if (!c->side[side].traced)
            pmsm_contour_trace(c, side, side ? -c->first_length : c->first_length);
        if (solve_side(&want, &c->curve, &c->side[side], at))
            return 1;
    }
    return 0;
}

/* On an oddly saturated machine the contour may leave the domain and come back, or flux and current may rise and fall
 * again. Torque has no extreme inside, so every part of a contour ends on the border: all of them, from there. Where
 * fluxes waver, torques between two that the voltage allows may need a little more of it: the point of the least. */
static int32_t solve_everywhere(const pmsm_contours *all, double T, double omega, double V, pmsm_point *at)
{
    pmsm_contour c;
    pmsm_point nearest;
    demand want = {all->plane, omega, V * V, all->plane->R * all->plane->R, omega * omega, 0.0};
    double over = NEARLY_FULL * want.V2;
    int32_t have = 0, nearly = 0;
    want.room = want.V2 - 2.0 * all->plane->R * omega * T;
    c.curve = (pmsm_curve){all->plane, &all->border.rectangle, PMSM_CURVE_TORQUE, T, omega, V * V, T};
    for (int32_t p = 0; p < all->border.n_pieces; p++) {
        const pmsm_piece *piece = &all->border.piece[p];
        pmsm_curve along = piece->curve;
        along.T = T;
        for (int32_t k = piece->first + 1; k < piece->first + piece->count; k++) {
            const pmsm_point *a = &all->border.node[k - 1], *b = &all->border.node[k];
            double s;
            if ((a->t > T) == (b->t > T)
                || !pmsm_curve_root_between(&along, PMSM_AT_TORQUE, all->border.s[k - 1], all->border.s[k], &s, &c.start))
                continue;
            for (int32_t side = 0; side < 2; side++) {
                const pmsm_branch *on = &c.side[side];
                least_found best = {c.start, 0};
                pmsm_contour_trace(&c, side, (side ? -PMSM_CONTOUR_STEP : PMSM_CONTOUR_STEP) * all->plane->I_max);
                if (admissible(&want, &c.start))
                    consider(&best, &c.start);
                for (int32_t n = 1; n < on->n; n++)
                    least_between(&want, &c.curve, &on->at[n - 1], &on->at[n], &best);
                for (int32_t n = 0; n < on->n; n++)
                    if (excess(&want, &on->at[n]) < over && pmsm_on_branch(all->plane, &on->at[n])) {
                        over = excess(&want, &on->at[n]);
                        nearest = on->at[n];
                        nearly = 1;
                    }
                if (best.have && pmsm_on_branch(all->plane, &best.at) && (!have || best.at.h < at->h)) {
                    *at = best.at;
                    have = 1;
                }
            }
        }
    }
    if (!have && nearly)
        *at = nearest;
    return have || nearly;
}

static uint8_t touched(const pmsm_contours *all, const pmsm_point *at, double omega, double V)
{
    const pmsm_rectangle *r = &all->border.rectangle;
    const double slack = BINDING * all->plane->I_max;
    int32_t bits = 0;
    if (at->h >= (1.0 - 2.0 * BINDING) * all->plane->I_max * all->plane->I_max)
        bits |= PMSM_LIMIT_CURRENT;
    if (pmsm_voltage_squared(all->plane, at, omega) >= (1.0 - 2.0 * BINDING) * V * V)
        bits |= PMSM_LIMIT_VOLTAGE;
    if (at->d <= r->d_low + slack)
        bits |= r->d_low_limit;
    if (at->d >= r->d_high - slack || at->q <= r->q_low + slack || at->q >= r->q_high - slack)
        bits |= PMSM_LIMIT_MAP;
    return (uint8_t)bits;
}

typedef struct {
    int32_t n_w, n_V;
    const double *omega, *V;
    double *i_d, *i_q, *achieved;
    uint8_t *limits;
    const double *extreme;
    int32_t unsolved;
} output;

static void store(const pmsm_contours *all, output *out, ptrdiff_t cell, const pmsm_point *at, double omega, double V,
                  int32_t extra)
{
    out->i_d[cell] = at->d;
    out->i_q[cell] = at->q;
    out->achieved[cell] = 1.5 * all->plane->pole_pairs * at->t;
    out->limits[cell] = (uint8_t)(touched(all, at, omega, V) | extra);
}

static void store_nothing(output *out, ptrdiff_t cell, uint8_t why)
{
    out->i_d[cell] = out->i_q[cell] = out->achieved[cell] = (double)NAN;
    out->limits[cell] = why;
    out->unsolved += why == UNSOLVED;
}

/* Within rounding of the largest torque the contour is a point: that of the limit. */
static int32_t at_the_limit(const pmsm_contours *all, double torque, const double *e, pmsm_point *at)
{
    const double *nearest = torque - e[0] < e[3] - torque ? e : e + 3;
    if (fabs(torque - nearest[0]) > SAME_TORQUE * (e[3] - e[0]))
        return 0;
    pmsm_plane_at(all->plane, nearest[1], nearest[2], at);
    return 1;
}

static void solve_row(const pmsm_contours *all, double torque, ptrdiff_t row, pmsm_contour *c, output *out)
{
    const double scale = 1.5 * all->plane->pole_pairs, T = torque / scale;
    int32_t started = 0;
    for (int32_t w = 0; w < out->n_w; w++)
        for (int32_t v = 0; v < out->n_V; v++) {
            const ptrdiff_t at_speed = (ptrdiff_t)w * out->n_V + v, cell = row * out->n_w * out->n_V + at_speed;
            const double *e = out->extreme + 6 * at_speed;
            pmsm_point at;
            if (isnan(e[0])) {
                store_nothing(out, cell, PMSM_LIMIT_NONE);
            } else if (torque <= e[0] || torque >= e[3]) {
                const double *nearest = torque <= e[0] ? e : e + 3;
                pmsm_plane_at(all->plane, nearest[1], nearest[2], &at);
                store(all, out, cell, &at, out->omega[w], out->V[v],
                      torque == nearest[0] ? 0 : PMSM_LIMIT_TORQUE_CUT);
            } else {
                if (!started)
                    started = pmsm_contour_start(all, T, c) ? 1 : -1;
                if (started > 0 && solve_cell(c, all->plane, out->omega[w], out->V[v], &at))
                    store(all, out, cell, &at, out->omega[w], out->V[v], 0);
                else if (at_the_limit(all, torque, e, &at) || solve_everywhere(all, T, out->omega[w], out->V[v], &at))
                    store(all, out, cell, &at, out->omega[w], out->V[v], 0);
                else
                    store_nothing(out, cell, UNSOLVED);
            }
        }
}

static void limits_of_speeds(const pmsm_contours *all, int32_t n_w, const double *omega, int32_t n_V, const double *V,
                             double *extreme)
{
    const double scale = 1.5 * all->plane->pole_pairs;
    for (int32_t w = 0; w < n_w; w++)
        for (int32_t v = 0; v < n_V; v++) {
            double *e = extreme + 6 * ((ptrdiff_t)w * n_V + v);
            pmsm_point at[2];
            const int32_t found = pmsm_torque_limits(all->plane, &all->border, omega[w], V[v], at);
            for (int32_t k = 0; k < 6; k++)
                e[k] = (double)NAN;
            for (int32_t side = 0; found && side < 2; side++) {
                e[3 * side] = scale * at[side].t;
                e[3 * side + 1] = at[side].d;
                e[3 * side + 2] = at[side].q;
            }
        }
}

int32_t pmsm_lookup_table(const pmsm_plane *plane, int32_t n_T, const double *torque, int32_t n_w, const double *omega,
                          int32_t n_V, const double *V, double *i_d, double *i_q, double *achieved, uint8_t *limits,
                          double *extreme)
{
    pmsm_contours all;
    pmsm_contour c;
    output out = {n_w, n_V, omega, V, i_d, i_q, achieved, limits, extreme, 0};
    pmsm_contours_prepare(plane, &all);
    limits_of_speeds(&all, n_w, omega, n_V, V, extreme);
    for (int32_t k = 0; k < n_T; k++)
        solve_row(&all, torque[k], k, &c, &out);
    return out.unsolved;
}

uint32_t pmsm_plane_size(void)
{
    return (uint32_t)sizeof(pmsm_plane);
}
