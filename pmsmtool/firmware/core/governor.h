/* SPDX-License-Identifier: MIT */
/* The governor's parts: rows of a period, solvers on them, observer. Internal to the core. */
#ifndef PMSM_GOVERNOR_H
#define PMSM_GOVERNOR_H

#include "pmsm_period.h"

#define PMSM_ROWS_MAX (PMSM_GOVERNOR_ROWS + 2u) /* prediction, steady state, current */
#define PMSM_POLYGON_ROWS 16u                   /* prediction rows of the linearised mode */

typedef struct {
    pmsm_row row[PMSM_ROWS_MAX];
    uint32_t count;
    uint32_t steady;   /* index of the steady-state row; the current row follows it when it is there */
    uint32_t built;    /* rows 0..built - 1 and from steady on stand; prediction rows only when they are needed */
    pmsm_dq offset;    /* V, beside the nominal model in the steady state */
    uint32_t may_start;/* 0: this period has no time left to start a minimum-time transfer, or for more than row 0 */
    uint32_t reachable;/* 1: the request was projected on steady-state and current row */
} pmsm_governor_rows;

/* A point on row 0 that is well outside the current row: a corner of row 0 just outside the other, where there is one.
 * The current then slides along its limit with the whole voltage. */
pmsm_dq pmsm_governor_slide(const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq v, uint32_t *steps);

static inline uint32_t pmsm_has_option(const pmsm_period *period, uint32_t option)
{
    return ((period->params->governor_options & option) != 0u) ? 1u : 0u;
}

/* enum pmsm_binding of a row. */
static inline uint32_t pmsm_governor_binding(const pmsm_governor_rows *rows, uint32_t active)
{
    if (active < rows->steady) {
        return active;
    }
    if (active == PMSM_BINDING_NONE) {
        return PMSM_BINDING_NONE;
    }
    return (active == rows->steady) ? (uint32_t)PMSM_BINDING_STEADY_STATE : (uint32_t)PMSM_BINDING_CURRENT;
}

/* The line search takes the integrators' word: it is the law for little processing time. */
static inline uint32_t pmsm_governor_observes(const pmsm_params *params)
{
    const uint32_t mode = params->governor_mode;
    const uint32_t able = (mode == PMSM_GOVERNOR_BEST || mode == PMSM_GOVERNOR_OBSERVE) ? 1u : 0u;
    return (able != 0u && params->governor_observer_gain > 0.0F) ? 1u : 0u;
}

/* governor_observer.c */
uint32_t pmsm_governor_observe(pmsm_period *period); /* 1: the last period was not the model's */

/* governor_rows.c */
void pmsm_governor_build(pmsm_period *period, pmsm_governor_rows *rows);
void pmsm_governor_complete(const pmsm_period *period, pmsm_governor_rows *rows); /* the prediction rows, too */
uint32_t pmsm_governor_admits(const pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r);

/* governor_solve.c: a reference for an inadmissible request by the solver of the mode; sets the fallback flag when not
 * all rows could be met */
pmsm_dq pmsm_governor_solve(pmsm_period *period, const pmsm_governor_rows *rows, pmsm_dq r, uint32_t *binding,
                            uint32_t *steps);

/* Voltage rows first, the current row only on top of their solution, which stands when all cannot be met at once.
 * Returns 1, 0 when the current row had to be given up, PMSM_PROJECTION_EMPTY when the voltage rows have no common
 * point. */
uint32_t pmsm_governor_project(const pmsm_governor_rows *rows, pmsm_dq r, pmsm_dq *v, uint32_t *active,
                               uint32_t *steps);

#endif
