/* SPDX-License-Identifier: MIT */
/* One PWM period of the drive's control: pmsm_step().
 *
 * Order inside a period: transform the sampled currents, (every N_fw) field weakening or look-up,
 * reference governor, current controller, voltage limit, delay-compensating angle, duty ratios,
 * integrators. Everything tunable stands in pmsm_params (generated from the catalogue) and in the
 * look-up words behind it; everything that changes stands in pmsm_state.
 */
#ifndef PMSM_CORE_H
#define PMSM_CORE_H

#include "pmsm_params.h" /* generated: struct pmsm_params, schema version, layout signature */
#include "pmsm_types.h"

#ifdef __cplusplus
extern "C" {
#endif

/* What the controller is asked to do in this period. */
enum pmsm_mode {
    PMSM_MODE_OFF = 0,     /* gates off, controller reset */
    PMSM_MODE_VOLTAGE = 1, /* u_d_inject, u_q_inject are the whole voltage */
    PMSM_MODE_CURRENT = 2, /* i_d_ref, i_q_ref */
    PMSM_MODE_TORQUE = 3,  /* tau_ref through look-up or field weakening */
    PMSM_MODE_SPEED = 4,   /* omega_M_ref through the speed controller */
    PMSM_MODE_FAULT = 5,   /* the fault reaction of the parameters: the application has tripped */
    PMSM_MODE_POSITION = 6 /* as SPEED, below a position controller: omega_M_ref without slope limit, plus tau_ref */
};

/* Why pmsm_state.fault stands, until pmsm_reset_fault(). */
enum pmsm_fault {
    PMSM_FAULT_NONE = 0,
    PMSM_FAULT_INPUT = 1,  /* measurement or reference held no usable number in two periods running */
    PMSM_FAULT_RESULT = 2  /* no duty ratios came out of two periods running */
};

/* Bits of pmsm_live.flags. */
enum pmsm_flag {
    PMSM_FLAG_VOLTAGE_LIMITED = 1u << 0,  /* the demanded voltage left the circle or hexagon */
    PMSM_FLAG_DUTY_CLIPPED = 1u << 1,     /* a leg reached 0 or 1 */
    PMSM_FLAG_CURRENT_LIMITED = 1u << 2,  /* the current reference was cut to its limit */
    PMSM_FLAG_LUT_EDGE = 1u << 3,         /* the look-up was asked outside its axes */
    PMSM_FLAG_LUT_NO_POINT = 1u << 4,     /* the look-up cell holds no operating point */
    PMSM_FLAG_GOVERNOR_ACTIVE = 1u << 5,  /* the governor changed the reference */
    PMSM_FLAG_GOVERNOR_FALLBACK = 1u << 6,/* not all rows of the governor could be met */
    PMSM_FLAG_FW_EMPTY = 1u << 7,         /* no current satisfies voltage and current limit */
    PMSM_FLAG_I2T = 1u << 8,              /* the time-limited current budget is used up */
    PMSM_FLAG_ADC_CLIPPED = 1u << 9,      /* set by the drive: a current sample was at full scale */
    PMSM_FLAG_EXCITATION = 1u << 10,      /* set by the drive: an excitation is running */
    PMSM_FLAG_HELD = 1u << 11,            /* no usable numbers: the last voltage is held, the rest stands still */
    PMSM_FLAG_FAULT = 1u << 12            /* pmsm_state.fault is latched: fault reaction */
};

typedef struct {            /* sampled at the start of the period */
    pmsm_real i_a;          /* A */
    pmsm_real i_b;          /* A */
    pmsm_real i_c;          /* A */
    pmsm_real theta_e;      /* rad, electrical, any multiple of a turn within +-1e3 rad */
    pmsm_real omega_e;      /* rad/s, electrical */
    pmsm_real U_dc;         /* V */
    pmsm_real T_winding;    /* degC */
} pmsm_measurement;

typedef struct {
    uint32_t mode;           /* enum pmsm_mode */
    pmsm_real i_d_ref;       /* A peak */
    pmsm_real i_q_ref;       /* A peak */
    pmsm_real tau_ref;       /* N m */
    pmsm_real omega_M_ref;   /* rad/s, mechanical */
    pmsm_real u_d_inject;    /* V, added behind the current controller */
    pmsm_real u_q_inject;    /* V */
    pmsm_real bias_bandwidth;/* rad/s; > 0 replaces the current gains by a slow integral loop */
} pmsm_reference;

typedef struct {             /* what a trace or a TPDO can show of this period */
    pmsm_real i_d, i_q;              /* A, sampled */
    pmsm_real i_d_req, i_q_req;      /* A, before the governor */
    pmsm_real i_d_ref, i_q_ref;      /* A, after the governor */
    pmsm_real u_d, u_q;              /* V, demanded, before the limiter */
    pmsm_real u_d_lim, u_q_lim;      /* V, after limiter and duty clip, in the frame of u; without dead-time
                                        compensation unless current.options bit 5 */
    pmsm_real theta_e, omega_e;      /* rad in [-pi, pi), rad/s */
    pmsm_real tau;                   /* N m, from currents and parameters */
    pmsm_real kappa;                 /* governor: share of the way to the request, 1 = passed unchanged */
    uint32_t binding;                /* governor: index of the binding row, 255 none */
    uint32_t iterations;             /* governor or field weakening: solver iterations of this period */
    uint32_t flags;                  /* enum pmsm_flag */
} pmsm_live;

typedef struct {
    pmsm_real duty_a, duty_b, duty_c; /* 0..1 */
    pmsm_real u_alpha, u_beta;        /* V, demanded stator-frame voltage after the limiter */
    uint32_t gates;                   /* 1: switch, 0: all transistors off */
} pmsm_output;

typedef struct {             /* the machine at a current: psi = (psi_f + L_d_app i_d, L_q_app i_q) */
    pmsm_real L_d, L_q;      /* H, incremental */
    pmsm_real L_d_app, L_q_app; /* H, apparent */
    pmsm_real psi_f;         /* Wb */
    pmsm_dq K_p;             /* V/A, in proportion to L_d and L_q */
} pmsm_magnetics;

typedef struct {             /* constants of the active set, computed in the first period after pmsm_init() */
    pmsm_real T_s;           /* s */
    pmsm_real pole_pairs;
    pmsm_real torque_per_flux;    /* 1.5 p */
    pmsm_real i2t_rate;      /* budget per period and A^2 above I_cont^2 */
    pmsm_real speed_period;  /* s */
    pmsm_real speed_filter;  /* weight of a new sample */
    pmsm_real notch_b0, notch_b1, notch_b2, notch_a2; /* a1 = b1; b0 = 0: no notch */
    pmsm_magnetics nominal;  /* of the parameters */
    uint32_t saturates;      /* 1: there is a saturation table, and a law that follows it */
    pmsm_dq nodes_per_ampere; /* 1/A, along its axes */
    pmsm_dq gain_per_L;      /* V/(A H) */
    uint32_t saturation_word; /* where its nodes begin, behind the words of the look-up */
    uint32_t predicts;       /* 1: the controllers see the current one period ahead */
    uint32_t hexagon;        /* 1: the demand may use the inverter's hexagon, only the legs limit it */
    uint32_t overmodulates;  /* 1: a voltage beyond the linear range is meant as a fundamental */
    pmsm_real duty_most;     /* of a leg: its lower switch is on for the rest of the period */
    pmsm_real second_duty_most; /* of the second leg, so that two shunts of three can be read */
    pmsm_real duties_apart;  /* of the second leg from both others beyond the linear range, for one shunt */
    pmsm_real utilisation_linear; /* V_max / U_dc up to which a demand is what the legs make */
    pmsm_real side_low;      /* half of an edge of the hexagon that the second leg may use, over the inscribed radius */
    pmsm_real side_high;
    pmsm_real held_share;    /* of V_max, above which a demand belongs to a step */
    pmsm_real over_most;     /* largest fundamental over that of the linear range, and how it is approached */
    pmsm_real over_rate;
    uint32_t shunts;         /* that these duties are for */
} pmsm_derived;

typedef struct {             /* memory of a PID controller */
    pmsm_real integral;
    pmsm_real low;           /* low-passed input of its derivative part */
    pmsm_real last;          /* its last input */
} pmsm_polar_pid;

typedef struct {             /* memory of the polar-coordinate laws */
    pmsm_real delta;         /* rad, phase of the last period */
    pmsm_real amplitude;     /* V, signed, of the last period */
    pmsm_polar_pid phase_pid;     /* rad, A, A: laws 1 and 2 */
    pmsm_polar_pid amplitude_pid; /* V, A, A: law 2 */
    pmsm_dq integrator;      /* V, of the regularised law; rad and V of the linear ones */
    pmsm_dq shortfall;       /* V, what overmodulation keeps back, in the unified law */
    pmsm_real weight;        /* of one period in the observer, in the unified law */
    uint32_t started;        /* 1: the memory belongs to the running control */
    uint32_t linear;         /* 1: the regularised law stands in for the phase law */
} pmsm_polar_state;

typedef struct {             /* per-axis controller memory and whatever the modes need */
    pmsm_dq integrator;      /* V */
    pmsm_dq voltage_committed; /* V, stator frame: computed in the last period, acting now (delay 1.5) */
    pmsm_dq reference_held;  /* A, governed reference of the last period */
    pmsm_dq disturbance;     /* V, observer */
    pmsm_real speed_integrator;   /* N m */
    pmsm_real omega_filtered;     /* rad/s mechanical */
    pmsm_real omega_ref_ramped;   /* rad/s mechanical */
    pmsm_real notch_1, notch_2;
    pmsm_real i2t;           /* 0..1 of the budget */
    pmsm_dq fw_reference;    /* A */
    uint32_t fw_count;       /* periods since the last optimisation */
    uint32_t speed_count;
    pmsm_polar_state polar;
    pmsm_real tau_speed;     /* N m, last output of the speed controller */
    pmsm_live live;
    /* private to the core */
    pmsm_dq voltage_before;  /* V, stator frame: computed one period before voltage_committed */
    pmsm_dq current_before;  /* A, sampled in the last period */
    pmsm_dq reference_realised; /* A, reference of the last period that its limited voltage stood for */
    pmsm_dq news_before;     /* V, what the last period said beside disturbance */
    pmsm_dq news_mean;       /* V, its mean over some 20 periods */
    pmsm_real tau_granted;   /* N m, torque of the reference that the limits left */
    pmsm_real time_to_go;    /* s, of the minimum-time transfer in progress, 0 when there is none */
    pmsm_dq reachable;       /* A, a request's projection on steady-state and current row */
    uint32_t reachable_age;  /* 1: computed in the last period, 0: not valid */
    pmsm_real reachable_multiplier; /* line search: of the steady-state row in that projection */
    pmsm_dq corner;          /* A, line search: where the search for the corner of both rows is */
    uint32_t cornered;       /* steps of that search, 255: found */
    uint32_t landing;        /* 1: a minimum-time transfer has not reached its target yet */
    pmsm_real fw_tau;        /* N m, request of the last optimisation */
    pmsm_real fw_U_dc;       /* V, link of the last optimisation */
    uint32_t fw_left;        /* iterations that it has left for the following periods */
    pmsm_real fw_momentum;   /* of its last iteration, and the point ahead from which the next one starts (A) */
    pmsm_dq fw_ahead;
    pmsm_real fw_multiplier; /* of the voltage row in its last projection */
    uint32_t fw_corner_state; /* whether that was on the current row, too */
    uint32_t fw_empty;       /* 1: it found no current that satisfies both limits */
    uint32_t lut_cut;        /* 1 + the last node of the torque axis inside the current limit, 0: torque was not cut */
    pmsm_real i2t_carry;     /* rounding remainder of i2t */
    uint32_t i2t_exhausted;  /* 1 from a used-up budget until a tenth of it has recovered */
    uint32_t bad_periods;    /* running, up to now */
    uint32_t fault;          /* enum pmsm_fault, latched */
    uint32_t gates_before;   /* of the last period */
    uint32_t shorted;        /* 1: the fault reaction shorts the windings */
    pmsm_real U_dc_slow;     /* V, mean over some 2 ms */
    pmsm_real U_dc_before;   /* V, of the last good period */
    uint32_t prepared;       /* 0 fresh from pmsm_init(), 1 derived is valid, 2 derived is stale */
    pmsm_derived derived;
    pmsm_magnetics local;    /* at the present current, with a saturation table */
    pmsm_dq harmonic_committed; /* V, stator frame: what overmodulation adds to voltage_committed, and before to that */
    pmsm_dq harmonic_before;
    pmsm_dq harmonic_flux;   /* Wb, stator frame: that it has made */
    pmsm_dq harmonic_mean;   /* A, rotor frame: mean of its current */
} pmsm_state;

/* Clear the memory (all zero, kappa 1, binding 255); call at start-up and after another parameter set. */
PMSM_EXPORT void pmsm_init(pmsm_state *state);

/* Parameters changed while the controller runs (live gains): keep its memory, renew what was derived from them. */
PMSM_EXPORT void pmsm_parameters_changed(pmsm_state *state);

/* After a latched fault: control again from the next period on, from rest. */
PMSM_EXPORT void pmsm_reset_fault(pmsm_state *state);

/* One PWM period. A period whose inputs are no usable numbers (NaN but for T_winding, where it says that there is no
 * sensor; infinite; larger than any drive's) holds the last voltage and changes nothing else; a second one running is
 * a latched fault. lut points to the words behind pmsm_params in the image, may be NULL if
 * lut_format and saturation_n_d are 0. */
PMSM_EXPORT void pmsm_step(pmsm_state *state, const pmsm_params *params, const uint32_t *lut,
                           const pmsm_measurement *measurement, const pmsm_reference *reference,
                           pmsm_output *output);

#ifdef __cplusplus
}
#endif

#endif
