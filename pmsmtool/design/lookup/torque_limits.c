/* SPDX-License-Identifier: MIT */
/* Least and largest torque of the domain under a voltage limit.
 *
 * Torque has no extreme inside the plane, so the limits lie on the border of the admissible set: on an arc of the
 * domain's border where the voltage suffices (MTPA end, MTPVA corner, demagnetisation, edge of the map) or on the
 * voltage limit inside the domain (MTPV). The set may be a lens that touches the border, or lie wholly inside.
 */
#include "current_plane.h"

#include <math.h>
#include <stddef.h>

#define TRACE_STEP 0.04   /* of I_max, along the voltage limit */
#define CLOSED_STEP 0.5   /* of the way from the centre: no step along a flat side passes two extremes of the torque */
#define TRACE_STEPS 2000
#define FULL_TURN 6.2831853071795865
#define ON_BORDER 1e-12   /* of I_max: a point on the domain's border */
#define SHORT_CIRCUIT_STEPS 60
#define SHORT_CIRCUIT 1e-20 /* squared voltage taken as zero, relative to the limit */

typedef struct {
    const pmsm_plane *plane;
    const pmsm_border *border;
    double omega, V2;
    pmsm_curve limit;      /* |v|^2 = V2 */
    pmsm_point *extreme;   /* least, largest torque */
    int32_t found;
    int32_t crossings;       /* of border and voltage limit */
    int32_t outside;         /* border nodes above the limit */
} search;

static void consider(search *run, const pmsm_point *at)
{
    const int32_t less = !run->found || at->t < run->extreme[0].t;
    const int32_t more = !run->found || at->t > run->extreme[1].t;
    if (!(less || more) || !pmsm_on_branch(run->plane, at))
        return;
    if (less)
        run->extreme[0] = *at;
    if (more)
        run->extreme[1] = *at;
    run->found = 1;
}

/* Follow the voltage limit along its tangent until it leaves the domain or has gone round `centre`; every extreme of
 * the torque on the way is a candidate (a machine with strong saliency has more than one of a kind). */
static void follow(search *run, const pmsm_point *start, const pmsm_point *centre)
{
    const double across = centre ? hypot(start->d - centre->d, start->q - centre->q) : (double)INFINITY;
    const double length = fmin(TRACE_STEP * run->plane->I_max, CLOSED_STEP * across);
    pmsm_point from = *start, to, top;
    double turned = 0.0;
    for (int32_t k = 0; k < TRACE_STEPS && fabs(turned) < FULL_TURN; k++) {
        int32_t leaving;
        if (!pmsm_curve_step(&run->limit, &from, length, &to))
            return;
        leaving = k > 0 && pmsm_plane_outside(run->plane, &run->border->rectangle, &to) > 0.0;
        if (leaving) {
            const pmsm_point beyond = to;
            if (!pmsm_curve_root(&run->limit, PMSM_AT_EDGE, &from, &beyond, &to))
                return;
        }
        if (pmsm_curve_root(&run->limit, PMSM_AT_TORQUE_EXTREME, &from, &to, &top)
            && pmsm_plane_outside(run->plane, &run->border->rectangle, &top) <= ON_BORDER)
            consider(run, &top);
        if (leaving)
            return; /* the border crossing is a candidate of its own */
        if (centre) {
            const double a = from.d - centre->d, b = from.q - centre->q, c = to.d - centre->d, d = to.q - centre->q;
            turned += atan2(a * d - b * c, a * c + b * d);
        }
        from = to;
    }
}

/* Whether the voltage limit runs into the domain from a border point; the limits may touch, hence three lengths. */
static int32_t enters(const search *run, const pmsm_point *at)
{
    static const double nudge[3] = {1e-6, 1e-4, 1e-2}; /* of I_max */
    for (int32_t k = 0; k < 3; k++) {
        pmsm_point near;
        if (pmsm_curve_step(&run->limit, at, nudge[k] * run->plane->I_max, &near)
            && pmsm_plane_outside(run->plane, &run->border->rectangle, &near) < 0.0)
            return 1;
    }
    return 0;
}

/* A crossing of border and voltage limit: a candidate, and where the limit enters the domain. */
static void cross(search *run, const pmsm_point *at)
{
    run->crossings++;
    consider(run, at);
    if (enters(run, at)) /* along the tangent; the arc's other end is entered against it */
        follow(run, at, NULL);
}

static void root_on_piece(search *run, const pmsm_curve *curve, double s_a, double s_b)
{
    double s;
    pmsm_point at;
    if (pmsm_curve_root_between(curve, PMSM_AT_VOLTAGE, s_a, s_b, &s, &at))
        cross(run, &at);
}

/* Two neighbouring nodes on the same side of the limit with an extreme of the voltage between them that may lie on the
 * other: an admissible arc, or a gap in one, hides there. */
static void hidden_arc(search *run, const pmsm_curve *curve, double s_a, double s_b, int32_t ends_admissible)
{
    double s;
    pmsm_point at;
    int32_t admissible;
    if (!pmsm_curve_root_between(curve, PMSM_AT_VOLTAGE_EXTREME, s_a, s_b, &s, &at))
        return;
    admissible = pmsm_curve_indicator(curve, PMSM_AT_VOLTAGE, &at) <= 0.0;
    if (admissible == ends_admissible)
        return;
    if (admissible)
        consider(run, &at);
    root_on_piece(run, curve, s_a, s);
    root_on_piece(run, curve, s, s_b);
}

static void scan_piece(search *run, const pmsm_piece *piece)
{
    pmsm_curve curve = piece->curve;
    const double *s = run->border->s + piece->first;
    const pmsm_point *node = run->border->node + piece->first;
    double slope = 0.0;
    int32_t admissible = 0;
    curve.omega = run->omega;
    curve.V2 = run->V2;
    for (int32_t k = 0; k < piece->count; k++) {
        const int32_t before = admissible;
        const double slope_before = slope;
        admissible = pmsm_curve_indicator(&curve, PMSM_AT_VOLTAGE, &node[k]) <= 0.0;
        slope = pmsm_curve_indicator(&curve, PMSM_AT_VOLTAGE_EXTREME, &node[k]);
        if (admissible)
            consider(run, &node[k]);
        else
            run->outside++;
        if (k == 0)
            continue;
        if (admissible != before)
            root_on_piece(run, &curve, s[k - 1], s[k]);
        else if (admissible ? slope_before > 0.0 && slope < 0.0 : slope_before < 0.0 && slope > 0.0)
            hidden_arc(run, &curve, s[k - 1], s[k], admissible);
    }
}

/* The short-circuit current, where the steady-state voltage is zero, by damped Newton from the border point of
 * least voltage; 1 when it is found inside the domain. */
static int32_t short_circuit(const search *run, pmsm_point *at)
{
    const double R = run->plane->R, w = run->omega;
    double least = INFINITY;
    for (int32_t k = 0; k < run->border->n_nodes; k++) {
        const double v2 = pmsm_voltage_squared(run->plane, &run->border->node[k], w);
        if (v2 < least) {
            least = v2;
            *at = run->border->node[k];
        }
    }
    for (int32_t k = 0; k < SHORT_CIRCUIT_STEPS && least > SHORT_CIRCUIT * run->V2; k++) {
        double psi[2], jac[4], step_d, step_q, det, v2 = INFINITY;
        pmsm_point trial = *at;
        pmsm_plane_flux(run->plane, at->d, at->q, psi, jac);
        { /* v_d = R i_d - w psi_q, v_q = R i_q + w psi_d */
            const double v_d = R * at->d - w * psi[1], v_q = R * at->q + w * psi[0];
            const double a = R - w * jac[2], b = -w * jac[3], c = w * jac[0], d = R + w * jac[1];
            det = a * d - b * c;
            step_d = (d * v_d - b * v_q) / det;
            step_q = (a * v_q - c * v_d) / det;
        }
        if (!(det > 0.0))
            return 0;
        for (double share = 1.0; share > 1e-6 && !(v2 < least); share *= 0.5) {
            pmsm_plane_at(run->plane, at->d - share * step_d, at->q - share * step_q, &trial);
            v2 = pmsm_voltage_squared(run->plane, &trial, w);
        }
        if (!(v2 < least))
            break;
        least = v2;
        *at = trial;
    }
    return least < run->V2 && pmsm_plane_outside(run->plane, &run->border->rectangle, at) < 0.0;
}

/* The voltage limit closed inside the domain: start above the short-circuit current and follow it once round. */
static void closed_limit(search *run)
{
    const double I2 = run->plane->I_max * run->plane->I_max;
    pmsm_curve up = run->limit;
    pmsm_point centre, start;
    double s, top;
    if (!short_circuit(run, &centre))
        return;
    up.kind = PMSM_CURVE_VERTICAL;
    up.level = centre.d;
    top = fmin(sqrt(I2 - centre.d * centre.d), run->border->rectangle.q_high);
    if (!pmsm_curve_root_between(&up, PMSM_AT_VOLTAGE, centre.q, top, &s, &start))
        return;
    consider(run, &start);
    follow(run, &start, &centre);
}

int32_t pmsm_torque_limits(const pmsm_plane *plane, const pmsm_border *border, double omega, double V,
                           pmsm_point extreme[2])
{
    search run = {plane, border, omega, V * V, {plane, &border->rectangle, PMSM_CURVE_VOLTAGE, V * V, omega, V * V, 0.0},
                  extreme, 0, 0, 0};
    for (int32_t k = 0; k < border->n_pieces; k++)
        scan_piece(&run, &border->piece[k]);
    if (run.crossings == 0 && run.outside > 0)
        closed_limit(&run); /* border all above the limit, or touched by it in a point */
    return run.found;
}
