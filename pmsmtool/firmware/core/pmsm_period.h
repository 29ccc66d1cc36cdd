/* SPDX-License-Identifier: MIT */
/* What the parts of one period hand to each other. Internal to the core.
 *
 * step.c fills it, reference.c and governor.c turn a request into a reference, current.c (or polar.c) into a voltage,
 * modulation.c into duty ratios.
 */
#ifndef PMSM_PERIOD_H
#define PMSM_PERIOD_H

#include "pmsm_core.h"
#include "pmsm_laws.h"
#include "pmsm_math.h"
#include "pmsm_modes.h"
#include "pmsm_projection.h"

typedef struct {
    const pmsm_params *params;
    const uint32_t *lut;
    const pmsm_magnetics *magnetics; /* the parameters' own, or of the table at the present current */
    const pmsm_reference *request;
    pmsm_state *state;
    pmsm_real omega_e;         /* rad/s */
    pmsm_real omega_M;         /* rad/s */
    pmsm_real U_dc;            /* V */
    pmsm_real U_ahead;         /* V, less while the link falls: where currents are looked for */
    pmsm_real V_max;           /* V, radius of the voltage circle */
    pmsm_real R_s;             /* ohm, at the winding temperature */
    pmsm_real sine, cosine;    /* of the sampled angle */
    pmsm_real sine_half, cosine_half; /* of the turn in half a period, after pmsm_turn_half() */
    pmsm_real sine_out, cosine_out; /* of the angle at the middle of the applied voltage */
    pmsm_dq i;                 /* A, sampled */
    pmsm_dq i_model;           /* A, the current the proportional part sees: sampled, or predicted */
    pmsm_dq flux_model;        /* Wb, of a predicted one */
    pmsm_dq reference;         /* A, what the current controller shall reach */
    pmsm_dq u;                 /* V, demanded */
    pmsm_dq u_realised;        /* V, after the limits, without dead-time compensation */
    pmsm_dq u_compensation;    /* V, dead-time compensation, when it is to be recorded */
    uint32_t flags;
    uint32_t steps;            /* Newton steps of field weakening and governor, up to PMSM_PROJECTION_STEPS */
    uint32_t looked;           /* nodes of a look-up table; each beyond PMSM_LUT_NODES is a step */
    pmsm_dq i_harmonic;        /* A, of overmodulation: sampled, not in i */
    pmsm_dq u_harmonic;        /* V, stator frame: what overmodulation adds to u_realised */
} pmsm_period;

/* derived.c */
void pmsm_prepare(pmsm_state *state, const pmsm_params *params);

/* saturation.c: period->magnetics at a current, from the table of the parameter set */
void pmsm_saturate(pmsm_period *period, pmsm_dq i);
pmsm_dq pmsm_flux(const pmsm_period *period, pmsm_dq i); /* Wb, at any current */
static inline pmsm_dq pmsm_flux_here(const pmsm_magnetics *m, pmsm_dq i) /* at the current of m, or near it */
{
    const pmsm_dq psi = {m->psi_f + m->L_d_app * i.d, m->L_q_app * i.q};
    return psi;
}

/* reference.c: protection, torque and speed to a current request */
void pmsm_update_i2t(pmsm_period *period);
pmsm_real pmsm_current_limit(const pmsm_period *period);
pmsm_real pmsm_speed_control(pmsm_period *period);
pmsm_dq pmsm_torque_to_current(pmsm_period *period, pmsm_real tau);
pmsm_dq pmsm_limit_current(pmsm_period *period, pmsm_dq i);
pmsm_real pmsm_torque(const pmsm_params *params, const pmsm_magnetics *magnetics, pmsm_dq i);

/* field_weakening.c: currents of a torque by optimisation, every N_fw periods; sets the flag of an empty set */
pmsm_dq pmsm_field_weakening(pmsm_period *period, pmsm_real tau);

#define PMSM_LUT_NODES 3u /* of a look-up without a search */
/* lookup.c: currents of a torque from the tables, within a current limit (A); sets the look-up flags */
pmsm_dq pmsm_lookup(pmsm_period *period, pmsm_real tau, pmsm_real limit);

/* current.c */
void pmsm_current_demand(pmsm_period *period);
void pmsm_current_integrate(pmsm_period *period);
void pmsm_current_row(const pmsm_period *period, pmsm_row *row); /* demand as a function of the reference */
pmsm_dq pmsm_model_voltage(const pmsm_period *period, pmsm_dq i); /* steady state, nominal flux */
pmsm_dq pmsm_hold_voltage(const pmsm_period *period, pmsm_dq i); /* what the controller gives without an error */
static inline void pmsm_turn_half(pmsm_period *period) /* once per period */
{
    if (period->cosine_half == PMSM_C(0.0)) {
        pmsm_sincos(PMSM_C(0.5) * period->state->derived.T_s * period->omega_e, &period->sine_half,
                    &period->cosine_half);
    }
}
/* Voltage that the model lacks, from what acted over the last period: the applied voltage minus the model's at the mean
 * current and minus L di/dt, which is told apart. After pmsm_turn_half(). */
pmsm_dq pmsm_lost_voltage(const pmsm_period *period, pmsm_dq *inductive);
void pmsm_observe_disturbance(pmsm_period *period, pmsm_real gain); /* its first-order filter */
void pmsm_predict_current(pmsm_period *period); /* period->i_model and flux_model one period on */

/* governor.c: period->reference becomes the governed one; 1: period->u is its demand */
uint32_t pmsm_govern(pmsm_period *period);

/* minimum_time.c: from is the flux now (Wb). When found, v is the reference that steers along the minimum-time
 * direction; sought: the search takes another period; barred: it would break the transient current limit */
enum pmsm_transfer { PMSM_TRANSFER_NONE, PMSM_TRANSFER_FOUND, PMSM_TRANSFER_SOUGHT, PMSM_TRANSFER_BARRED };
enum pmsm_transfer pmsm_minimum_time(pmsm_period *period, const pmsm_row *row, pmsm_dq offset, pmsm_dq from,
                                     pmsm_dq target, uint32_t may_start, pmsm_dq *v, uint32_t *steps);

/* polar.c: the laws of polar.mode in place of the current controller */
void pmsm_polar_demand(pmsm_period *period);
void pmsm_polar_settle(pmsm_period *period);

/* overmodulation.c; *beyond tells where u is outside the linear range */
enum pmsm_beyond { PMSM_BEYOND_NOT = 0, PMSM_BEYOND_IN_STEP, PMSM_BEYOND_HELD };
void pmsm_prepare_duties(pmsm_derived *derived, const pmsm_params *params);
pmsm_dq pmsm_lengthen(const pmsm_period *period, pmsm_dq u, uint32_t *beyond);
uint32_t pmsm_make_readable(const pmsm_derived *derived, uint32_t beyond, pmsm_abc wanted, pmsm_output *output);
pmsm_ab pmsm_part_harmonics(pmsm_period *period, pmsm_dq asked, pmsm_ab applied); /* returns the fundamental */
void pmsm_remove_harmonics(pmsm_period *period);

/* modulation.c */
pmsm_real pmsm_voltage_radius(const pmsm_period *period, pmsm_dq u); /* what the inverter gives in direction u */
void pmsm_modulate(pmsm_period *period, pmsm_output *output);
void pmsm_hold_output(const pmsm_state *state, pmsm_output *output); /* the voltage of the last period, turned */

#endif
