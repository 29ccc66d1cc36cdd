/* SPDX-License-Identifier: MIT */
/* The second plant: three phase coils, a magnet, damper and iron circuits, a shaft. Internal to this folder.
 *
 * Written from the data sheet (the parameters in sim/plant.h) by someone who had not read the first plant: phase
 * equations with winding functions, line currents as unknowns of Kirchhoff's equations, implicit trapezoid.
 */
#ifndef SECOND_PLANT_PHASE_MACHINE_H
#define SECOND_PLANT_PHASE_MACHINE_H

#include "plant.h"

/* Own memory: members of pmsm_plant that nobody outside the plant reads. The coils' magnetising currents of a and b
 * (c is minus their sum), the damper currents of both rotor axes, the iron currents of a and b. */
#define OWN_M_A rotation_h
#define OWN_M_B rotation_omega
#define OWN_DAMPER_D half_cos
#define OWN_DAMPER_Q half_sin
#define OWN_IRON_A full_cos
#define OWN_IRON_B full_sin

/* What feeds the three terminals during one step. */
typedef struct {
    double v[3];       /* V above DC minus, of the source behind its resistance, mean over the step */
    double r[3];       /* ohm between source and terminal */
    int blocked[3];    /* 1: no current */
} phase_sources;

/* Where the machine is at the end of one step; nothing of the plant is changed until the step is accepted. */
typedef struct {
    double h;                                  /* s */
    double theta, omega, twist, omega_load;    /* rad, rad/s */
    double cosine[3], sine[3];                 /* of theta_e less each coil's direction */
    double m[3], damper_d, damper_q, iron[3];  /* A; iron: mean over the step */
    double flux[3];                            /* Wb */
    double i_start[3], i_mean[3], i_end[3];    /* A, at the terminals */
    double v_leg[3];                           /* V above DC minus at the source, mean; of a blocked leg: at its terminal */
    double emf[3];                             /* V, mean change of flux */
    double u[3];                               /* V, mean, terminal to star point */
    double torque;                             /* N m, air gap */
    double rest_after;                         /* share of the step after which the rotor comes to rest, 1: it does not */
} phase_step;

void phase_try(const pmsm_plant *plant, const phase_sources *sources, double h, phase_step *step);
void phase_accept(pmsm_plant *plant, const phase_step *step);
/* Try a step, shortened to where the rotor comes to rest if it does. */
void phase_try_to_rest(const pmsm_plant *plant, const phase_sources *sources, double h, phase_step *step);

/* Longest step (s) with r ohm outside the winding. */
double phase_longest_step(const pmsm_plant *plant, double r);

/* shaft.c: acceleration of rotor and second mass. *rotor is 0 while Coulomb friction holds; direction is the sign of
 * the friction during the step. */
typedef struct {
    double rotor, load;
} shaft_acceleration;
shaft_acceleration shaft_accelerate(const pmsm_plant *plant, double theta, double omega, double twist,
                                    double omega_load, double torque, double direction);
/* Sign of motion for a step that starts at omega: of a rotor at rest the one it will take, 0 when it is held. */
double shaft_direction(const pmsm_plant *plant, double torque);

static inline void phase_vector(const double x[3], double *alpha, double *beta)
{
    *alpha = (2.0 * x[0] - x[1] - x[2]) / 3.0;
    *beta = (x[1] - x[2]) / 1.73205080756887729353;
}

#endif
