/* SPDX-License-Identifier: MIT */
/* Parts of the polar-coordinate laws. Internal. Voltage v = (-V_a sin(delta), V_a cos(delta)). */
#ifndef PMSM_POLAR_H
#define PMSM_POLAR_H

#include "pmsm_period.h"

typedef struct {
    pmsm_real R, L, psi;  /* ohm, H (mean of the axes), Wb */
    pmsm_real alpha;      /* R/L */
    pmsm_real omega;      /* rad/s, never negative in the phase laws */
    pmsm_real V;          /* V, amplitude limit */
    pmsm_real T_s;
} polar_plant;

/* polar_phase.c: laws 1 and 2, PID on phase and amplitude */
void pmsm_polar_phase_start(pmsm_period *period, const polar_plant *plant, pmsm_dq v);
void pmsm_polar_phase(pmsm_period *period, const polar_plant *plant);

/* polar.c: demand v as amplitude and phase; the phase turns the slower the smaller v is against eps (V) */
void pmsm_polar_map(pmsm_period *period, pmsm_dq v, pmsm_real eps);

/* polar_unified.c: law 6, and what it remembers of the limits after the modulation */
void pmsm_polar_unified(pmsm_period *period, const polar_plant *plant);
void pmsm_polar_unified_settle(pmsm_period *period);

#endif
