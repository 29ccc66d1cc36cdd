/* SPDX-License-Identifier: MIT */
/* The machine between the steps: start, temperatures, and what the legs' circuit asks of it; see plant.h. */
#include <stddef.h>

#include "plant_point.h"

#define ZERO_FLUX_STEPS 20 /* Newton steps to the flux without current */

/* di_dq/dpsi_dq at a point (A/Wb). */
static void find_reluctance(const pmsm_plant *m, const pmsm_point *at, double g[4])
{
    if (m->machine.map) {
        double h[2] = {0.0, 0.0}, dh[2], i[2];
        if (m->has_harmonics)
            pmsm_magnet_harmonics(m, at->c, at->s, h, dh);
        const double psi_d = at->c * at->psi_alpha + at->s * at->psi_beta - h[0] - m->psi_shift;
        const double psi_q = at->c * at->psi_beta - at->s * at->psi_alpha - h[1];
        (void)pmsm_flux_map_current_jacobian(m->machine.map, psi_d, psi_q, i, g);
    } else {
        g[0] = m->L_d_inverse;
        g[1] = 0.0;
        g[2] = 0.0;
        g[3] = m->L_q_inverse;
        if (m->is_uneven) {
            double uneven[3], slope[3];
            pmsm_uneven_reluctance(m, at->c, at->s, uneven, slope);
            g[0] += uneven[0];
            g[1] += uneven[1];
            g[2] += uneven[1];
            g[3] += uneven[2];
        }
    }
    if (m->machine.eddy_rate > 0.0) {
        g[0] += m->machine.eddy_d;
        g[3] += m->machine.eddy_q;
    }
}

double pmsm_point_uneven_torque(const pmsm_plant *m, const pmsm_point *at)
{
    double sum = 0.0;
    if (m->has_harmonics) { /* from the co-energy: i . d psi_pm / d theta_e */
        double h[2], dh[2];
        pmsm_magnet_harmonics(m, at->c, at->s, h, dh);
        sum += at->i_d * dh[0] + at->i_q * dh[1];
    }
    if (m->is_uneven) { /* from the field energy: -psi' (dg/d theta_e) psi' / 2 */
        double g[3], dg[3], psi[2];
        pmsm_uneven_reluctance(m, at->c, at->s, g, dg);
        pmsm_current_flux(m, at, psi);
        sum -= 0.5 * (dg[0] * psi[0] + 2.0 * dg[1] * psi[1]) * psi[0] + 0.5 * dg[2] * psi[1] * psi[1];
    }
    return sum;
}

void pmsm_point_leg_voltages(const pmsm_plant *m, const pmsm_supply *supply, const pmsm_point *at, double v[3])
{
    for (int x = 0; x < 3; x++) {
        const double i = pmsm_leg_alpha[x] * (at->i_alpha + m->iron_alpha)
                         + pmsm_leg_beta[x] * (at->i_beta + m->iron_beta);
        v[x] = supply->v[x] - supply->r[x] * i;
        if (supply->error)
            v[x] -= pmsm_leg_error_voltage(supply->error, x, i);
    }
}

double pmsm_point_hold_voltage(const pmsm_plant *m, const pmsm_point *at, double omega_e, int x,
                               const double v_legs[3], double *slope_per_volt)
{
    const double c = at->c, s = at->s;
    double v[3] = {v_legs[0], v_legs[1], v_legs[2]}, g[4], u_alpha, u_beta;
    v[x] = 0.0;
    pmsm_leg_vector(v, &u_alpha, &u_beta);
    const double w_alpha = (u_alpha - m->R * at->i_alpha) * m->iron_factor;
    const double w_beta = (u_beta - m->R * at->i_beta) * m->iron_factor;
    const double psi_d = c * at->psi_alpha + s * at->psi_beta, psi_q = c * at->psi_beta - s * at->psi_alpha;
    double d_psi_d = c * w_alpha + s * w_beta + omega_e * psi_q;
    double d_psi_q = c * w_beta - s * w_alpha - omega_e * psi_d;
    if (m->has_harmonics) {
        double h[2], dh[2];
        pmsm_magnet_harmonics(m, c, s, h, dh);
        d_psi_d -= omega_e * dh[0];
        d_psi_q -= omega_e * dh[1];
    }
    find_reluctance(m, at, g);
    const double n_d = c * pmsm_leg_alpha[x] + s * pmsm_leg_beta[x], n_q = c * pmsm_leg_beta[x] - s * pmsm_leg_alpha[x];
    double di_d = g[0] * d_psi_d + g[1] * d_psi_q - omega_e * at->i_q;
    double di_q = g[2] * d_psi_d + g[3] * d_psi_q + omega_e * at->i_d;
    if (m->is_uneven) {
        double uneven[3], slope[3], psi[2];
        pmsm_uneven_reluctance(m, c, s, uneven, slope);
        pmsm_current_flux(m, at, psi);
        di_d += omega_e * (slope[0] * psi[0] + slope[1] * psi[1]);
        di_q += omega_e * (slope[1] * psi[0] + slope[2] * psi[1]);
    }
    if (m->machine.eddy_rate > 0.0) {
        di_d -= m->machine.eddy_d * at->d_chi_d;
        di_q -= m->machine.eddy_q * at->d_chi_q;
    }
    const double per_volt = (2.0 / 3.0) * m->iron_factor
                            * (n_d * (g[0] * n_d + g[1] * n_q) + n_q * (g[2] * n_d + g[3] * n_q));
    if (slope_per_volt)
        *slope_per_volt = per_volt;
    return -(n_d * di_d + n_q * di_q) / per_volt;
}

void pmsm_plant_refresh(pmsm_plant *m)
{
    pmsm_real64_sincos(m->machine.pole_pairs * m->state.theta_M, &m->state.sin_e, &m->state.cos_e);
    m->state.turned = 0;
    pmsm_point at = pmsm_point_here(&m->state);
    pmsm_find_currents(m, &at);
    pmsm_keep_point(m, &at);
}

void pmsm_plant_set_temperatures(pmsm_plant *m, double T_winding, double T_magnet)
{
    const pmsm_machine *k = &m->machine;
    m->T_winding = T_winding;
    m->T_magnet = T_magnet;
    m->R = k->R_copper * (1.0 + k->alpha_R * (T_winding - k->T_ref)) + k->R_fixed;
    m->psi_shift = k->psi_f * k->alpha_psi * (T_magnet - k->T_ref);
    m->psi_m = k->psi_f + m->psi_shift;
    m->magnet_strength = 1.0 + k->alpha_psi * (T_magnet - k->T_ref);
    m->iron_factor = k->R_iron > 0.0 ? 1.0 / (1.0 + m->R / k->R_iron) : 1.0;
    const double psi_open = k->map ? m->psi_zero_d + m->psi_shift : m->psi_m;
    m->iron_drag = k->R_iron > 0.0 ? 1.5 * k->pole_pairs * k->pole_pairs * psi_open * psi_open / k->R_iron : 0.0;
}

/* Flux of the inverse table at zero current, by Newton from the map's own value. */
static void find_zero_flux(pmsm_plant *m)
{
    double psi[2] = {0.0, 0.0}, i[2], g[4];
    (void)pmsm_flux_map_flux(m->machine.map, 0.0, 0.0, psi, NULL);
    for (int n = 0; n < ZERO_FLUX_STEPS; n++) {
        (void)pmsm_flux_map_current_jacobian(m->machine.map, psi[0], psi[1], i, g);
        const double det = g[0] * g[3] - g[1] * g[2];
        psi[0] -= (g[3] * i[0] - g[1] * i[1]) / det;
        psi[1] -= (g[0] * i[1] - g[2] * i[0]) / det;
    }
    m->psi_zero_d = psi[0];
    m->psi_zero_q = psi[1];
}

void pmsm_plant_start(pmsm_plant *m, double theta_M, double omega_M)
{
    const pmsm_plant_state clear = {0};
    const double turns = theta_M / PMSM_REAL64_TWO_PI;
    m->state = clear;
    m->state.turns = (int64_t)(turns < 0.0 ? turns - 0.5 : turns + 0.5);
    m->state.theta_M = theta_M - (double)m->state.turns * PMSM_REAL64_TWO_PI;
    m->state.omega_M = m->machine.rotor == PMSM_ROTOR_LOCKED ? 0.0 : omega_M;
    m->state.omega_load = m->state.omega_M;
    m->L_d_inverse = m->machine.map ? 0.0 : 1.0 / m->machine.L_d;
    m->L_q_inverse = m->machine.map ? 0.0 : 1.0 / m->machine.L_q;
    m->has_harmonics = m->machine.psi_6 != 0.0 || m->machine.psi_12 != 0.0 || m->machine.psi_7 != 0.0;
    m->is_uneven = m->machine.L_6 != 0.0 || m->machine.L_imbalance != 0.0;
    m->rotation_h = -1.0;
    m->near.cell = NULL;
    m->u_alpha = m->u_beta = m->iron_alpha = m->iron_beta = 0.0;
    if (m->machine.map)
        find_zero_flux(m);
    pmsm_plant_set_temperatures(m, m->T_winding, m->T_magnet);
    pmsm_real64_sincos(m->machine.pole_pairs * m->state.theta_M, &m->state.sin_e, &m->state.cos_e);
    pmsm_plant_clear_current(m, PMSM_ALL_LEGS);
    m->outside_count = m->event_overruns = 0;
}

double pmsm_plant_hold_voltage(const pmsm_plant *m, const pmsm_supply *supply, int x, double *slope_per_volt)
{
    const pmsm_point at = pmsm_point_here(&m->state);
    double v[3];
    pmsm_point_leg_voltages(m, supply, &at, v);
    return pmsm_point_hold_voltage(m, &at, m->machine.pole_pairs * m->state.omega_M, x, v, slope_per_volt);
}

static void zero_current_flux(const pmsm_plant *m, double c, double s, double *psi_d, double *psi_q)
{
    double h[2] = {0.0, 0.0}, dh[2];
    if (m->has_harmonics)
        pmsm_magnet_harmonics(m, c, s, h, dh);
    *psi_d = (m->machine.map ? m->psi_zero_d + m->psi_shift : m->psi_m) + h[0];
    *psi_q = (m->machine.map ? m->psi_zero_q : 0.0) + h[1];
}

void pmsm_plant_emf(const pmsm_plant *m, double emf[3])
{
    const double c = m->state.cos_e, s = m->state.sin_e, omega_e = m->machine.pole_pairs * m->state.omega_M;
    double psi_d, psi_q, h[2], dh[2] = {0.0, 0.0};
    zero_current_flux(m, c, s, &psi_d, &psi_q);
    if (m->has_harmonics)
        pmsm_magnet_harmonics(m, c, s, h, dh);
    const double u_d = omega_e * (dh[0] - psi_q), u_q = omega_e * (dh[1] + psi_d);
    for (int x = 0; x < 3; x++)
        emf[x] = pmsm_leg_alpha[x] * (c * u_d - s * u_q) + pmsm_leg_beta[x] * (s * u_d + c * u_q);
}

void pmsm_plant_set_iron_current(pmsm_plant *m, double u_alpha, double u_beta)
{
    const double per_volt = m->machine.R_iron > 0.0 ? m->iron_factor / m->machine.R_iron : 0.0;
    m->iron_alpha = (u_alpha - m->R * m->state.i_alpha) * per_volt;
    m->iron_beta = (u_beta - m->R * m->state.i_beta) * per_volt;
}

void pmsm_plant_clear_current(pmsm_plant *m, int x)
{
    pmsm_point at = pmsm_point_here(&m->state);
    if (x == PMSM_ALL_LEGS) {
        double psi_d, psi_q;
        zero_current_flux(m, at.c, at.s, &psi_d, &psi_q);
        at.psi_alpha = at.c * psi_d - at.s * psi_q;
        at.psi_beta = at.s * psi_d + at.c * psi_q;
        at.i_d = at.i_q = at.i_alpha = at.i_beta = 0.0;
        at.chi_d = psi_d; /* eddy currents are gone when the terminals open */
        at.chi_q = psi_q;
        at.d_chi_d = at.d_chi_q = 0.0;
    } else {
        for (int n = 0; n < 2; n++) { /* one step is exact for constant inductances */
            double g[4];
            find_reluctance(m, &at, g);
            const double n_d = at.c * pmsm_leg_alpha[x] + at.s * pmsm_leg_beta[x];
            const double n_q = at.c * pmsm_leg_beta[x] - at.s * pmsm_leg_alpha[x];
            const double i = pmsm_leg_alpha[x] * (at.i_alpha + m->iron_alpha)
                             + pmsm_leg_beta[x] * (at.i_beta + m->iron_beta);
            const double k = -i / (n_d * (g[0] * n_d + g[1] * n_q) + n_q * (g[2] * n_d + g[3] * n_q));
            at.psi_alpha += k * pmsm_leg_alpha[x];
            at.psi_beta += k * pmsm_leg_beta[x];
            pmsm_find_currents(m, &at);
        }
    }
    pmsm_keep_point(m, &at);
}

void pmsm_plant_heat(pmsm_plant *m, double h)
{
    const pmsm_machine *k = &m->machine;
    const double i2 = m->state.i_d * m->state.i_d + m->state.i_q * m->state.i_q;
    const double R_copper = k->R_copper * (1.0 + k->alpha_R * (m->T_winding - k->T_ref));
    const double loss = 1.5 * R_copper * i2;
    const double T = m->T_winding
                     + h * (loss - (m->T_winding - k->T_ambient) / k->thermal_resistance) / k->thermal_capacity;
    pmsm_plant_set_temperatures(m, T, m->T_magnet);
}

double pmsm_plant_smallest_inductance(const pmsm_plant *m)
{
    const pmsm_flux_map *map = m->machine.map;
    double smallest = m->machine.L_d < m->machine.L_q ? m->machine.L_d : m->machine.L_q;
    if (!map)
        return smallest;
    smallest = 0.0;
    for (int32_t j = 0; j < map->n_i_d; j++) {
        for (int32_t k = 0; k < map->n_i_q; k++) {
            double psi[2], L[4];
            (void)pmsm_flux_map_flux(map, map->i_d[j], map->i_q[k], psi, L);
            /* smaller eigenvalue of the symmetric part */
            const double half = 0.5 * (L[0] - L[3]), cross = 0.5 * (L[1] + L[2]);
            const double eigenvalue = 0.5 * (L[0] + L[3]) - sqrt(half * half + cross * cross);
            if (eigenvalue > 0.0 && (smallest == 0.0 || eigenvalue < smallest))
                smallest = eigenvalue;
        }
    }
    return smallest;
}
