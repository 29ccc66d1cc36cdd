/* SPDX-License-Identifier: MIT */
/* Three legs as sources whose voltage depends on the direction of their current. Internal to sim/. */
#ifndef PMSM_LEG_CIRCUIT_H
#define PMSM_LEG_CIRCUIT_H

#include "inverter.h"

/* What each leg offers to a current out of it, and into it: v_out <= v_in. */
typedef struct {
    double v_out[3], v_in[3]; /* V above DC minus */
    double r_out[3], r_in[3]; /* ohm */
    uint32_t open[3];         /* 1: no path at all */
} pmsm_leg_sources;

/* Advance the plant under a supply, and the sensor lag and the volt-seconds with it. */
void pmsm_leg_advance(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, const pmsm_supply *supply,
                      double h);

/* An interval of constant sources, every zero crossing of a current resolved. */
void pmsm_leg_interval(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag,
                       const pmsm_leg_sources *sources, double h);

#endif
