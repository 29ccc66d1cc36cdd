/* Current references of least loss over torque x speed x voltage.
 *
 * Constant-torque contours: along t = T* the squared voltage is R^2 h + 2 R w T* + w^2 g with h = |i|^2, g = |psi|^2,
 * so one traced contour per torque (nodes with h and g) serves every speed and voltage: a cell is a scan of products
 * to bracket |v| = V, then Newton in (t, |v|^2) on the machine itself. The contour starts at its point of least
 * current and runs the way |psi| falls; started at the demagnetising end or at i_d = 0 it could end on another branch.
 * Torques beyond the limits of a speed take the nearest torque there is (torque_limits.c).
 */
#include "lookup_table.h"

#include <math.h>
#include <stddef.h>

#define RADII 40             /* of the least-current locus */
#define LOCUS_NODES 40       /* per turn */
#define BORDER_NODES 72      /* per turn */
#define CONTOUR_NODES 160
#define CONTOUR_STEP 0.05    /* of I_max */
#define BINDING 1e-5         /* a limit binds within this, relative */
#define FULL_VOLTAGE 1e-12   /* a node at the limit counts as inside, relative; the stored point is exact to 1e-13 */
#define NEWTON_STEPS 12
#define NEWTON_DONE 4e-15    /* residual of torque and voltage, relative */
#define SAME_TORQUE 1e-10    /* torques that are one, relative to the range of a speed */
#define UNSOLVED 255

typedef struct {             /* least current per torque, one sign of torque */
    int32_t n;
    pmsm_point at[RADII + 2];
} locus;

typedef struct {             /* one side of a torque contour, from its start */
    int32_t n;
    int32_t traced;
    int32_t rising;          /* 1: the current falls nowhere along it, as on every machine but the oddly saturated */
    pmsm_point at[CONTOUR_NODES];
} branch;

typedef struct {
    const pmsm_plane *plane;
    pmsm_border border;
    pmsm_point bound[2];     /* least and largest torque of the domain, whatever the voltage */
    locus least[2];          /* negative, positive torque */
} tables;

typedef struct {
    pmsm_curve curve;
    pmsm_point start;
    double first_length;     /* signed step of side 0 */
    int32_t whole;           /* 1: traced to the edge of the domain, whatever current and flux do */
    branch side[2];
} contour;

/* ---- least current ------------------------------------------------------------------------------- */

static int32_t extremes_on(const pmsm_plane *plane, const pmsm_border *border, pmsm_point extreme[2])
{
    int32_t found = 0;
    for (int32_t k = 0; k < border->n_nodes; k++) {
        const pmsm_point *at = &border->node[k];
        if (!pmsm_on_branch(plane, at))
            continue;
        if (!found || at->t < extreme[0].t)
            extreme[0] = *at;
        if (!found || at->t > extreme[1].t)
            extreme[1] = *at;
        found = 1;
    }
    return found;
}

static void build_locus(tables *all)
{
    const pmsm_rectangle *r = &all->border.rectangle;
    const double corner_d = fmax(-r->d_low, r->d_high), corner_q = fmax(-r->q_low, r->q_high);
    const double reach = fmin(all->plane->I_max, sqrt(corner_d * corner_d + corner_q * corner_q));
    pmsm_border ring;
    pmsm_point extreme[2];
    for (int32_t side = 0; side < 2; side++) {
        all->least[side].n = 1;
        pmsm_plane_at(all->plane, 0.0, 0.0, &all->least[side].at[0]);
    }
    for (int32_t k = 1; k <= RADII; k++) {
        pmsm_border_build(all->plane, r, reach * k / RADII, 0, LOCUS_NODES, &ring);
        if (!extremes_on(all->plane, &ring, extreme))
            break;
        for (int32_t side = 0; side < 2; side++) {
            locus *to = &all->least[side];
            const double sign = side ? 1.0 : -1.0;
            if (sign * extreme[side].t > sign * to->at[to->n - 1].t)
                to->at[to->n++] = extreme[side];
        }
    }
    for (int32_t side = 0; side < 2; side++) { /* the domain's own extreme closes the locus */
        locus *to = &all->least[side];
        const double sign = side ? 1.0 : -1.0;
        if (sign * all->bound[side].t > sign * to->at[to->n - 1].t)
            to->at[to->n++] = all->bound[side];
    }
}

/* From a point outside the domain back along the contour to its edge. */
static int32_t back_to_edge(const pmsm_curve *curve, pmsm_point *at)
{
    const double length = 0.25 * CONTOUR_STEP * curve->plane->I_max;
    for (int32_t k = 0; k < 2; k++) {
        pmsm_point from = *at, to;
        double before = pmsm_plane_outside(curve->plane, curve->rectangle, &from);
        for (int32_t n = 0; n < CONTOUR_NODES; n++) {
            double now;
            if (!pmsm_curve_step(curve, &from, k ? -length : length, &to))
                break;
            now = pmsm_plane_outside(curve->plane, curve->rectangle, &to);
            if (now <= 0.0)
                return pmsm_curve_root(curve, PMSM_AT_EDGE, &from, &to, at);
            if (now > before)
                break;
            before = now;
            from = to;
        }
    }
    return 0;
}

/* Least |i| on the contour near a point of it: bracket the extreme by steps, then the root. */
static void least_current_near(const pmsm_curve *curve, pmsm_point *at, double spacing)
{
    pmsm_point from = *at, to;
    const double slope = pmsm_curve_indicator(curve, PMSM_AT_CURRENT_EXTREME, &from);
    const double length = slope > 0.0 ? -spacing : spacing;
    for (int32_t n = 0; n < CONTOUR_NODES; n++) {
        double now;
        if (!pmsm_curve_step(curve, &from, length, &to))
            return;
        now = pmsm_curve_indicator(curve, PMSM_AT_CURRENT_EXTREME, &to);
        if (now * slope <= 0.0) {
            pmsm_point root;
            if (pmsm_curve_root(curve, PMSM_AT_CURRENT_EXTREME, &from, &to, &root))
                *at = root;
            return;
        }
        from = to;
        if (pmsm_plane_outside(curve->plane, curve->rectangle, &to) > 0.5)
            return;
    }
}

/* Point of least current with torque level T inside the domain. */
static int32_t least_current(const tables *all, const pmsm_curve *curve, pmsm_point *at)
{
    const int32_t side = curve->level >= 0.0;
    const locus *on = &all->least[side];
    const double sign = side ? 1.0 : -1.0, T = sign * curve->level;
    const pmsm_point *a, *b;
    double x;
    int32_t k = 1;
    while (k < on->n - 1 && sign * on->at[k].t < T)
        k++;
    if (on->n < 2) {
        *at = on->at[0];
        return T == 0.0;
    }
    a = &on->at[k - 1];
    b = &on->at[k];
    if (T == sign * b->t || T == sign * a->t) {
        *at = T == sign * b->t ? *b : *a;
        return 1;
    }
    x = (curve->level - a->t) / (b->t - a->t);
    pmsm_plane_at(all->plane, a->d + x * (b->d - a->d), a->q + x * (b->q - a->q), at);
    if (!pmsm_curve_correct(curve, at))
        return 0;
    least_current_near(curve, at, 0.25 * CONTOUR_STEP * all->plane->I_max);
    if (pmsm_plane_outside(all->plane, curve->rectangle, at) > 0.0)
        return back_to_edge(curve, at);
    return 1;
}

/* ---- contour --------------------------------------------------------------------------------------- */

static int32_t still_useful(const contour *c, const pmsm_point *at, double length)
{
    double tangent[2], dh, dg;
    pmsm_curve_tangent(&c->curve, at, tangent);
    dh = length * (at->d * tangent[0] + at->q * tangent[1]);
    dg = length * (at->g_d * tangent[0] + at->g_q * tangent[1]);
    return !(dh > 0.0 && dg > 0.0); /* beyond, current and flux both rise: no speed wants that */
}

static void trace(contour *c, int32_t which, double length)
{
    branch *to = &c->side[which];
    to->traced = 1;
    to->rising = 1;
    to->n = 1;
    to->at[0] = c->start;
    while (to->n < CONTOUR_NODES) {
        const pmsm_point *from = &to->at[to->n - 1];
        pmsm_point *next = &to->at[to->n];
        if (!pmsm_curve_step(&c->curve, from, length, next))
            return;
        if (pmsm_plane_outside(c->curve.plane, c->curve.rectangle, next) > 0.0) {
            pmsm_point edge;
            if (to->n > 1 || pmsm_plane_outside(c->curve.plane, c->curve.rectangle, from) < -1e-12)
                if (pmsm_curve_root(&c->curve, PMSM_AT_EDGE, from, next, &edge)) {
                    to->at[to->n++] = edge;
                }
            return;
        }
        to->rising &= next->h >= from->h;
        to->n++;
        if (!c->whole && !still_useful(c, next, length))
            return;
    }
}

static int32_t start_contour(const tables *all, double T, contour *c)
{
    const double length = CONTOUR_STEP * all->plane->I_max;
    double tangent[2];
    c->curve = (pmsm_curve){all->plane, &all->border.rectangle, PMSM_CURVE_TORQUE, T, 0.0, 0.0, T};
    c->side[0].traced = c->side[1].traced = 0;
    c->whole = 0;
    if (!least_current(all, &c->curve, &c->start))
        return 0;
    if (!(c->start.t_d * c->start.t_d + c->start.t_q * c->start.t_q > 0.0)) {
        c->side[0].traced = c->side[1].traced = 1; /* no torque slope: a machine without magnet at rest */
        c->side[0].n = c->side[1].n = 1;
        c->side[0].rising = c->side[1].rising = 1;
        c->side[0].at[0] = c->side[1].at[0] = c->start;
        return 1;
    }
    pmsm_curve_tangent(&c->curve, &c->start, tangent);
    c->first_length = c->start.g_d * tangent[0] + c->start.g_q * tangent[1] > 0.0 ? -length : length;
    return 1;
}

/* ---- cell ------------------------------------------------------------------------------------------ */

/* Both torque and squared voltage by Newton between two nodes; the bracketed root where that strays. */
static int32_t voltage_point(const pmsm_curve *curve, const pmsm_point *a, const pmsm_point *b, double f_a, double f_b,
                             pmsm_point *at)
{
    const double x = f_a / (f_a - f_b), reach = fabs(b->d - a->d) + fabs(b->q - a->q);
    const double d = a->d + x * (b->d - a->d), q = a->q + x * (b->q - a->q);
    double before = INFINITY;
    pmsm_plane_at(curve->plane, d, q, at);
    for (int32_t k = 0; k < NEWTON_STEPS; k++) {
        double gradient[2], det, e_t, e_v, error;
        e_t = at->t - curve->level;
        e_v = pmsm_voltage_squared(curve->plane, at, curve->omega) - curve->V2;
        error = fabs(e_t) / (sqrt(at->g * at->h) + fabs(curve->level)) + fabs(e_v) / curve->V2;
        if (error <= NEWTON_DONE)
            return 1;
        if (!(error < before))
            break;
        before = error;
        pmsm_voltage_gradient(curve->plane, at, curve->omega, gradient);
        det = at->t_d * gradient[1] - at->t_q * gradient[0];
        if (det == 0.0)
            break;
        pmsm_plane_at(curve->plane, at->d - (gradient[1] * e_t - at->t_q * e_v) / det,
                      at->q - (at->t_d * e_v - gradient[0] * e_t) / det, at);
        if (!(fabs(at->d - d) + fabs(at->q - q) <= reach))
            break;
    }
    if (before <= 16.0 * NEWTON_DONE && fabs(at->d - d) + fabs(at->q - q) <= reach)
        return 1;
    return pmsm_curve_root(curve, PMSM_AT_VOLTAGE, a, b, at);
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

/* First admissible node, or the admissible point between nodes where the voltage is least. */
static int32_t first_admissible(const demand *want, const pmsm_curve *curve, const branch *on, pmsm_point *inside)
{
    int32_t best = 0;
    double least = INFINITY;
    for (int32_t k = 0; k < on->n; k++) {
        const double f = excess(want, &on->at[k]);
        if (f <= FULL_VOLTAGE * want->V2)
            return k;
        if (f < least) {
            least = f;
            best = k;
        }
    }
    {
        const pmsm_point *a = &on->at[best > 0 ? best - 1 : 0];
        const pmsm_point *b = &on->at[best < on->n - 1 ? best + 1 : on->n - 1];
        if (a != b && pmsm_curve_root(curve, PMSM_AT_VOLTAGE_EXTREME, a, b, inside)
            && excess(want, inside) <= FULL_VOLTAGE * want->V2) {
            const double side = (inside->d - on->at[best].d) * (b->d - a->d) + (inside->q - on->at[best].q) * (b->q - a->q);
            return -1 - (side > 0.0 ? best : (best > 0 ? best - 1 : 0)); /* lies behind that node */
        }
    }
    return CONTOUR_NODES;
}

/* With iron loss the least total loss lies further along the admissible part of the contour. */
static void least_loss(const demand *want, const pmsm_curve *curve, const branch *on, int32_t from, pmsm_point *at)
{
    pmsm_point a = *at, b;
    double loss = pmsm_plane_loss(want->plane, at, want->omega);
    for (int32_t k = from; k < on->n; k++) {
        const double next = pmsm_plane_loss(want->plane, &on->at[k], want->omega);
        if (excess(want, &on->at[k]) > FULL_VOLTAGE * want->V2)
            break;
        b = on->at[k];
        if (next >= loss) {
            pmsm_point root;
            if (pmsm_curve_root(curve, PMSM_AT_LOSS_EXTREME, &a, &b, &root)
                && pmsm_plane_loss(want->plane, &root, want->omega) <= loss
                && excess(want, &root) <= FULL_VOLTAGE * want->V2)
                *at = root;
            return;
        }
        a = *at; /* the minimum lies between the last but one node and the next */
        *at = b;
        loss = next;
    }
    {
        pmsm_point root;
        if (pmsm_curve_root(curve, PMSM_AT_LOSS_EXTREME, &a, at, &root)
            && pmsm_plane_loss(want->plane, &root, want->omega) <= loss)
            *at = root;
    }
}

/* The least current of all admissible points of a side: minima and ends of its admissible parts. *at is admissible and
 * to be beaten when have is 1; returns whether there is one. */
static int32_t least_of_all(const demand *want, const pmsm_curve *curve, const branch *on, int32_t from, int32_t have,
                            pmsm_point *at)
{
    const double slack = FULL_VOLTAGE * want->V2;
    pmsm_point a = have ? *at : on->at[from - 1], best = a, found;
    if (!have)
        have = excess(want, &a) <= slack;
    for (int32_t k = from; k < on->n; k++) {
        const pmsm_point *b = &on->at[k];
        const double f_a = excess(want, &a), f_b = excess(want, b);
        const int32_t a_in = f_a <= slack, b_in = f_b <= slack;
        if (a_in != b_in ? voltage_point(curve, &a, b, f_a, f_b, &found)
                         : a_in && pmsm_curve_root(curve, PMSM_AT_CURRENT_EXTREME, &a, b, &found))
            if ((!have || found.h < best.h) && excess(want, &found) <= slack) {
                best = found;
                have = 1;
            }
        if (b_in && (!have || b->h < best.h)) {
            best = *b;
            have = 1;
        }
        a = *b;
    }
    if (have)
        *at = best;
    return have;
}

/* Least loss on one side of the contour; 0 when no point of it is admissible. */
static int32_t solve_side(const demand *want, pmsm_curve *curve, const branch *on, pmsm_point *at)
{
    pmsm_point inside;
    int32_t k = first_admissible(want, curve, on, &inside);
    if (k == CONTOUR_NODES)
        return 0;
    if (k == 0) {
        *at = on->at[0];
        k = 1;
    } else {
        const int32_t behind = k < 0 ? -1 - k : k - 1;
        const pmsm_point *a = &on->at[behind], *b = k < 0 ? &inside : &on->at[k];
        const double f_a = excess(want, a), f_b = excess(want, b);
        if (!(f_b < 0.0))
            *at = *b;
        else if (!voltage_point(curve, a, b, f_a, f_b, at))
            return 0;
        k = behind + 1;
    }
    if (want->plane->loss)
        least_loss(want, curve, on, k, at);
    else if (!on->rising)
        (void)least_of_all(want, curve, on, k, 1, at);
    return 1;
}

static int32_t solve_cell(contour *c, const pmsm_plane *plane, double omega, double V, pmsm_point *at)
{
    demand want = {plane, omega, V * V, plane->R * plane->R, omega * omega, 0.0};
    want.room = want.V2 - 2.0 * plane->R * omega * c->curve.level;
    c->curve.omega = omega;
    c->curve.V2 = want.V2;
    for (int32_t side = 0; side < 2; side++) {
        if (!c->side[side].traced)
            trace(c, side, side ? -c->first_length : c->first_length);
        if (solve_side(&want, &c->curve, &c->side[side], at))
            return 1;
    }
    return 0;
}

/* On an oddly saturated machine the contour may leave the domain and come back, or flux and current may rise and fall
 * again. Torque has no extreme inside, so every part of a contour ends on the border: all of them, from there. */
static int32_t solve_everywhere(const tables *all, double T, double omega, double V, pmsm_point *at)
{
    contour c;
    demand want = {all->plane, omega, V * V, all->plane->R * all->plane->R, omega * omega, 0.0};
    int32_t have = 0;
    want.room = want.V2 - 2.0 * all->plane->R * omega * T;
    c.curve = (pmsm_curve){all->plane, &all->border.rectangle, PMSM_CURVE_TORQUE, T, omega, V * V, T};
    c.whole = 1;
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
                pmsm_point found;
                trace(&c, side, (side ? -CONTOUR_STEP : CONTOUR_STEP) * all->plane->I_max);
                if (least_of_all(&want, &c.curve, &c.side[side], 1, 0, &found) && pmsm_on_branch(all->plane, &found)
                    && (!have || found.h < at->h)) {
                    *at = found;
                    have = 1;
                }
            }
        }
    }
    return have;
}

static uint8_t touched(const tables *all, const pmsm_point *at, double omega, double V)
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

static void store(const tables *all, output *out, ptrdiff_t cell, const pmsm_point *at, double omega, double V,
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
static int32_t at_the_limit(const tables *all, double torque, const double *e, pmsm_point *at)
{
    const double *nearest = torque - e[0] < e[3] - torque ? e : e + 3;
    if (fabs(torque - nearest[0]) > SAME_TORQUE * (e[3] - e[0]))
        return 0;
    pmsm_plane_at(all->plane, nearest[1], nearest[2], at);
    return 1;
}

static void solve_row(const tables *all, double torque, ptrdiff_t row, contour *c, output *out)
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
                    started = start_contour(all, T, c) ? 1 : -1;
                if (started > 0 && solve_cell(c, all->plane, out->omega[w], out->V[v], &at))
                    store(all, out, cell, &at, out->omega[w], out->V[v], 0);
                else if (at_the_limit(all, torque, e, &at) || solve_everywhere(all, T, out->omega[w], out->V[v], &at))
                    store(all, out, cell, &at, out->omega[w], out->V[v], 0);
                else
                    store_nothing(out, cell, UNSOLVED);
            }
        }
}

static void limits_of_speeds(const tables *all, int32_t n_w, const double *omega, int32_t n_V, const double *V,
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
    tables all;
    contour c;
    output out = {n_w, n_V, omega, V, i_d, i_q, achieved, limits, extreme, 0};
    const pmsm_rectangle rectangle = pmsm_plane_rectangle(plane);
    all.plane = plane;
    pmsm_border_build(plane, &rectangle, plane->I_max, 1, BORDER_NODES, &all.border);
    if (!extremes_on(plane, &all.border, all.bound)) /* no torque anywhere: a constant machine without magnet or saliency */
        for (int32_t side = 0; side < 2; side++)
            pmsm_plane_at(plane, 0.0, 0.0, &all.bound[side]);
    build_locus(&all);
    limits_of_speeds(&all, n_w, omega, n_V, V, extreme);
    for (int32_t k = 0; k < n_T; k++)
        solve_row(&all, torque[k], k, &c, &out);
    return out.unsolved;
}

uint32_t pmsm_plane_size(void)
{
    return (uint32_t)sizeof(pmsm_plane);
}
