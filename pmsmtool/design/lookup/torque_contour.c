/* SPDX-License-Identifier: MIT */
/* Constant-torque contours. One starts at its point of least current and runs the way |psi| falls; started at the
 * demagnetising end or at i_d = 0 it could end on another branch.
 */
#include "torque_contour.h"

#include <math.h>

#define LOCUS_NODES 40  /* per turn */
#define BORDER_NODES 72 /* per turn */

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

/* Whether one torque lies further out than another: up on side 1, down on side 0. */
static int32_t further(int32_t side, double t, double than)
{
    return side ? t > than : t < than;
}

static void build_locus(pmsm_contours *all)
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
    for (int32_t k = 1; k <= PMSM_LOCUS_RADII; k++) {
        pmsm_border_build(all->plane, r, reach * k / PMSM_LOCUS_RADII, 0, LOCUS_NODES, &ring);
        if (!extremes_on(all->plane, &ring, extreme))
            break;
        for (int32_t side = 0; side < 2; side++) {
            pmsm_locus *to = &all->least[side];
            if (further(side, extreme[side].t, to->at[to->n - 1].t))
                to->at[to->n++] = extreme[side];
        }
    }
    for (int32_t side = 0; side < 2; side++) { /* the domain's own extreme closes the locus */
        pmsm_locus *to = &all->least[side];
        if (further(side, all->bound[side].t, to->at[to->n - 1].t))
            to->at[to->n++] = all->bound[side];
    }
}

/* From a point outside the domain back along the contour to its edge. */
static int32_t back_to_edge(const pmsm_curve *curve, pmsm_point *at)
{
    const double length = 0.25 * PMSM_CONTOUR_STEP * curve->plane->I_max;
    for (int32_t k = 0; k < 2; k++) {
        pmsm_point from = *at, to;
        double before = pmsm_plane_outside(curve->plane, curve->rectangle, &from);
        for (int32_t n = 0; n < PMSM_CONTOUR_NODES; n++) {
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
    for (int32_t n = 0; n < PMSM_CONTOUR_NODES; n++) {
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
static int32_t least_current(const pmsm_contours *all, const pmsm_curve *curve, pmsm_point *at)
{
    const int32_t side = curve->level >= 0.0;
    const pmsm_locus *on = &all->least[side];
    const double T = curve->level;
    const pmsm_point *a, *b;
    double x;
    int32_t k = 1;
    while (k < on->n - 1 && further(side, T, on->at[k].t))
        k++;
    if (on->n < 2) {
        *at = on->at[0];
        return T == 0.0;
    }
    a = &on->at[k - 1];
    b = &on->at[k];
    if (T == b->t || T == a->t) {
        *at = T == b->t ? *b : *a;
        return 1;
    }
    x = (T - a->t) / (b->t - a->t);
    pmsm_plane_at(all->plane, a->d + x * (b->d - a->d), a->q + x * (b->q - a->q), at);
    if (!pmsm_curve_correct(curve, at))
        return 0;
    least_current_near(curve, at, 0.25 * PMSM_CONTOUR_STEP * all->plane->I_max);
    if (pmsm_plane_outside(all->plane, curve->rectangle, at) > 0.0)
        return back_to_edge(curve, at);
    return 1;
}

/* ---- contour --------------------------------------------------------------------------------------- */

void pmsm_contour_trace(pmsm_contour *c, int32_t which, double length)
{
    pmsm_branch *to = &c->side[which];
    to->traced = 1;
    to->rising = 1;
    to->n = 1;
    to->at[0] = c->start;
    while (to->n < PMSM_CONTOUR_NODES) {
        const pmsm_point *from = &to->at[to->n - 1];
        pmsm_point *next = &to->at[to->n];
        if (!pmsm_curve_step(&c->curve, from, length, next))
            return;
        if (pmsm_plane_outside(c->curve.plane, c->curve.rectangle, next) > 0.0) {
            pmsm_point edge;
            if (pmsm_curve_root(&c->curve, PMSM_AT_EDGE, from, next, &edge))
                to->at[to->n++] = edge;
            return;
        }
        to->rising &= next->h >= from->h;
        to->n++;
    }
}

int32_t pmsm_contour_start(const pmsm_contours *all, double T, pmsm_contour *c)
{
    const double length = PMSM_CONTOUR_STEP * all->plane->I_max;
    double tangent[2];
    c->curve = (pmsm_curve){all->plane, &all->border.rectangle, PMSM_CURVE_TORQUE, T, 0.0, 0.0, T};
    c->side[0].traced = c->side[1].traced = 0;
    if (!least_current(all, &c->curve, &c->start))
        return 0;
    if (!(hypot(c->start.t_d, c->start.t_q) > 0.0)) {
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

void pmsm_contours_prepare(const pmsm_plane *plane, pmsm_contours *all)
{
    const pmsm_rectangle rectangle = pmsm_plane_rectangle(plane);
    all->plane = plane;
    pmsm_border_build(plane, &rectangle, plane->I_max, 1, BORDER_NODES, &all->border);
    if (!extremes_on(plane, &all->border, all->bound)) /* no torque anywhere: neither magnet nor saliency */
        for (int32_t side = 0; side < 2; side++)
            pmsm_plane_at(plane, 0.0, 0.0, &all->bound[side]);
    build_locus(all);
}
