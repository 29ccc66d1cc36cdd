/* SPDX-License-Identifier: MIT */
/* What a table is worth between its nodes: torque and limits of the linearly interpolated currents.
 *
 * The interpolation is the drive's (firmware/core/lookup.c): linear along each axis, corners without a point left
 * out and the rest scaled up.
 */
#include "lookup_table.h"

#include <math.h>
#include <stddef.h>

typedef struct {
    const double *x, *y, *z;
    int32_t n_x, n_y, n_z;
    const double *i_d, *i_q;
} grid;

typedef struct {
    double d, q;
    int32_t holes; /* corners without a point */
    int32_t corners;
} interpolated;

static interpolated interpolate(const grid *g, int32_t ix, int32_t iy, int32_t iz, double a, double b, double c)
{
    interpolated at = {0.0, 0.0, 0, 0};
    double weight = 0.0;
    for (int32_t k = 0; k < 8; k++) {
        const int32_t rx = k >> 2, ry = (k >> 1) & 1, rz = k & 1;
        const double w = (rx ? a : 1.0 - a) * (ry ? b : 1.0 - b) * (rz ? c : 1.0 - c);
        ptrdiff_t cell;
        if (w == 0.0)
            continue;
        cell = ((ptrdiff_t)(ix + rx) * g->n_y + (iy + ry)) * g->n_z + (iz + rz);
        if (isnan(g->i_d[cell]) || isnan(g->i_q[cell])) {
            at.holes++;
            continue;
        }
        at.corners++;
        at.d += w * g->i_d[cell];
        at.q += w * g->i_q[cell];
        weight += w;
    }
    if (at.holes) {
        at.d /= weight;
        at.q /= weight;
    }
    return at;
}

typedef struct {
    double torque, voltage, current; /* errors, see the header */
} errors;

static void sample(const pmsm_plane *plane, const interpolated *i, double torque, const double *range, double omega,
                   double limit, errors *e)
{
    const double scale = 1.5 * plane->pole_pairs;
    pmsm_point at;
    if (i->corners == 0 || isnan(range[0]))
        return; /* no point in the table, or none that could be right */
    pmsm_plane_at(plane, i->d, i->q, &at);
    e->torque = fmax(e->torque, fabs(scale * at.t - fmin(fmax(torque, range[0]), range[1])));
    e->voltage = fmax(e->voltage, sqrt(pmsm_voltage_squared(plane, &at, omega)) - limit);
    e->current = fmax(e->current, sqrt(at.h) - plane->I_max);
}

/* Node number of a fine axis and the share inside its cell. */
static double fine(const double *axis, int32_t n, int32_t m, int32_t k, int32_t *cell, double *share)
{
    if (n < 2) {
        *cell = 0;
        *share = 0.0;
        return axis[0];
    }
    *cell = k / m < n - 1 ? k / m : n - 2;
    *share = (double)(k - *cell * m) / m;
    return axis[*cell] + *share * (axis[*cell + 1] - axis[*cell]);
}

void pmsm_lookup_error(const pmsm_plane *plane, int32_t n_x, const double *x, int32_t n_y, const double *y,
                       const double *omega_per_y, int32_t n_z, const double *z, const double *limit, const double *i_d,
                       const double *i_q, int32_t m, const double *range, double *worst)
{
    const grid g = {x, y, z, n_x, n_y, n_z, i_d, i_q};
    const int32_t f_x = (n_x - 1) * m + 1, f_y = (n_y - 1) * m + 1, f_z = (n_z - 1) * m + 1;
    for (ptrdiff_t k = 0; k < (ptrdiff_t)(n_x - 1) * (n_y - 1) * 9; k++)
        worst[k] = -INFINITY;
    for (int32_t ky = 0; ky < f_y; ky++)
        for (int32_t kz = 0; kz < f_z; kz++) {
            int32_t iy, iz;
            double b, c, y_k, omega, V;
            y_k = fine(y, n_y, m, ky, &iy, &b);
            V = fine(limit ? limit : z, n_z, m, kz, &iz, &c);
            if (!limit)
                V = y_k;
            omega = omega_per_y ? *omega_per_y * y_k : 1.0;
            for (int32_t kx = 0; kx < f_x; kx++) {
                int32_t ix;
                double a, *w;
                errors e = {0.0, -INFINITY, -INFINITY};
                const double torque = fine(x, n_x, m, kx, &ix, &a);
                const interpolated at = interpolate(&g, ix, iy, iz, a, b, c);
                const int32_t kind = b == 0.0 || b == 1.0 ? 0 : a == 0.0 || a == 1.0 ? 1 : 2;
                sample(plane, &at, torque, range + 2 * ((ptrdiff_t)ky * f_z + kz), omega, V, &e);
                w = worst + 9 * ((ptrdiff_t)ix * (n_y - 1) + iy) + 3 * kind;
                w[0] = fmax(w[0], e.torque);
                w[1] = fmax(w[1], e.voltage);
                w[2] = fmax(w[2], e.current);
            }
        }
}
