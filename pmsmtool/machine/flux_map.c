/* SPDX-License-Identifier: MIT */
/* Flux map: evaluation and construction of the cells; see flux_map.h. */
#include "flux_map.h"

#include <stddef.h>

#define CELL PMSM_FLUX_MAP_CELL
#define HALVINGS_MAX 20 /* of a damped Newton step: 1e-6 of it */

/* ---- place of an argument on an axis ----------------------------------------------------------- */

typedef struct {
    int32_t k;      /* cell */
    double x;       /* place inside the cell, 0..1 */
    double per_h;   /* 1/width of the cell */
    double beyond;  /* distance outside the axis, signed, 0 inside */
} place;

static place place_equidistant(double first, double per_step, int32_t n, double v)
{
    const double last = (double)(n - 1);
    double t = (v - first) * per_step;
    place at;
    at.per_h = per_step;
    at.beyond = 0.0;
    if (!(t >= 0.0 && t <= last)) { /* also NaN */
        const double border = t > last ? last : 0.0;
        at.beyond = (t - border) / per_step;
        t = border;
    }
    at.k = (int32_t)t;
    if (at.k > n - 2)
        at.k = n - 2;
    at.x = t - (double)at.k;
    return at;
}

static place place_on_axis(const double *axis, double per_step, int32_t n, double v)
{
    int32_t low = 0, high = n - 1;
    place at;
    if (per_step > 0.0)
        return place_equidistant(axis[0], per_step, n, v);
    at.beyond = 0.0;
    if (!(v >= axis[0] && v <= axis[n - 1])) {
        const double border = v > axis[n - 1] ? axis[n - 1] : axis[0];
        at.beyond = v - border;
        v = border;
    }
    while (high - low > 1) {
        const int32_t middle = low + (high - low) / 2;
        if (v < axis[middle])
            high = middle;
        else
            low = middle;
    }
    at.k = low;
    at.per_h = 1.0 / (axis[low + 1] - axis[low]);
    at.x = (v - axis[low]) * at.per_h;
    return at;
}

/* ---- one cell ---------------------------------------------------------------------------------- */

/* The two values only: Horner along y for the eight (a, k), then along x. */
static inline pmsm_flux_map_dq cell_value(const double *c, double x, double y)
{
    double r[8];
    for (int j = 0; j < 8; j++)
        r[j] = ((c[24 + j] * y + c[16 + j]) * y + c[8 + j]) * y + c[j];
    const pmsm_flux_map_dq f = {((r[6] * x + r[4]) * x + r[2]) * x + r[0], ((r[7] * x + r[5]) * x + r[3]) * x + r[1]};
    return f;
}

/* Values, slopes along x and y (per cell width), and the mixed second derivative where asked. */
static void cell_slopes(const double *c, double x, double y, double f[2], double f_x[2], double f_y[2], double *f_xy)
{
    double r[8], s[8];
    for (int j = 0; j < 8; j++) {
        r[j] = ((c[24 + j] * y + c[16 + j]) * y + c[8 + j]) * y + c[j];
        s[j] = (3.0 * c[24 + j] * y + 2.0 * c[16 + j]) * y + c[8 + j];
    }
    for (int k = 0; k < 2; k++) {
        f[k] = ((r[6 + k] * x + r[4 + k]) * x + r[2 + k]) * x + r[k];
        f_x[k] = (3.0 * r[6 + k] * x + 2.0 * r[4 + k]) * x + r[2 + k];
        f_y[k] = ((s[6 + k] * x + s[4 + k]) * x + s[2 + k]) * x + s[k];
    }
    if (f_xy)
        for (int k = 0; k < 2; k++)
            f_xy[k] = (3.0 * s[6 + k] * x + 2.0 * s[4 + k]) * x + s[2 + k];
}

/* Value and Jacobian {d0/d1, d0/d2, d1/d1, d1/d2} of a table, continued outside its rectangle. */
static void table_jacobian(const double *cells, int32_t n_2, place p, place q, double f[2], double *jac)
{
    const double *c = cells + ((ptrdiff_t)p.k * (n_2 - 1) + q.k) * CELL;
    double f_x[2], f_y[2], f_xy[2];
    const int outside = !(p.beyond == 0.0 && q.beyond == 0.0);
    cell_slopes(c, p.x, q.x, f, f_x, f_y, outside ? f_xy : NULL);
    for (int k = 0; k < 2; k++) {
        f_x[k] *= p.per_h;
        f_y[k] *= q.per_h;
        if (outside) {
            const double mixed = f_xy[k] * p.per_h * q.per_h;
            f[k] += f_x[k] * p.beyond + f_y[k] * q.beyond + mixed * p.beyond * q.beyond;
            f_x[k] += mixed * q.beyond;
            f_y[k] += mixed * p.beyond;
        }
        if (jac) {
            jac[2 * k] = f_x[k];
            jac[2 * k + 1] = f_y[k];
        }
    }
}

/* ---- evaluation --------------------------------------------------------------------------------- */

uint32_t pmsm_flux_map_flux(const pmsm_flux_map *map, double i_d, double i_q, double psi[2], double *jac)
{
    const place p = place_on_axis(map->i_d, map->i_d_per_step, map->n_i_d, i_d);
    const place q = place_on_axis(map->i_q, map->i_q_per_step, map->n_i_q, i_q);
    table_jacobian(map->cells, map->n_i_q, p, q, psi, jac);
    return (p.beyond == 0.0 ? 0u : PMSM_FLUX_MAP_OUTSIDE_I_D) | (q.beyond == 0.0 ? 0u : PMSM_FLUX_MAP_OUTSIDE_I_Q);
}

/* The machine's edge in terms of the current found: the image of the map is not a rectangle. */
static inline uint32_t current_status(const pmsm_flux_map *map, double i_d, double i_q, int inside)
{
    uint32_t status = 0u;
    if (!(i_d >= map->i_d[0] && i_d <= map->i_d[map->n_i_d - 1]))
        status |= PMSM_FLUX_MAP_OUTSIDE_I_D;
    if (!(i_q >= map->i_q[0] && i_q <= map->i_q[map->n_i_q - 1]))
        status |= PMSM_FLUX_MAP_OUTSIDE_I_Q;
    return inside ? status : status | PMSM_FLUX_MAP_OUTSIDE_PSI;
}

uint32_t pmsm_flux_map_current_jacobian(const pmsm_flux_map *map, double psi_d, double psi_q, double i[2],
                                        double jac[4])
{
    const place p = place_equidistant(map->psi_d_min, map->psi_d_per_step, map->n_psi_d, psi_d);
    const place q = place_equidistant(map->psi_q_min, map->psi_q_per_step, map->n_psi_q, psi_q);
    table_jacobian(map->inverse_cells, map->n_psi_q, p, q, i, jac);
    return current_status(map, i[0], i[1], p.beyond == 0.0 && q.beyond == 0.0);
}

/* The same where the cell has to be found. */
static pmsm_flux_map_dq find_current(const pmsm_flux_map *map, pmsm_flux_map_near *near, double psi_d, double psi_q,
                                     uint32_t *status)
{
    const place p = place_equidistant(map->psi_d_min, map->psi_d_per_step, map->n_psi_d, psi_d);
    const place q = place_equidistant(map->psi_q_min, map->psi_q_per_step, map->n_psi_q, psi_q);
    near->cell = map->inverse_cells + ((ptrdiff_t)p.k * (map->n_psi_q - 1) + q.k) * CELL;
    near->k_d = (double)p.k;
    near->k_q = (double)q.k;
    if (p.beyond == 0.0 && q.beyond == 0.0) {
        const pmsm_flux_map_dq i = cell_value(near->cell, p.x, q.x);
        *status = current_status(map, i.d, i.q, 1);
        return i;
    }
    double f[2];
    table_jacobian(map->inverse_cells, map->n_psi_q, p, q, f, NULL);
    const pmsm_flux_map_dq i = {f[0], f[1]};
    *status = current_status(map, i.d, i.q, 0);
    return i;
}

pmsm_flux_map_dq pmsm_flux_map_current(const pmsm_flux_map *map, pmsm_flux_map_near *near, double psi_d, double psi_q,
                                       uint32_t *status)
{
    const double x = (psi_d - map->psi_d_min) * map->psi_d_per_step - near->k_d;
    const double y = (psi_q - map->psi_q_min) * map->psi_q_per_step - near->k_q;
    if (!(near->cell && x >= 0.0 && x < 1.0 && y >= 0.0 && y < 1.0))
        return find_current(map, near, psi_d, psi_q, status);
    const pmsm_flux_map_dq i = cell_value(near->cell, x, y); /* no conversion to an index stood in the way */
    *status = current_status(map, i.d, i.q, 1);
    return i;
}

static double magnitude(double v)
{
    return v < 0.0 ? -v : v;
}

static double larger(double a, double b)
{
    return a > b ? a : b;
}

uint32_t pmsm_flux_map_solve(const pmsm_flux_map *map, double psi_d, double psi_q, double tolerance,
                             int32_t max_steps, double i[2])
{
    double psi[2], jac[4];
    uint32_t outside = pmsm_flux_map_flux(map, i[0], i[1], psi, jac);
    double r_d = psi[0] - psi_d, r_q = psi[1] - psi_q;
    double error = larger(magnitude(r_d), magnitude(r_q));
    for (int32_t step = 0; step < max_steps && error > tolerance; step++) {
        const double det = jac[0] * jac[3] - jac[1] * jac[2];
        double trial[2], lambda = 1.0, e = error;
        if (!(det > 0.0))
            break; /* folded: no inverse here */
        for (int half = 0; half <= HALVINGS_MAX; half++, lambda *= 0.5) {
            trial[0] = i[0] - lambda * (jac[3] * r_d - jac[1] * r_q) / det;
            trial[1] = i[1] - lambda * (jac[0] * r_q - jac[2] * r_d) / det;
            outside = pmsm_flux_map_flux(map, trial[0], trial[1], psi, NULL);
            e = larger(magnitude(psi[0] - psi_d), magnitude(psi[1] - psi_q));
            if (e < error)
                break;
        }
        if (!(e < error))
            break; /* rounding floor, or stuck */
        i[0] = trial[0];
        i[1] = trial[1];
        outside = pmsm_flux_map_flux(map, i[0], i[1], psi, jac);
        r_d = psi[0] - psi_d;
        r_q = psi[1] - psi_q;
        error = e;
    }
    return outside | (error <= tolerance ? 0u : PMSM_FLUX_MAP_NOT_CONVERGED);
}

/* ---- arrays -------------------------------------------------------------------------------------- */

uint32_t pmsm_flux_map_size(void)
{
    return (uint32_t)sizeof(pmsm_flux_map);
}

uint32_t pmsm_flux_map_flux_many(const pmsm_flux_map *map, int32_t n, const double *i_d, const double *i_q,
                                 double *psi_d, double *psi_q, double *jac, uint32_t *status)
{
    uint32_t all = 0u;
    for (int32_t m = 0; m < n; m++) {
        double psi[2];
        const uint32_t one = pmsm_flux_map_flux(map, i_d[m], i_q[m], psi, jac ? jac + 4 * (ptrdiff_t)m : NULL);
        psi_d[m] = psi[0];
        psi_q[m] = psi[1];
        if (status)
            status[m] = one;
        all |= one;
    }
    return all;
}

uint32_t pmsm_flux_map_current_many(const pmsm_flux_map *map, int32_t n, const double *psi_d, const double *psi_q,
                                    double *i_d, double *i_q, uint32_t *status)
{
    pmsm_flux_map_near near = {NULL, 0.0, 0.0};
    uint32_t all = 0u;
    for (int32_t m = 0; m < n; m++) {
        uint32_t one;
        const pmsm_flux_map_dq i = pmsm_flux_map_current(map, &near, psi_d[m], psi_q[m], &one);
        i_d[m] = i.d;
        i_q[m] = i.q;
        if (status)
            status[m] = one;
        all |= one;
    }
    return all;
}

uint32_t pmsm_flux_map_solve_many(const pmsm_flux_map *map, int32_t n, const double *psi_d, const double *psi_q,
                                  double tolerance, int32_t max_steps, double *i_d, double *i_q, uint32_t *status)
{
    uint32_t all = 0u;
    for (int32_t m = 0; m < n; m++) {
        double i[2] = {i_d[m], i_q[m]};
        const uint32_t one = pmsm_flux_map_solve(map, psi_d[m], psi_q[m], tolerance, max_steps, i);
        i_d[m] = i[0];
        i_q[m] = i[1];
        if (status)
            status[m] = one;
        all |= one;
    }
    return all;
}

/* ---- builders ------------------------------------------------------------------------------------- */

/* Node slopes of the cubic spline through n >= 4 points of a line, not-a-knot ends (de Boor, A Practical
 * Guide to Splines, chapter IV): tridiagonal, solved without pivoting (all pivots are positive).
 * value and slope advance by stride; work: 2 n. */
static void spline_slopes(int32_t n, const double *x, const double *value, ptrdiff_t stride, double *slope,
                          double *work)
{
    double *upper = work, *right = work + n;
    double h0 = x[1] - x[0], h1 = x[2] - x[1];
    double d0 = (value[stride] - value[0]) / h0, d1 = (value[2 * stride] - value[stride]) / h1;
    upper[0] = (h0 + h1) / h1;
    right[0] = ((h0 + 2.0 * (h0 + h1)) * h1 * d0 + h0 * h0 * d1) / ((h0 + h1) * h1);
    for (int32_t m = 1; m < n - 1; m++) {
        double pivot;
        h0 = x[m] - x[m - 1];
        h1 = x[m + 1] - x[m];
        d0 = (value[m * stride] - value[(m - 1) * stride]) / h0;
        d1 = (value[(m + 1) * stride] - value[m * stride]) / h1;
        pivot = 2.0 * (h0 + h1) - h1 * upper[m - 1];
        upper[m] = h0 / pivot;
        right[m] = (3.0 * (h1 * d0 + h0 * d1) - h1 * right[m - 1]) / pivot;
    }
    /* h0, h1, d0, d1 are those of the last interior node */
    {
        const double sum = h0 + h1;
        const double last = ((h1 + 2.0 * sum) * h0 * d1 + h1 * h1 * d0) / sum;
        slope[(n - 1) * stride] = (last - sum * right[n - 2]) / (h0 - sum * upper[n - 2]);
    }
    for (int32_t m = n - 2; m >= 0; m--)
        slope[m * stride] = right[m] - upper[m] * slope[(m + 1) * stride];
}

/* Power coefficients of a cubic on [0, 1] from end values and end slopes. */
static void hermite(double f0, double f1, double s0, double s1, double c[4])
{
    c[0] = f0;
    c[1] = s0;
    c[2] = 3.0 * (f1 - f0) - 2.0 * s0 - s1;
    c[3] = 2.0 * (f0 - f1) + s0 + s1;
}

typedef struct { /* node values of one quantity and their derivatives, [n_x][n_y] */
    const double *f, *f_x, *f_y, *f_xy;
    int32_t n_y;
} nodes;

static void bicubic_cell(const nodes *at, int32_t ix, int32_t iy, double h_x, double h_y, double *cell)
{
    const ptrdiff_t n00 = (ptrdiff_t)ix * at->n_y + iy, n10 = n00 + at->n_y;
    double low[4], high[4], low_y[4], high_y[4], column[4]; /* along x at y = 0 and 1, and their y slopes */
    hermite(at->f[n00], at->f[n10], h_x * at->f_x[n00], h_x * at->f_x[n10], low);
    hermite(at->f[n00 + 1], at->f[n10 + 1], h_x * at->f_x[n00 + 1], h_x * at->f_x[n10 + 1], high);
    hermite(h_y * at->f_y[n00], h_y * at->f_y[n10], h_x * h_y * at->f_xy[n00], h_x * h_y * at->f_xy[n10], low_y);
    hermite(h_y * at->f_y[n00 + 1], h_y * at->f_y[n10 + 1], h_x * h_y * at->f_xy[n00 + 1],
            h_x * h_y * at->f_xy[n10 + 1], high_y);
    for (int a = 0; a < 4; a++) {
        hermite(low[a], high[a], low_y[a], high_y[a], column);
        for (int b = 0; b < 4; b++)
            cell[(4 * b + a) * 2] = column[b];
    }
}

static void bilinear_cell(const double *f, int32_t n_y, int32_t ix, int32_t iy, double *cell)
{
    const double *f0 = f + (ptrdiff_t)ix * n_y + iy, *f1 = f0 + n_y;
    for (int j = 0; j < 16; j++)
        cell[2 * j] = 0.0;
    cell[0] = f0[0];
    cell[2] = f1[0] - f0[0];
    cell[8] = f0[1] - f0[0];
    cell[10] = f1[1] - f1[0] - f0[1] + f0[0];
}

void pmsm_flux_map_fit(int32_t kind, int32_t k, int32_t n_x, const double *x, int32_t n_y, const double *y,
                       const double *value, double *work, double *cells)
{
    const ptrdiff_t size = (ptrdiff_t)n_x * n_y;
    double *f_x = work, *f_y = work + size, *f_xy = work + 2 * size, *line = work + 3 * size;
    const nodes at = {value, f_x, f_y, f_xy, n_y};
    if (kind == PMSM_FLUX_MAP_BICUBIC) {
        for (int32_t iy = 0; iy < n_y; iy++)
            spline_slopes(n_x, x, value + iy, n_y, f_x + iy, line);
        for (int32_t ix = 0; ix < n_x; ix++) {
            const ptrdiff_t row = (ptrdiff_t)ix * n_y;
            spline_slopes(n_y, y, value + row, 1, f_y + row, line);
            spline_slopes(n_y, y, f_x + row, 1, f_xy + row, line);
        }
    }
    for (int32_t ix = 0; ix < n_x - 1; ix++)
        for (int32_t iy = 0; iy < n_y - 1; iy++) {
            double *cell = cells + ((ptrdiff_t)ix * (n_y - 1) + iy) * CELL + k;
            if (kind == PMSM_FLUX_MAP_BICUBIC)
                bicubic_cell(&at, ix, iy, x[ix + 1] - x[ix], y[iy + 1] - y[iy], cell);
            else
                bilinear_cell(value, n_y, ix, iy, cell);
        }
}

typedef struct { /* an inversion under way */
    const pmsm_flux_map *map;
    double tolerance;
    int32_t max_steps;
    double *i_d, *i_q;
    uint32_t *status;
    int32_t failed;
} inversion;

/* Solve node (m_d, m_q) from the solution at `from`; a node that fails keeps its start. */
static void invert_node(inversion *run, int32_t m_d, int32_t m_q, ptrdiff_t from)
{
    const pmsm_flux_map *map = run->map;
    const ptrdiff_t node = (ptrdiff_t)m_d * map->n_psi_q + m_q;
    double i[2] = {run->i_d[from], run->i_q[from]};
    run->status[node] = pmsm_flux_map_solve(map, map->psi_d_min + m_d * map->psi_d_step,
                                            map->psi_q_min + m_q * map->psi_q_step, run->tolerance, run->max_steps, i);
    run->i_d[node] = i[0];
    run->i_q[node] = i[1];
    run->failed += (run->status[node] & PMSM_FLUX_MAP_NOT_CONVERGED) != 0u;
}

static void invert_row(inversion *run, int32_t m_d, int32_t centre)
{
    const ptrdiff_t row = (ptrdiff_t)m_d * run->map->n_psi_q;
    for (int32_t m_q = centre + 1; m_q < run->map->n_psi_q; m_q++)
        invert_node(run, m_d, m_q, row + m_q - 1);
    for (int32_t m_q = centre - 1; m_q >= 0; m_q--)
        invert_node(run, m_d, m_q, row + m_q + 1);
}

int32_t pmsm_flux_map_invert(const pmsm_flux_map *map, double tolerance, int32_t max_steps, double *i_d, double *i_q,
                             uint32_t *status)
{
    inversion run = {map, tolerance, max_steps, i_d, i_q, status, 0};
    double psi[2];
    place p, q;
    pmsm_flux_map_flux(map, 0.0, 0.0, psi, NULL);
    p = place_equidistant(map->psi_d_min, map->psi_d_per_step, map->n_psi_d, psi[0]);
    q = place_equidistant(map->psi_q_min, map->psi_q_per_step, map->n_psi_q, psi[1]);
    {
        const ptrdiff_t start = (ptrdiff_t)p.k * map->n_psi_q + q.k;
        i_d[start] = 0.0;
        i_q[start] = 0.0;
        invert_node(&run, p.k, q.k, start);
    }
    invert_row(&run, p.k, q.k);
    for (int32_t m_d = p.k + 1; m_d < map->n_psi_d; m_d++) {
        invert_node(&run, m_d, q.k, (ptrdiff_t)(m_d - 1) * map->n_psi_q + q.k);
        invert_row(&run, m_d, q.k);
    }
    for (int32_t m_d = p.k - 1; m_d >= 0; m_d--) {
        invert_node(&run, m_d, q.k, (ptrdiff_t)(m_d + 1) * map->n_psi_q + q.k);
        invert_row(&run, m_d, q.k);
    }
    return run.failed;
}
