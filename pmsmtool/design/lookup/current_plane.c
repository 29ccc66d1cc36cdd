/* SPDX-License-Identifier: MIT */
/* Points and curves of the current plane; see current_plane.h. */
#include "current_plane.h"

#include <math.h>
#include <stddef.h>

#define CORRECTIONS_MAX 25  /* Newton steps onto a level curve: quadratic, 3 to 5 seen */
#define CORRECTED 2e-15     /* level error taken as zero, relative to the size of the terms */
#define ROOT_STEPS_MAX 100  /* of the bracketed secant */
#define ROOT_FLOOR 1e-16    /* indicator taken as zero, relative to its ends */
#define ROOT_MOVED 1e-14    /* two iterates that are one, relative to the bracket */
#define STEP_HALVINGS 24    /* of a step along a curve */
#define TURN_COSINE 0.94    /* a step may turn the tangent by 20 degrees */
#define STEP_FORWARD 0.5    /* and must get so far, of its length: a correction may throw a long one back */
#define EDGE_NODES 18       /* of one side of the rectangle */
#define HALF_PI 1.57079632679489661923

static double square(double a)
{
    return a * a;
}

void pmsm_plane_flux(const pmsm_plane *plane, double d, double q, double psi[2], double jac[4])
{
    if (plane->map) {
        (void)pmsm_flux_map_flux(plane->map, d, q, psi, jac); /* the domain is inside the map */
        psi[0] += plane->psi_shift;
    } else {
        psi[0] = plane->psi_f + plane->psi_shift + plane->L_d * d;
        psi[1] = plane->L_q * q;
        jac[0] = plane->L_d;
        jac[1] = 0.0;
        jac[2] = 0.0;
        jac[3] = plane->L_q;
    }
}

void pmsm_plane_at(const pmsm_plane *plane, double d, double q, pmsm_point *at)
{
    double psi[2], jac[4];
    pmsm_plane_flux(plane, d, q, psi, jac);
    at->d = d;
    at->q = q;
    at->t = psi[0] * q - psi[1] * d;
    at->t_d = jac[0] * q - jac[2] * d - psi[1];
    at->t_q = jac[1] * q - jac[3] * d + psi[0];
    at->h = d * d + q * q;
    at->g = psi[0] * psi[0] + psi[1] * psi[1];
    at->g_d = 2.0 * (psi[0] * jac[0] + psi[1] * jac[2]);
    at->g_q = 2.0 * (psi[0] * jac[1] + psi[1] * jac[3]);
}

pmsm_rectangle pmsm_plane_rectangle(const pmsm_plane *plane)
{
    pmsm_rectangle r = {-INFINITY, INFINITY, -INFINITY, INFINITY, PMSM_LIMIT_DEMAGNETISATION};
    if (plane->map) {
        r.d_low = plane->map->i_d[0];
        r.d_high = plane->map->i_d[plane->map->n_i_d - 1];
        r.q_low = plane->map->i_q[0];
        r.q_high = plane->map->i_q[plane->map->n_i_q - 1];
        r.d_low_limit = PMSM_LIMIT_MAP;
    }
    if (plane->i_d_min > r.d_low) {
        r.d_low = plane->i_d_min;
        r.d_low_limit = PMSM_LIMIT_DEMAGNETISATION;
    }
    return r;
}

int32_t pmsm_on_branch(const pmsm_plane *plane, const pmsm_point *at)
{
    pmsm_point axis;
    if (!(at->t_q > 0.0))
        return 0;
    pmsm_plane_at(plane, at->d, 0.0, &axis);
    return axis.t_q > 0.0;
}

double pmsm_plane_outside(const pmsm_plane *plane, const pmsm_rectangle *r, const pmsm_point *at)
{
    const double I = plane->I_max;
    const double across = fmax(r->d_low - at->d, at->d - r->d_high) / I;
    const double along = fmax(r->q_low - at->q, at->q - r->q_high) / I;
    return fmax(0.5 * (at->h / (I * I) - 1.0), fmax(across, along));
}

double pmsm_voltage_squared(const pmsm_plane *plane, const pmsm_point *at, double omega)
{
    const double R = plane->R;
    return R * R * at->h + omega * (2.0 * R * at->t + omega * at->g);
}

void pmsm_voltage_gradient(const pmsm_plane *plane, const pmsm_point *at, double omega, double gradient[2])
{
    const double R = plane->R;
    gradient[0] = 2.0 * R * R * at->d + omega * (2.0 * R * at->t_d + omega * at->g_d);
    gradient[1] = 2.0 * R * R * at->q + omega * (2.0 * R * at->t_q + omega * at->g_q);
}

double pmsm_plane_loss(const pmsm_plane *plane, const pmsm_point *at, double omega)
{
    double coefficient[2] = {0.0, 0.0};
    const double f = fabs(omega) / (4.0 * HALF_PI);
    if (plane->loss)
        (void)pmsm_flux_map_flux(plane->loss, at->d, at->q, coefficient, NULL);
    return 1.5 * plane->R * at->h + f * (coefficient[0] + f * coefficient[1]);
}

static void loss_gradient(const pmsm_plane *plane, const pmsm_point *at, double omega, double gradient[2])
{
    double coefficient[2] = {0.0, 0.0}, jac[4] = {0.0, 0.0, 0.0, 0.0};
    const double f = fabs(omega) / (4.0 * HALF_PI);
    if (plane->loss)
        (void)pmsm_flux_map_flux(plane->loss, at->d, at->q, coefficient, jac);
    gradient[0] = 3.0 * plane->R * at->d + f * (jac[0] + f * jac[2]);
    gradient[1] = 3.0 * plane->R * at->q + f * (jac[1] + f * jac[3]);
}

/* ---- level curves -------------------------------------------------------------------------------- */

static void level_gradient(const pmsm_curve *curve, const pmsm_point *at, double gradient[2])
{
    if (curve->kind == PMSM_CURVE_TORQUE) {
        gradient[0] = at->t_d;
        gradient[1] = at->t_q;
    } else {
        pmsm_voltage_gradient(curve->plane, at, curve->omega, gradient);
    }
}

/* Distance from the level, and the size of the terms that make it up (rounding floor). */
static double level_error(const pmsm_curve *curve, const pmsm_point *at, double *size)
{
    if (curve->kind == PMSM_CURVE_TORQUE) {
        *size = sqrt(at->g * at->h) + fabs(curve->level);
        return at->t - curve->level;
    }
    *size = square(curve->plane->R) * at->h + square(curve->omega) * at->g + curve->level;
    return pmsm_voltage_squared(curve->plane, at, curve->omega) - curve->level;
}

/* Newton's method along the gradient. A step that overshoots, as the first one from inside a thin ellipse, is halved. */
int32_t pmsm_curve_correct(const pmsm_curve *curve, pmsm_point *at)
{
    double before = INFINITY, error = INFINITY, floor = 0.0, step_d = 0.0, step_q = 0.0;
    pmsm_point from = *at;
    for (int32_t k = 0; k < CORRECTIONS_MAX; k++) {
        double gradient[2], size, slope;
        error = level_error(curve, at, &size);
        if (fabs(error) <= CORRECTED * size)
            return 1;
        if (fabs(error) < before) {
            level_gradient(curve, at, gradient);
            slope = square(gradient[0]) + square(gradient[1]);
            floor = 64.0 * CORRECTED * fmax(size, curve->plane->I_max * sqrt(slope)); /* of flux that nearly cancels */
            if (!(slope > 0.0))
                break;
            from = *at;
            before = fabs(error);
            step_d = -error / slope * gradient[0];
            step_q = -error / slope * gradient[1];
        } else {
            if (fabs(error) <= floor)
                break;
            step_d *= 0.5;
            step_q *= 0.5;
        }
        pmsm_plane_at(curve->plane, from.d + step_d, from.q + step_q, at);
    }
    return fabs(error) <= floor; /* rounding, else divergence */
}

void pmsm_curve_tangent(const pmsm_curve *curve, const pmsm_point *at, double tangent[2])
{
    double gradient[2], length;
    switch (curve->kind) {
    case PMSM_CURVE_CIRCLE:
        gradient[0] = at->d;
        gradient[1] = at->q;
        length = -sqrt(at->h); /* the angle rises against the clockwise turn below */
        break;
    case PMSM_CURVE_VERTICAL:
        gradient[0] = -1.0;
        gradient[1] = 0.0;
        length = 1.0;
        break;
    case PMSM_CURVE_HORIZONTAL:
        gradient[0] = 0.0;
        gradient[1] = 1.0;
        length = 1.0;
        break;
    default:
        level_gradient(curve, at, gradient);
        length = sqrt(square(gradient[0]) + square(gradient[1]));
        break;
    }
    tangent[0] = gradient[1] / length;
    tangent[1] = -gradient[0] / length;
}

double pmsm_curve_indicator(const pmsm_curve *curve, enum pmsm_indicator what, const pmsm_point *at)
{
    double tangent[2], gradient[2] = {0.0, 0.0};
    switch (what) {
    case PMSM_AT_VOLTAGE:
        return pmsm_voltage_squared(curve->plane, at, curve->omega) - curve->V2;
    case PMSM_AT_TORQUE:
        return at->t - curve->T;
    case PMSM_AT_EDGE:
        return pmsm_plane_outside(curve->plane, curve->rectangle, at);
    case PMSM_AT_TORQUE_EXTREME:
        gradient[0] = at->t_d;
        gradient[1] = at->t_q;
        break;
    case PMSM_AT_CURRENT_EXTREME:
        gradient[0] = at->d;
        gradient[1] = at->q;
        break;
    case PMSM_AT_VOLTAGE_EXTREME:
        pmsm_voltage_gradient(curve->plane, at, curve->omega, gradient);
        break;
    case PMSM_AT_LOSS_EXTREME:
        loss_gradient(curve->plane, at, curve->omega, gradient);
        break;
    }
    pmsm_curve_tangent(curve, at, tangent);
    return gradient[0] * tangent[0] + gradient[1] * tangent[1];
}

/* ---- roots --------------------------------------------------------------------------------------- */

void pmsm_curve_place(const pmsm_curve *curve, double s, pmsm_point *at)
{
    if (curve->kind == PMSM_CURVE_CIRCLE)
        pmsm_plane_at(curve->plane, curve->level * cos(s), curve->level * sin(s), at);
    else if (curve->kind == PMSM_CURVE_VERTICAL)
        pmsm_plane_at(curve->plane, curve->level, s, at);
    else
        pmsm_plane_at(curve->plane, s, curve->level, at);
}

typedef struct {
    const pmsm_curve *curve;
    const pmsm_point *a, *b; /* ends of a chord; null: a and b are parameters */
    double s_a, s_b;
} span;

static int32_t span_place(const span *over, double x, pmsm_point *at)
{
    if (!over->a) {
        pmsm_curve_place(over->curve, over->s_a + x * (over->s_b - over->s_a), at);
        return 1;
    }
    pmsm_plane_at(over->curve->plane, over->a->d + x * (over->b->d - over->a->d),
                  over->a->q + x * (over->b->q - over->a->q), at);
    return pmsm_curve_correct(over->curve, at);
}

/* Bracketed secant after Illinois (Dowell, Jarratt 1971, DOI 10.1007/BF01934364): superlinear, never leaves [0, 1]. */
static int32_t span_root(const span *over, enum pmsm_indicator what, double f_a, double f_b, double *x,
                         pmsm_point *root)
{
    double x_a = 0.0, x_b = 1.0;
    const double scale = fmax(fabs(f_a), fabs(f_b));
    if (!(f_a * f_b <= 0.0))
        return 0;
    for (int32_t k = 0; k < ROOT_STEPS_MAX; k++) {
        double f, moved;
        *x = f_a == f_b ? 0.5 : x_a + (x_b - x_a) * f_a / (f_a - f_b);
        moved = fabs(*x - x_b);
        if (!span_place(over, *x, root))
            return 0;
        f = pmsm_curve_indicator(over->curve, what, root);
        if (fabs(f) <= ROOT_FLOOR * scale || (k > 0 && moved <= ROOT_MOVED))
            return 1;
        if (f * f_b < 0.0) {
            x_a = x_b;
            f_a = f_b;
        } else {
            f_a *= 0.5;
        }
        x_b = *x;
        f_b = f;
    }
    return 1;
}

int32_t pmsm_curve_root(const pmsm_curve *curve, enum pmsm_indicator what, const pmsm_point *a, const pmsm_point *b,
                        pmsm_point *root)
{
    const span over = {curve, a, b, 0.0, 1.0};
    double x;
    return span_root(&over, what, pmsm_curve_indicator(curve, what, a), pmsm_curve_indicator(curve, what, b), &x,
                     root);
}

int32_t pmsm_curve_root_between(const pmsm_curve *curve, enum pmsm_indicator what, double s_a, double s_b,
                                double *s, pmsm_point *root)
{
    const span over = {curve, NULL, NULL, s_a, s_b};
    pmsm_point a, b;
    double x;
    pmsm_curve_place(curve, s_a, &a);
    pmsm_curve_place(curve, s_b, &b);
    if (!span_root(&over, what, pmsm_curve_indicator(curve, what, &a), pmsm_curve_indicator(curve, what, &b), &x,
                   root))
        return 0;
    *s = s_a + x * (s_b - s_a);
    return 1;
}

int32_t pmsm_curve_step(const pmsm_curve *curve, const pmsm_point *from, double length, pmsm_point *to)
{
    double tangent[2], turned[2], forward;
    pmsm_curve_tangent(curve, from, tangent);
    for (int32_t k = 0; k < STEP_HALVINGS; k++, length *= 0.5) {
        pmsm_plane_at(curve->plane, from->d + length * tangent[0], from->q + length * tangent[1], to);
        if (!pmsm_curve_correct(curve, to))
            continue;
        pmsm_curve_tangent(curve, to, turned);
        forward = ((to->d - from->d) * tangent[0] + (to->q - from->q) * tangent[1]) / length;
        if (tangent[0] * turned[0] + tangent[1] * turned[1] >= TURN_COSINE && forward >= STEP_FORWARD)
            return 1;
    }
    return 0;
}

/* ---- border -------------------------------------------------------------------------------------- */

static void add_piece(pmsm_border *border, const pmsm_plane *plane, enum pmsm_curve_kind kind, double level, double s0,
                      double s1, int32_t nodes)
{
    pmsm_piece *piece = &border->piece[border->n_pieces];
    if (!(s1 > s0) || border->n_pieces == PMSM_BORDER_PIECES)
        return;
    if (nodes < 4)
        nodes = 4;
    if (border->n_nodes + 2 * nodes > PMSM_BORDER_NODES) /* torque extremes may double the count */
        nodes = (PMSM_BORDER_NODES - border->n_nodes) / 2;
    piece->curve = (pmsm_curve){plane, NULL, kind, level, 0.0, 0.0, 0.0};
    piece->s[0] = s0;
    piece->s[1] = s1;
    piece->first = border->n_nodes;
    piece->count = 0;
    for (int32_t k = 0; k < nodes; k++) {
        const double s = k == nodes - 1 ? s1 : s0 + (s1 - s0) * k / (nodes - 1);
        pmsm_point at;
        pmsm_curve_place(&piece->curve, s, &at);
        if (k > 0) { /* an extreme of the torque between two nodes becomes a node */
            const int32_t last = piece->first + piece->count - 1;
            const double f0 = pmsm_curve_indicator(&piece->curve, PMSM_AT_TORQUE_EXTREME, &border->node[last]);
            const double f1 = pmsm_curve_indicator(&piece->curve, PMSM_AT_TORQUE_EXTREME, &at);
            if (f0 * f1 < 0.0) {
                const int32_t n = last + 1;
                if (pmsm_curve_root_between(&piece->curve, PMSM_AT_TORQUE_EXTREME, border->s[last], s, &border->s[n],
                                            &border->node[n]))
                    piece->count++;
            }
        }
        border->s[piece->first + piece->count] = s;
        border->node[piece->first + piece->count++] = at;
    }
    border->n_nodes += piece->count;
    border->n_pieces++;
}

static int32_t inside_rectangle(const pmsm_rectangle *r, double d, double q)
{
    return d >= r->d_low && d <= r->d_high && q >= r->q_low && q <= r->q_high;
}

static int32_t sorted_insert(double *list, int32_t n, double value)
{
    int32_t k = n;
    for (; k > 0 && list[k - 1] > value; k--)
        list[k] = list[k - 1];
    list[k] = value;
    return n + 1;
}

/* Arcs of the circle between its crossings with the rectangle. */
static void add_arcs(pmsm_border *border, const pmsm_plane *plane, double radius, int32_t nodes_per_turn)
{
    const pmsm_rectangle *r = &border->rectangle;
    double angle[11];
    int32_t n = 0;
    n = sorted_insert(angle, n, -2.0 * HALF_PI);
    n = sorted_insert(angle, n, 2.0 * HALF_PI);
    for (int32_t k = 0; k < 2; k++) {
        const double d = k ? r->d_high : r->d_low, q = k ? r->q_high : r->q_low;
        if (fabs(d) < radius) {
            n = sorted_insert(angle, n, acos(d / radius));
            n = sorted_insert(angle, n, -acos(d / radius));
        }
        if (fabs(q) < radius) {
            const double up = asin(q / radius);
            n = sorted_insert(angle, n, up);
            n = sorted_insert(angle, n, up >= 0.0 ? 2.0 * HALF_PI - up : -2.0 * HALF_PI - up);
        }
    }
    for (int32_t k = 0; k + 1 < n; k++) {
        const double middle = 0.5 * (angle[k] + angle[k + 1]), width = angle[k + 1] - angle[k];
        if (width > 1e-12 && inside_rectangle(r, radius * cos(middle), radius * sin(middle)))
            add_piece(border, plane, PMSM_CURVE_CIRCLE, radius, angle[k], angle[k + 1],
                      2 + (int32_t)(nodes_per_turn * width / (4.0 * HALF_PI)));
    }
}

/* The part of a side of the rectangle that lies in the circle. */
static void add_line(pmsm_border *border, const pmsm_plane *plane, enum pmsm_curve_kind kind, double level, double low,
                     double high, double radius)
{
    if (fabs(level) < radius) {
        const double reach = sqrt(square(radius) - square(level));
        add_piece(border, plane, kind, level, fmax(-reach, low), fmin(reach, high), EDGE_NODES);
    }
}

void pmsm_border_build(const pmsm_plane *plane, const pmsm_rectangle *rectangle, double radius, int32_t with_lines,
                       int32_t nodes_per_turn, pmsm_border *border)
{
    border->rectangle = *rectangle;
    border->n_pieces = 0;
    border->n_nodes = 0;
    add_arcs(border, plane, radius, nodes_per_turn);
    if (with_lines) {
        const pmsm_rectangle *r = &border->rectangle;
        add_line(border, plane, PMSM_CURVE_VERTICAL, r->d_low, r->q_low, r->q_high, radius);
        add_line(border, plane, PMSM_CURVE_HORIZONTAL, r->q_low, r->d_low, r->d_high, radius);
        add_line(border, plane, PMSM_CURVE_VERTICAL, r->d_high, r->q_low, r->q_high, radius);
        add_line(border, plane, PMSM_CURVE_HORIZONTAL, r->q_high, r->d_low, r->d_high, radius);
    }
    for (int32_t k = 0; k < border->n_pieces; k++)
        border->piece[k].curve.rectangle = &border->rectangle;
}
