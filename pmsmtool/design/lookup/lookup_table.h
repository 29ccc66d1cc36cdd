/* SPDX-License-Identifier: MIT */
/* Current references of least loss over torque x speed x voltage; see lookup_table.c. */
#ifndef PMSM_LOOKUP_TABLE_H
#define PMSM_LOOKUP_TABLE_H

#include "current_plane.h"

#ifdef __cplusplus
extern "C" {
#endif

/* Least loss subject to torque, current, voltage, demagnetisation and map limits.
 *
 * torque[n_T] (N m, any sign), omega[n_w] (electrical rad/s, any sign), V[n_V] (V peak).
 * Outputs, row-major [n_T][n_w][n_V]: i_d, i_q (A, NaN where there is no point), achieved (N m), limits (bits of
 * enum pmsm_limit). extreme: [n_w][n_V][2][3] least and largest torque (N m) with its i_d, i_q, NaN for none.
 * n_T may be 0. Returns the number of cells that could not be solved (their currents are NaN and limits 255): 0
 * unless the map is folded. */
PMSM_EXPORT int32_t pmsm_lookup_table(const pmsm_plane *plane, int32_t n_T, const double *torque, int32_t n_w,
                                      const double *omega, int32_t n_V, const double *V, double *i_d, double *i_q,
                                      double *achieved, uint8_t *limits, double *extreme);

/* Error of the linearly interpolated table x (torque) x y (speed or flux limit) x z (voltage), m points per interval.
 *
 * omega_per_y: electrical speed over y, null for a flux table (omega 1, limit y); limit[n_z]: voltage limit at the
 * nodes of z, null for a flux table. range[fine y][fine z][2]: least and largest torque there (N m).
 * worst: [n_x - 1][n_y - 1][3][3]: for points between nodes of x only (0), of y only (1), inside the cell (2): largest
 * |torque - nearest admissible torque| (N m), |v| - limit (V or Wb), |i| - I_max (A), each also negative where the
 * limit is far; -infinity where nothing was sampled. A point on a node counts for kind 0. */
PMSM_EXPORT void pmsm_lookup_error(const pmsm_plane *plane, int32_t n_x, const double *x, int32_t n_y, const double *y,
                                   const double *omega_per_y, int32_t n_z, const double *z, const double *limit,
                                   const double *i_d, const double *i_q, int32_t m, const double *range,
                                   double *worst);

/* sizeof(pmsm_plane), to check the caller's idea of it. */
PMSM_EXPORT uint32_t pmsm_plane_size(void);

#ifdef __cplusplus
}
#endif
#endif
