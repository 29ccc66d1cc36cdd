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

/* sizeof(pmsm_plane), to check the caller's idea of it. */
PMSM_EXPORT uint32_t pmsm_plane_size(void);

#ifdef __cplusplus
}
#endif
#endif
