/* SPDX-License-Identifier: MIT */
/* The inverter: duty ratios and gate release in, leg voltages of the plant out.
 *
 * Two models behind one switch, both written apart from every estimator.
 *
 * averaged  one leg voltage per PWM period, d U_dc, minus an error that depends on the leg's current as
 *           the current moves (evaluated in every RK4 stage): dead time V f(i / i_knee) with V = U_dc
 *           t_dead / T_s and one of five shapes f, device threshold V_d tanh(i / i_knee), slope r i.
 * switched  every edge of the centre-aligned PWM: per-leg dead time, commutation of the node by the phase
 *           current through the output capacitance, switch and diode with their own threshold and slope,
 *           suppressed minimum pulses, real current ripple. A leg whose current reaches zero against
 *           its thresholds stays without current until the circuit drives one again.
 *
 * Gates off and open phases are circuits in both models: diodes against the DC link, and no path at all.
 * The DC link is held over a PWM period; what the machine gives and takes in it is counted where asked. The period starts where all legs are low: sampling there meets
 * the ripple's mean.
 */
#ifndef PMSM_INVERTER_H
#define PMSM_INVERTER_H

#include <stdint.h>

#include "plant.h"

enum pmsm_inverter_model { PMSM_INVERTER_AVERAGED = 0, PMSM_INVERTER_SWITCHED = 1 };

enum pmsm_deadtime_shape {
    PMSM_DEADTIME_NONE = 0,
    PMSM_DEADTIME_SIGN,      /* resolved as tanh within the current one substep can move */
    PMSM_DEADTIME_ATAN,      /* (2/pi) atan x */
    PMSM_DEADTIME_TANH,
    PMSM_DEADTIME_CAPACITIVE /* x/2 for |x| < 1, else sgn(x) (1 - 1/(2 |x|)) */
};

typedef struct pmsm_leg_error {
    uint32_t shape;
    double V_dead[3];        /* V, plateau of each leg */
    double i_knee_inverse;   /* 1/A */
    double V_device;         /* V */
} pmsm_leg_error;

typedef struct {
    uint32_t model, shape;
    double dead_time[3];     /* s, each leg */
    double i_knee;           /* A, averaged shapes */
    double V_switch, r_switch; /* V, ohm; V_switch 0: a channel that conducts both ways */
    double V_diode, r_diode; /* V, ohm */
    double r_leg[3];         /* ohm, further resistance of each leg: a bad joint */
    double capacitance;      /* F, of a leg's output node; 0: the node follows at once */
    double minimum_pulse;    /* s, shorter pulses of either polarity are not made */
    uint32_t open[3];        /* 1: no connection to the machine */
} pmsm_inverter_setup;

enum pmsm_gate { PMSM_GATE_NONE = 0, PMSM_GATE_TOP, PMSM_GATE_BOTTOM };

typedef struct {
    uint32_t gate;           /* enum pmsm_gate: which transistor is closed */
    uint32_t target;         /* level the PWM asks for */
    double close_at;         /* s in this period: when the target's transistor closes; large: never */
    double edge[3];          /* s in this period: when the target toggles */
    uint32_t edges, next_edge;
    double v_node;           /* V, while the node moves on its capacitance */
    int32_t sign;            /* of its current; 0: carries none */
} pmsm_leg;

/* First-order low-pass of the three leg currents (the sensors' bandwidth). */
typedef struct {
    double tau;              /* s, 0: off */
    double value[3];         /* A */
    double decay_h, decay;   /* exp(-h/tau) of the last interval length */
} pmsm_current_lag;

typedef struct {
    pmsm_inverter_setup setup;
    pmsm_leg leg[3];
    pmsm_leg_error error;
    pmsm_supply averaged;    /* supply of this period, averaged model */
    double T_s, U_dc;
    uint32_t exact;          /* 1: averaged without any error */
    double L_min, brief_rate; /* H, sets substeps; 1/s, of the shortest time constant over the midpoint rule's reach */
    double error_rate;       /* 1/s, of the averaged error at its steepest */
    uint32_t gates;
    uint32_t circuit;        /* 1: legs are treated as circuits (gates off, an open phase, or switched) */
    uint32_t substeps;       /* per period, averaged model */
    double volt_seconds_alpha, volt_seconds_beta; /* V s since the start of the period, at the terminals */
    double elapsed;          /* s in the period */
    uint32_t metered;        /* 1: energy is counted */
    double energy;           /* J into the machine since the start of the period */
    uint64_t event_overruns; /* intervals left before all zero crossings were resolved */
} pmsm_inverter;

/* Legs low, gates off, no current. */
void pmsm_inverter_start(pmsm_inverter *inverter, const pmsm_plant *plant);

/* Start a PWM period of length T_s: duty ratios (0..1), gates 1: switch, 0: all transistors off. */
void pmsm_inverter_begin(pmsm_inverter *inverter, const double duty[3], uint32_t gates, double U_dc, double T_s);

/* Move the plant from t_from to t_to (s in this period). lag may be null. */
void pmsm_inverter_run(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double t_from, double t_to);

/* Smallest output capacitance (F) whose commutation is resolved; 0 needs none. */
PMSM_EXPORT double pmsm_inverter_smallest_capacitance(double dead_time, double L_min);

#endif
