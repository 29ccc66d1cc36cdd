/* SPDX-License-Identifier: MIT */
/* One point of the machine's trajectory: fluxes, angle and the currents they give. Internal to sim/. */
#ifndef PMSM_PLANT_POINT_H
#define PMSM_PLANT_POINT_H

#include "elementary.h"
#include "plant.h"

/* A point of the trajectory inside an interval. */
typedef struct {
    double psi_alpha, psi_beta, c, s; /* Wb; cosine and sine of theta_e */
    double chi_d, chi_q;              /* Wb */
    double d_chi_d, d_chi_q;          /* V */
    double i_d, i_q, i_alpha, i_beta;
} pmsm_point;

/* Harmonics of the magnet flux at angle (c, s): value and derivative with respect to theta_e. */
static inline void pmsm_magnet_harmonics(const pmsm_plant *m, double c, double s, double h[2], double dh[2])
{
    const double psi_6 = m->magnet_strength * m->machine.psi_6, psi_7 = m->magnet_strength * m->machine.psi_7;
    const double psi_12 = m->magnet_strength * m->machine.psi_12;
    const double c2 = c * c - s * s, s2 = 2.0 * c * s;
    const double c3 = c2 * c - s2 * s, s3 = s2 * c + c2 * s;
    const double c6 = c3 * c3 - s3 * s3, s6 = 2.0 * c3 * s3;
    const double c12 = c6 * c6 - s6 * s6, s12 = 2.0 * c6 * s6;
    const double even = psi_6 + psi_7, odd = psi_6 - psi_7;
    h[0] = even * c6 + psi_12 * c12;
    h[1] = -odd * s6 - psi_12 * s12;
    dh[0] = -6.0 * even * s6 - 12.0 * psi_12 * s12;
    dh[1] = -6.0 * odd * c6 - 12.0 * psi_12 * c12;
}

/* What di/dpsi has beside its mean at angle (c, s), as dd, dq, qq, and its derivative with respect to theta_e. Phase a
 * with the share e above the mean is e/2 of the mean in alpha and against it in beta. */
static inline void pmsm_uneven_reluctance(const pmsm_plant *m, double c, double s, double g[3], double dg[3])
{
    const double c2 = c * c - s * s, s2 = 2.0 * c * s;
    const double c3 = c2 * c - s2 * s, s3 = s2 * c + c2 * s;
    const double c6 = c3 * c3 - s3 * s3, s6 = 2.0 * c3 * s3;
    const double a = 0.25 * m->machine.L_imbalance * (m->L_d_inverse + m->L_q_inverse), b = m->machine.L_6;
    g[0] = -a * c2 - b * c6 * m->L_d_inverse;
    g[1] = a * s2;
    g[2] = a * c2 - b * c6 * m->L_q_inverse;
    dg[0] = 2.0 * a * s2 + 6.0 * b * s6 * m->L_d_inverse;
    dg[1] = 2.0 * a * c2;
    dg[2] = -2.0 * a * s2 + 6.0 * b * s6 * m->L_q_inverse;
}

/* Flux of the currents at a point: without magnet and harmonics; not with a map. */
static inline void pmsm_current_flux(const pmsm_plant *m, const pmsm_point *at, double psi[2])
{
    double h[2] = {0.0, 0.0}, dh[2];
    if (m->has_harmonics)
        pmsm_magnet_harmonics(m, at->c, at->s, h, dh);
    psi[0] = at->c * at->psi_alpha + at->s * at->psi_beta - h[0] - m->psi_m;
    psi[1] = at->c * at->psi_beta - at->s * at->psi_alpha - h[1];
}

/* Currents of a point from its flux and angle. */
static inline void pmsm_find_currents(pmsm_plant *m, pmsm_point *at)
{
    const double c = at->c, s = at->s;
    double psi_d = c * at->psi_alpha + s * at->psi_beta;
    double psi_q = c * at->psi_beta - s * at->psi_alpha;
    if (m->has_harmonics) {
        double h[2], dh[2];
        pmsm_magnet_harmonics(m, c, s, h, dh);
        psi_d -= h[0];
        psi_q -= h[1];
    }
    if (m->machine.map) {
        uint32_t outside;
        const pmsm_flux_map_dq i =
            pmsm_flux_map_current(m->machine.map, &m->near, psi_d - m->psi_shift, psi_q, &outside);
        m->outside_count += outside != 0u;
        at->i_d = i.d;
        at->i_q = i.q;
    } else {
        at->i_d = (psi_d - m->psi_m) * m->L_d_inverse;
        at->i_q = psi_q * m->L_q_inverse;
        if (m->is_uneven) {
            double g[3], dg[3];
            pmsm_uneven_reluctance(m, c, s, g, dg);
            at->i_d += g[0] * (psi_d - m->psi_m) + g[1] * psi_q;
            at->i_q += g[1] * (psi_d - m->psi_m) + g[2] * psi_q;
        }
    }
    if (m->machine.eddy_rate > 0.0) {
        const double slip_d = psi_d - at->chi_d, slip_q = psi_q - at->chi_q;
        at->i_d += m->machine.eddy_d * slip_d;
        at->i_q += m->machine.eddy_q * slip_q;
        at->d_chi_d = m->machine.eddy_rate * slip_d;
        at->d_chi_q = m->machine.eddy_rate * slip_q;
    }
    at->i_alpha = c * at->i_d - s * at->i_q;
    at->i_beta = s * at->i_d + c * at->i_q;
}

/* What harmonics and uneven coils add to flux times current. */
double pmsm_point_uneven_torque(const pmsm_plant *m, const pmsm_point *at);

static inline double pmsm_air_gap_torque(const pmsm_plant *m, const pmsm_point *at)
{
    double flux_current = at->psi_alpha * at->i_beta - at->psi_beta * at->i_alpha;
    if (m->has_harmonics | m->is_uneven)
        flux_current += pmsm_point_uneven_torque(m, at);
    return 1.5 * m->machine.pole_pairs * flux_current;
}

/* Make a point the state. */
static inline void pmsm_keep_point(pmsm_plant *m, const pmsm_point *at)
{
    pmsm_plant_state *state = &m->state;
    state->psi_alpha = at->psi_alpha;
    state->psi_beta = at->psi_beta;
    state->chi_d = at->chi_d;
    state->chi_q = at->chi_q;
    state->d_chi_d = at->d_chi_d;
    state->d_chi_q = at->d_chi_q;
    state->i_d = at->i_d;
    state->i_q = at->i_q;
    state->i_alpha = at->i_alpha;
    state->i_beta = at->i_beta;
    state->torque = pmsm_air_gap_torque(m, at);
}

static inline pmsm_point pmsm_point_here(const pmsm_plant_state *state)
{
    const pmsm_point at = {.psi_alpha = state->psi_alpha,
                           .psi_beta = state->psi_beta,
                           .c = state->cos_e,
                           .s = state->sin_e,
                           .chi_d = state->chi_d,
                           .chi_q = state->chi_q,
                           .d_chi_d = state->d_chi_d,
                           .d_chi_q = state->d_chi_q,
                           .i_d = state->i_d,
                           .i_q = state->i_q,
                           .i_alpha = state->i_alpha,
                           .i_beta = state->i_beta};
    return at;
}

/* Leg voltages behind slope and error at the point's currents. */
void pmsm_point_leg_voltages(const pmsm_plant *m, const pmsm_supply *supply, const pmsm_point *at, double v[3]);

/* Voltage of leg x that keeps its current, the others at v: solves d i_x/dt = 0, which is linear in v_x.
 * slope_per_volt may be null. */
double pmsm_point_hold_voltage(const pmsm_plant *m, const pmsm_point *at, double omega_e, int x,
                               const double v_legs[3], double *slope_per_volt);

#define PMSM_ALL_LEGS 3 /* pmsm_supply.blocked, pmsm_plant_clear_current() */

#endif
