/* SPDX-License-Identifier: MIT */
/* Nearest point of a plane to the intersection of ellipses |M v + c| <= V: what the reference governor and the field
 * weakening solve. Every loop is bounded; nothing is allocated.
 */
#ifndef PMSM_PROJECTION_H
#define PMSM_PROJECTION_H

#include "pmsm_types.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {                  /* the row |M v + c| <= V */
    pmsm_real m_dd, m_dq, m_qd, m_qq; /* V/A */
    pmsm_real c_d, c_q;           /* V */
    pmsm_real V;                  /* V, > 0 */
} pmsm_row;

#define PMSM_PROJECTION_EMPTY 255u /* the rows have no common point */
#define PMSM_PROJECTION_NONE 255u  /* no row */
#define PMSM_PROJECTION_ROWS 72u   /* most rows of one call */
#define PMSM_PROJECTION_ROUNDS 16u /* exchanges of one call */
/* Newton steps: a solver goes on from the count it is given up to this, so that one count bounds all that a period
 * solves. Where it runs out the point is what was reached, on or beyond its row. At most 12 seen in binary32. */
#ifdef PMSM_REAL_DOUBLE
#define PMSM_PROJECTION_STEPS 32u
#else
#define PMSM_PROJECTION_STEPS 17u
#endif

/* M v + c. */
static inline pmsm_dq pmsm_voltage_of(const pmsm_row *row, pmsm_dq v)
{
    pmsm_dq w;
    w.d = (row->m_dd * v.d + row->m_dq * v.q) + row->c_d;
    w.q = (row->m_qd * v.d + row->m_qq * v.q) + row->c_q;
    return w;
}

/* The same for callers outside the core. */
PMSM_EXPORT pmsm_dq pmsm_row_voltage(const pmsm_row *row, pmsm_dq v);

/* Nearest point to r on one row; r itself when it satisfies the row. steps counts Newton steps. */
PMSM_EXPORT pmsm_dq pmsm_project_row(const pmsm_row *row, pmsm_dq r, uint32_t *steps);

/* Nearest point to r that satisfies all rows, by an active set of at most two rows.
 * Returns the number of active rows (0: r itself), or PMSM_PROJECTION_EMPTY; then *v is not written.
 * active receives the index of the row that was added last, 255 when none is active. */
PMSM_EXPORT uint32_t pmsm_project_rows(const pmsm_row *rows, uint32_t count, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                                       uint32_t *steps);

/* The point with the smallest |M v + c| of the goal among those that satisfy the limit row. */
PMSM_EXPORT pmsm_dq pmsm_smallest_voltage(const pmsm_row *goal, const pmsm_row *limit, uint32_t *steps);

/* Nearest point to r under the half planes a_k v <= b_k (normals need not be of unit length), by the same method. */
PMSM_EXPORT uint32_t pmsm_project_half_planes(const pmsm_dq *a, const pmsm_real *b, uint32_t count, pmsm_dq r,
                                              pmsm_dq *v, uint32_t *active, uint32_t *steps);

#ifdef __cplusplus
}
#endif

#endif
