/* SPDX-License-Identifier: MIT */
/* The machine as it is: stator flux, rotor, temperatures.
 *
 * State is the stator flux linkage in the stationary frame, psi' = u - R i(psi, theta), integrated by one
 * RK4 step per interval of constant terminal voltage (`plant.c`). Rotation and applied voltage are
 * then exact and only the small resistive term is approximated. Amplitude-invariant (peak) values,
 * SI, rotor angle mechanical unless the name says _e. The plant knows terminal voltages and leg
 * currents only: nothing of the controller, nothing of the estimators.
 */
#ifndef PMSM_PLANT_H
#define PMSM_PLANT_H

#include <stdint.h>

#include "flux_map.h"

enum pmsm_rotor {
    PMSM_ROTOR_FREE = 0,   /* moves by its torque */
    PMSM_ROTOR_LOCKED = 1, /* held */
    PMSM_ROTOR_DRIVEN = 2  /* turned by a load machine at an imposed speed */
};

typedef struct {
    double pole_pairs;
    double R_copper, R_fixed;      /* ohm at T_ref; only the copper part follows the temperature */
    double L_d, L_q, psi_f;        /* H, H, Wb at T_ref; unused with a map but for psi_f' = alpha_psi psi_f */
    double T_ref, alpha_R, alpha_psi;
    const pmsm_flux_map *map;      /* null: constant inductances; else the inverse table is the machine */
    double R_iron;                 /* ohm, parallel to the flux voltage; 0 off */
    double eddy_d, eddy_q, eddy_rate; /* 1/H, 1/H, 1/s: i += eddy (psi - chi), chi' = eddy_rate (psi - chi); 0 off */
    double psi_6, psi_12, psi_7;   /* Wb: psi_dq += psi_6 exp(-6 j theta_e) + psi_12 exp(-12 j theta_e)
                                      + psi_7 exp(6 j theta_e), 5th, 11th and 7th of a phase; 0 off */
    double J, B, tau_c;            /* kg m2, N m s, N m */
    double load_viscous;           /* N m s, of the load */
    double drag;                   /* N m s2, of air: torque per square of the speed */
    double cogging, cogging_periods; /* N m, periods per mechanical turn */
    double thermal_resistance, thermal_capacity, T_ambient; /* K/W, J/K, degC; capacity 0: T_winding is held */
    uint32_t rotor;                /* enum pmsm_rotor */
    double J_load, coupling_stiffness, coupling_damping; /* second mass behind a shaft; J_load 0: one mass */
    double backlash;               /* rad, whole play of the shaft */
    double stribeck, stribeck_speed; /* tau_c (1 + stribeck exp(-(omega/stribeck_speed)^2)); 1, rad/s */
    double friction_once;          /* tau_c (1 + friction_once sin(theta_M)) */
    double cogging_slot, cogging_slot_periods, cogging_pole, cogging_pole_periods; /* of tolerances, as cogging */
    double L_6, L_imbalance;       /* shares: di/dpsi (1 - L_6 cos 6 theta_e), phase a above the mean; not with a map */
} pmsm_machine;

typedef struct {
    double psi_alpha, psi_beta;    /* Wb */
    double chi_d, chi_q;           /* Wb, rotor frame: flux behind the eddy currents */
    double theta_M;                /* rad in [-pi, pi) */
    double omega_M;                /* rad/s */
    int64_t turns;
    double twist, omega_load;      /* rad (rotor ahead of the second mass), rad/s */
    /* functions of the above, kept current */
    double cos_e, sin_e;
    double d_chi_d, d_chi_q;       /* V */
    double i_d, i_q, i_alpha, i_beta; /* A, at the terminals but for the iron current */
    double torque;                 /* N m, of the air gap */
    uint32_t sticking;             /* 1: held by Coulomb friction */
    uint32_t turned;               /* steps since cos_e, sin_e were computed from theta_M */
} pmsm_plant_state;

/* Averaged inverter error of one leg as a function of its current (inverter.c). */
struct pmsm_leg_error;
double pmsm_leg_error_voltage(const struct pmsm_leg_error *error, int leg, double i);
double pmsm_leg_dead_voltage(const struct pmsm_leg_error *error, int leg, double i); /* its dead time alone */

/* What the three terminals do during one interval. */
typedef struct {
    double v[3];                   /* V above DC minus, each leg; behind its slope r and its error */
    double r[3];                   /* ohm */
    const struct pmsm_leg_error *error; /* null: none */
    int32_t blocked;               /* leg that carries no current (its v is ignored), -1 none, 3 all */
    int32_t general;               /* 0: v alone counts and alpha, beta hold its vector */
    int32_t brief;                 /* 1: so short that the midpoint rule does (R h / L below 1e-3) */
    double alpha, beta;            /* V */
    double series;                 /* ohm, in every leg; what r holds when general is 0 */
} pmsm_supply;

typedef struct {
    pmsm_machine machine;
    pmsm_plant_state state;
    double T_winding, T_magnet;    /* degC */
    double load;                   /* N m, positive against positive rotation */
    double acceleration;           /* rad/s2, of a driven rotor */
    uint64_t outside_count;        /* flux-map evaluations outside the map */
    uint64_t event_overruns;       /* intervals left before all their events were resolved */
    /* of the temperatures, by pmsm_plant_set_temperatures() */
    double R, psi_m, psi_shift;    /* ohm; Wb, magnet flux; Wb, its difference to the one at T_ref */
    double magnet_strength;        /* magnet flux and its harmonics over those at T_ref */
    double L_d_inverse, L_q_inverse, iron_factor;
    double iron_drag;              /* N m s/rad, of a rotor that turns without stator current */
    uint32_t has_harmonics, is_uneven; /* 1: psi_6 to psi_7; L_6, L_imbalance are not all 0 */
    double psi_zero_d, psi_zero_q; /* Wb: flux of the map without current, at T_ref */
    double friction_sign;          /* of the Coulomb torque during this interval: -1, 0, 1 */
    /* rotation over the last interval length and speed, a constant-speed run uses it again */
    double rotation_h, rotation_omega, half_cos, half_sin, full_cos, full_sin;
    pmsm_flux_map_near near;
    double u_alpha, u_beta;        /* V, at the end of the last interval */
    double iron_alpha, iron_beta;  /* A, in the iron-loss resistor: the terminals carry it beside i_alpha, i_beta */
} pmsm_plant;

/* Rotor at theta_M, speed omega_M, no current. machine and temperatures are set before. */
void pmsm_plant_start(pmsm_plant *plant, double theta_M, double omega_M);

/* Let R(T) and psi(T) follow the temperatures; the stator flux keeps its value. */
void pmsm_plant_set_temperatures(pmsm_plant *plant, double T_winding, double T_magnet);

/* Let the iron-loss resistor take what a mean terminal voltage drives through it. */
void pmsm_plant_set_iron_current(pmsm_plant *plant, double u_alpha, double u_beta);

/* Integrate over one interval, stick-slip of the rotor included. */
void pmsm_plant_advance(pmsm_plant *plant, const pmsm_supply *supply, double h);

/* Recompute what is a function of flux and angle. */
void pmsm_plant_refresh(pmsm_plant *plant);

/* Voltage (V above DC minus) that leg x needs so that its current does not change, and, where asked, the
 * change of that current's slope per volt (A/(V s)). */
double pmsm_plant_hold_voltage(const pmsm_plant *plant, const pmsm_supply *supply, int x, double *slope_per_volt);

/* Phase voltages that hold all three currents at zero: the undriven back-EMF (V). */
void pmsm_plant_emf(const pmsm_plant *plant, double emf[3]);

/* Make the current of leg x exactly zero by the smallest change of flux; x = 3: all three. */
void pmsm_plant_clear_current(pmsm_plant *plant, int x);

/* Direction of each leg in the stator frame. */
static const double pmsm_leg_alpha[3] = {1.0, -0.5, -0.5};
static const double pmsm_leg_beta[3] = {0.0, 0.86602540378443864676, -0.86602540378443864676};

/* Current of leg x (A). */
static inline double pmsm_plant_leg_current(const pmsm_plant *plant, int x)
{
    return pmsm_leg_alpha[x] * (plant->state.i_alpha + plant->iron_alpha)
           + pmsm_leg_beta[x] * (plant->state.i_beta + plant->iron_beta);
}

/* Copper loss heats the winding over h seconds. */
void pmsm_plant_heat(pmsm_plant *plant, double h);

/* Smallest differential inductance of the machine, over the nodes of its map if it has one (H). */
double pmsm_plant_smallest_inductance(const pmsm_plant *plant);

/* Stator-frame voltage of three leg voltages. */
static inline void pmsm_leg_vector(const double v[3], double *alpha, double *beta)
{
    *alpha = (2.0 * v[0] - v[1] - v[2]) * (1.0 / 3.0);
    *beta = (v[1] - v[2]) * (1.0 / 1.73205080756887729353);
}

#endif
