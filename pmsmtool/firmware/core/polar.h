/* SPDX-License-Identifier: MIT */
/* Parts of the polar-coordinate laws. Internal. Voltage v = (-V_a sin(delta), V_a cos(delta)). */
#ifndef PMSM_POLAR_H
#define PMSM_POLAR_H

#include "pmsm_period.h"

/* Members of pmsm_state.polar. */
enum pmsm_polar_memory {
    POLAR_DELTA = 0,      /* rad, phase of the last period */
    POLAR_AMPLITUDE = 1,  /* V, signed amplitude of the last period */
    POLAR_I_PHASE = 2,    /* rad, integrator of the phase controller */
    POLAR_D_PHASE = 3,    /* A, low-passed input of its derivative part, and the last input */
    POLAR_SHORT_D = 2,    /* V, what overmodulation keeps back, in the unified law */
    POLAR_SHORT_Q = 3,    /* V */
    POLAR_WEIGHT = 4,     /* of one period in the observer, in the unified law */
    POLAR_I_AMPLITUDE = 4,/* V */
    POLAR_D_AMPLITUDE = 5,/* A */
    POLAR_X_D = 6,        /* V, integrators of the regularised law */
    POLAR_X_Q = 7,        /* V */
    POLAR_STARTED = 8,    /* 1: the memory belongs to the running control */
    POLAR_LINEAR = 9,     /* 1: the regularised law stands in for the phase law */
    POLAR_LAST_PHASE = 10,    /* A */
    POLAR_LAST_AMPLITUDE = 11 /* A */
};

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
