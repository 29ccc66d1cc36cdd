/* SPDX-License-Identifier: MIT */
/* Flux map of a saturated machine: psi(i) and i(psi) as tensor-product cubic cells.
 *
 * Units: currents in A, flux linkages in Wb, both peak phase values in rotor (dq) coordinates,
 * d axis along the magnets; inductances (entries of a Jacobian d psi/d i) in H, reluctances
 * (d i/d psi) in A/Wb.
 *
 * Two tables, each an interpolating tensor-product spline turned into cells once:
 *   forward  psi(i)  over the nodes of the map (i_d, i_q): what design, look-up tables and checks use;
 *   inverse  i(psi)  over an equidistant grid of fluxes, whose nodes solve psi(i) = psi* on the
 *                    forward cells: THIS TABLE IS THE SIMULATED MACHINE. The two agree at the flux nodes
 *                    and to the table's stated error (flux_map.py, FluxMap.inverse_error_a) between them.
 *
 * Cells: bicubic (C2 inside the map, not-a-knot ends; equal to scipy's RectBivariateSpline with
 * s = 0) or bilinear (C0, for comparison only). With x, y in [0, 1] along the first and the second axis of
 * the cell, quantity k (0: d, 1: q) is
 *
 *     f_k = sum over a, b in 0..3 of  c[(4 b + a) 2 + k]  x^a y^b
 *
 * and a table of n_1 x n_2 nodes has (n_1 - 1)(n_2 - 1) cells of PMSM_FLUX_MAP_CELL numbers, row major.
 *
 * Outside its rectangle a table is continued from the nearest point c of the border by
 * f(c) + f_1 dx + f_2 dy + f_12 dx dy: C1, no cubic runs away, and every such call says so in its
 * status. A NaN argument gives NaN and an outside status.
 *
 * The struct only points to arrays that the caller owns; nothing is allocated here.
 */
#ifndef PMSM_FLUX_MAP_H
#define PMSM_FLUX_MAP_H

#include <stdint.h>

#ifndef PMSM_EXPORT
#if defined(_WIN32) && defined(PMSM_SHARED)
#define PMSM_EXPORT __declspec(dllexport)
#elif defined(__GNUC__) && defined(PMSM_SHARED)
#define PMSM_EXPORT __attribute__((visibility("default")))
#else
#define PMSM_EXPORT
#endif
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define PMSM_FLUX_MAP_CELL 32 /* doubles of one cell: 16 coefficients of two quantities */

enum pmsm_flux_map_kind { PMSM_FLUX_MAP_BICUBIC = 0, PMSM_FLUX_MAP_BILINEAR = 1 };

/* Status bits; 0 is a value inside the map. */
#define PMSM_FLUX_MAP_OUTSIDE_I_D 1u /* i_d (given or found) is outside the map's axis */
#define PMSM_FLUX_MAP_OUTSIDE_I_Q 2u
#define PMSM_FLUX_MAP_OUTSIDE_PSI 4u /* psi is outside the inverse table */
#define PMSM_FLUX_MAP_NOT_CONVERGED 8u

typedef struct pmsm_flux_map {
    const double *i_d;           /* A, n_i_d increasing nodes */
    const double *i_q;           /* A, n_i_q increasing nodes */
    const double *cells;         /* forward cells, [i_d][i_q] */
    const double *inverse_cells; /* inverse cells, [psi_d][psi_q]; null: forward only */
    double i_d_per_step;         /* 1/step (1/A) of an equidistant axis, 0 otherwise */
    double i_q_per_step;
    double psi_d_min, psi_d_step, psi_d_per_step; /* Wb, Wb, 1/Wb: equidistant nodes of the inverse table */
    double psi_q_min, psi_q_step, psi_q_per_step;
    int32_t n_i_d, n_i_q;
    int32_t n_psi_d, n_psi_q;
} pmsm_flux_map;

/* Cell of the inverse table that was read last, or zeros: the next flux mostly lies in it, too. */
typedef struct pmsm_flux_map_near {
    const double *cell;
    double k_d, k_q;
} pmsm_flux_map_near;

/* Forward: psi = {psi_d, psi_q} (Wb); jac = {dpsi_d/di_d, dpsi_d/di_q, dpsi_q/di_d, dpsi_q/di_q} (H), or null. */
uint32_t pmsm_flux_map_flux(const pmsm_flux_map *map, double i_d, double i_q, double psi[2], double *jac);

typedef struct {
    double d, q;
} pmsm_flux_map_dq; /* A; two numbers that are returned in registers */

/* Inverse, as the simulated machine: i from the inverse table. At least C1 in psi. */
pmsm_flux_map_dq pmsm_flux_map_current(const pmsm_flux_map *map, pmsm_flux_map_near *near, double psi_d, double psi_q,
                                       uint32_t *status);

/* Inverse with its Jacobian {di_d/dpsi_d, di_d/dpsi_q, di_q/dpsi_d, di_q/dpsi_q} (A/Wb). */
uint32_t pmsm_flux_map_current_jacobian(const pmsm_flux_map *map, double psi_d, double psi_q, double i[2],
                                        double jac[4]);

/* Inverse of the forward cells to rounding: Newton from i (in: a start, e.g. from the table), at most
 * max_steps damped steps, until |psi(i) - psi| <= tolerance (Wb, largest component). */
uint32_t pmsm_flux_map_solve(const pmsm_flux_map *map, double psi_d, double psi_q, double tolerance,
                             int32_t max_steps, double i[2]);

/* ---- for callers through a foreign-function interface ---------------------------------------- */

PMSM_EXPORT uint32_t pmsm_flux_map_size(void); /* sizeof(pmsm_flux_map) */

/* n points at once; jac (4 n) and status (n) may be null; returns all status bits or-ed. */
PMSM_EXPORT uint32_t pmsm_flux_map_flux_many(const pmsm_flux_map *map, int32_t n, const double *i_d, const double *i_q,
                                             double *psi_d, double *psi_q, double *jac, uint32_t *status);
PMSM_EXPORT uint32_t pmsm_flux_map_current_many(const pmsm_flux_map *map, int32_t n, const double *psi_d,
                                                const double *psi_q, double *i_d, double *i_q, uint32_t *status);
/* As pmsm_flux_map_solve, from the starts in i_d, i_q. */
PMSM_EXPORT uint32_t pmsm_flux_map_solve_many(const pmsm_flux_map *map, int32_t n, const double *psi_d,
                                              const double *psi_q, double tolerance, int32_t max_steps, double *i_d,
                                              double *i_q, uint32_t *status);

/* ---- builders --------------------------------------------------------------------------------- */

/* Write quantity k (0 or 1) of all cells of a table: value[n_x][n_y] over the nodes x, y.
 * Bicubic needs at least 4 nodes per axis, bilinear 2. work: 3 n_x n_y + 2 max(n_x, n_y) doubles. */
PMSM_EXPORT void pmsm_flux_map_fit(int32_t kind, int32_t k, int32_t n_x, const double *x, int32_t n_y, const double *y,
                                   const double *value, double *work, double *cells);

/* Currents at the flux nodes of the struct's inverse table (psi_*_min, psi_*_step, n_psi_*), found on the
 * forward cells by damped Newton from the neighbouring node, outwards from the node nearest to
 * zero current. i_d, i_q, status: [n_psi_d][n_psi_q]. Returns the number of nodes not converged. */
PMSM_EXPORT int32_t pmsm_flux_map_invert(const pmsm_flux_map *map, double tolerance, int32_t max_steps, double *i_d,
                                         double *i_q, uint32_t *status);

#ifdef __cplusplus
}
#endif
#endif
