/* SPDX-License-Identifier: MIT */
/* Many drives in one call over all cores: the same parameters and the same course of events, each with its own machine
 * and sensors.
 *
 * Drive k runs exactly as pmsm_sim_run() would run it alone, so its numbers do not depend on how many threads there
 * are nor on which of them took it. Threads take the next drive as they become free; nothing is allocated here.
 */
#ifndef PMSM_MONTE_CARLO_H
#define PMSM_MONTE_CARLO_H

#include <stdint.h>

#include "closed_loop.h"

#define PMSM_MONTE_CARLO_THREADS_MAX 64u

typedef struct {               /* what is kept of one drive; of the machine, not of what the sensors say */
    double i_peak;             /* A, largest |i| at the end of a period */
    double i_square;           /* A2, mean of |i|^2 */
    double torque;             /* N m, mean of its amount */
    double omega_peak;         /* rad/s mechanical, largest amount */
    double u_peak;             /* largest voltage demanded, behind the limiter, over the DC link of its period */
    uint64_t infeasible;       /* periods in which governor or field weakening found no admissible current */
    uint64_t outside;          /* flux-map evaluations outside the map */
    uint32_t trip;             /* enum pmsm_trip at the end */
    uint32_t reserved;         /* 0; fills the struct on every platform */
} pmsm_drive_run;

typedef struct {
    const pmsm_sim *model;     /* started, not yet run: its drive and schedules are everyone's */
    const pmsm_sim_setup *setup; /* n machines with their sensors */
    uint32_t n;
    uint32_t threads;          /* 1..PMSM_MONTE_CARLO_THREADS_MAX; cut to n */
    uint64_t periods;
    void *memory;              /* threads * pmsm_monte_carlo_memory() bytes, aligned as a double */
    pmsm_drive_run *result;    /* n */
} pmsm_monte_carlo;

/* Bytes of working memory of one thread. */
PMSM_EXPORT uint64_t pmsm_monte_carlo_memory(void);
/* Size of pmsm_monte_carlo (0) or pmsm_drive_run (1), for callers that mirror them. */
PMSM_EXPORT uint32_t pmsm_monte_carlo_layout(uint32_t what);
/* Run all drives; returns the threads that worked (fewer than asked for when the system gave no more). */
PMSM_EXPORT uint32_t pmsm_monte_carlo_run(const pmsm_monte_carlo *all);

#endif
