/* Exact projection in steps: rows can be added to what is solved already. Internal to the core. */
#ifndef PMSM_ACTIVE_SET_H
#define PMSM_ACTIVE_SET_H

#include "pmsm_projection.h"

typedef struct {                  /* a projection under way; rows can be added to what is solved already */
    const pmsm_row *row;
    pmsm_real inverse[PMSM_PROJECTION_ROWS]; /* 1/V^2 */
    uint32_t count;
    uint32_t basis[2];            /* active rows, the one added last first; PMSM_PROJECTION_NONE when free */
    uint32_t limit, goal;         /* rows of smallest, when it is known beforehand, else PMSM_PROJECTION_NONE */
    pmsm_dq smallest;             /* pmsm_smallest_voltage(goal, limit) */
    pmsm_dq r;                    /* projected */
    pmsm_dq v;                    /* nearest point to r that satisfies the rows so far */
} pmsm_active_set;

/* Begin with no row, then take in the first count rows. An empty set leaves v as it was before the
 * row that emptied it. */
void pmsm_projection_begin(pmsm_active_set *set, const pmsm_row *rows, pmsm_dq r);
uint32_t pmsm_projection_extend(pmsm_active_set *set, uint32_t count, uint32_t *steps);

#endif
