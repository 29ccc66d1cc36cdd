/* SPDX-License-Identifier: MIT */
/* Exact projection in steps: rows can be added to what is solved already. Internal to the core. */
#ifndef PMSM_ACTIVE_SET_H
#define PMSM_ACTIVE_SET_H

#include "pmsm_math.h"
#include "pmsm_projection.h"

#ifdef PMSM_REAL_DOUBLE
#define PMSM_PROJECTION_VIOLATION 1e-10 /* |w|^2/V^2 - 1 that counts as satisfied */
#define PMSM_PROJECTION_STALL 1e-7      /* the same, when rounding keeps a row from coming closer */
#define PMSM_CORNER_STEPS 8u
#define PMSM_PROJECTION_SINGULAR 1e-13  /* relative determinant below which two normals count as parallel */
#else
#define PMSM_PROJECTION_VIOLATION 5e-6F
#define PMSM_PROJECTION_STALL 2e-5F
#define PMSM_CORNER_STEPS 6u
#define PMSM_PROJECTION_SINGULAR 1e-6F
#endif

#define PMSM_CORNER_COST 2u /* a step of a corner takes as long as so many of one row */

static inline pmsm_real pmsm_dot(pmsm_dq x, pmsm_dq y)
{
    return x.d * y.d + x.q * y.q;
}

/* As pmsm_project_row, from a multiplier that is near already, in at most so many steps: what is reached then is near
 * the row, and *multiplier is where the next call goes on. */
pmsm_dq pmsm_project_row_from(const pmsm_row *row, pmsm_dq r, pmsm_real *multiplier, uint32_t most, uint32_t *steps);

/* Newton's method for the corner of two rows from v; see projection.c. */
uint32_t pmsm_find_corner(const pmsm_row *first, const pmsm_row *second, pmsm_dq r, uint32_t most, pmsm_dq *v,
                          uint32_t *steps);
uint32_t pmsm_project_pair(const pmsm_row *first, const pmsm_row *second, pmsm_dq r, pmsm_dq outside, pmsm_dq best,
                           pmsm_dq *v, uint32_t *steps);

typedef struct {                  /* a projection under way; rows can be added to what is solved already */
    const pmsm_row *row;
    pmsm_real inverse[PMSM_PROJECTION_ROWS]; /* 1/V^2 */
    uint32_t count;
    uint32_t basis[2];            /* active rows, the one added last first; PMSM_PROJECTION_NONE when free */
    pmsm_dq r;                    /* projected */
    pmsm_dq v;                    /* nearest point to r that satisfies the rows so far */
} pmsm_active_set;

/* Begin with no row. */
static inline void pmsm_projection_begin(pmsm_active_set *set, const pmsm_row *rows, pmsm_dq r)
{
    set->row = rows;
    set->count = 0u;
    set->basis[0] = PMSM_PROJECTION_NONE;
    set->basis[1] = PMSM_PROJECTION_NONE;
    set->r = r;
    set->v = r;
}

/* Take in the first count rows. An empty set leaves v as it was before the row that emptied it. */
uint32_t pmsm_projection_extend(pmsm_active_set *set, uint32_t count, uint32_t *steps);

#endif
