/* SPDX-License-Identifier: MIT */
/* A machine that saturates by a closed form, at an imposed speed and with ideal terminals: no flux map, no table.
 *
 *   psi_d' = u_d - R i_d + omega_e psi_q      psi_q' = u_q - R i_q - omega_e psi_d      i = i(psi)
 *
 * in the rotor's frame, the classical Runge-Kutta step over PIECES parts of each interval, where the project's plant
 * steps a stationary flux and reads a spline. i(psi) is that of benchmarks/analytic_saturation.py (M. Lelli,
 * M. Hinkkanen, F. Giulii Capponi, ICEM 2024, DOI 10.1109/ICEM60801.2024.10700403).
 */
#include <math.h>

#include "plant.h"

#define PIECES 8
#define PROBE 1e-4 /* Wb, of the largest slope di/dpsi at the origin */

static const double TURN = 6.28318530717958647693;
static const double HALF_SQRT3 = 0.86602540378443864676;

/* As BridgeSaturation. a in A/Wb, psi_n in Wb. */
typedef struct {
    double a_d0, a_dd, a_q0, a_qq, a_dq, a_b, k_q, psi_n;
} saturation;

static saturation form;

typedef struct {
    double d, q;
} dq;

__attribute__((visibility("default"))) void saturated_machine_set(const double constants[8])
{
    const saturation given = {constants[0], constants[1], constants[2], constants[3],
                              constants[4], constants[5], constants[6], constants[7]};
    form = given;
}

static dq current_of(dq psi)
{
    const double d = fabs(psi.d), q = fabs(psi.q), bridge = psi.d - form.psi_n;
    const double s = bridge * bridge + form.k_q * q * q, g_b = form.a_b * s / (1.0 + s);
    const double g_d = form.a_d0 + form.a_dd * pow(d, 4.0) + form.a_dq / 3.0 * d * pow(q, 3.0);
    const double g_q = form.a_q0 + form.a_qq * pow(q, 6.0) + form.a_dq / 3.0 * pow(d, 3.0) * q;
    const dq i = {g_d * psi.d + g_b * bridge, (g_q + form.k_q * g_b) * psi.q};
    return i;
}

static dq flux_of(const pmsm_plant *plant)
{
    const pmsm_plant_state *state = &plant->state;
    const dq psi = {state->cos_e * state->psi_alpha + state->sin_e * state->psi_beta,
                    state->cos_e * state->psi_beta - state->sin_e * state->psi_alpha};
    return psi;
}

static void show(pmsm_plant *plant, dq psi)
{
    pmsm_plant_state *state = &plant->state;
    const double theta = plant->machine.pole_pairs * state->theta_M;
    const dq i = current_of(psi);
    state->cos_e = cos(theta);
    state->sin_e = sin(theta);
    state->psi_alpha = state->cos_e * psi.d - state->sin_e * psi.q;
    state->psi_beta = state->sin_e * psi.d + state->cos_e * psi.q;
    state->i_d = i.d;
    state->i_q = i.q;
    state->i_alpha = state->cos_e * i.d - state->sin_e * i.q;
    state->i_beta = state->sin_e * i.d + state->cos_e * i.q;
    state->torque = 1.5 * plant->machine.pole_pairs * (psi.d * i.q - psi.q * i.d);
}

/* The flux without current: i_q = 0 at psi_q = 0, i_d rises with psi_d. */
static dq flux_without_current(void)
{
    dq low = {0.0, 0.0}, high = {form.psi_n, 0.0};
    for (int k = 0; k < 60; k++) {
        const dq middle = {0.5 * (low.d + high.d), 0.0};
        if (current_of(middle).d < 0.0)
            low = middle;
        else
            high = middle;
    }
    return low;
}

void pmsm_plant_set_temperatures(pmsm_plant *plant, double T_winding, double T_magnet)
{
    const pmsm_machine *machine = &plant->machine;
    plant->T_winding = T_winding;
    plant->T_magnet = T_magnet; /* the field is that of one temperature */
    plant->R = machine->R_copper * (1.0 + machine->alpha_R * (T_winding - machine->T_ref)) + machine->R_fixed;
}

void pmsm_plant_start(pmsm_plant *plant, double theta_M, double omega_M)
{
    pmsm_plant_set_temperatures(plant, plant->T_winding, plant->T_magnet);
    plant->state.theta_M = theta_M - TURN * floor(theta_M / TURN + 0.5);
    plant->state.omega_M = omega_M;
    show(plant, flux_without_current());
}

void pmsm_plant_refresh(pmsm_plant *plant)
{
    show(plant, flux_of(plant));
}

/* omega_e turns the voltage, which stands still between two switchings, backwards in the rotor's frame. */
static dq slope(const pmsm_plant *plant, const pmsm_supply *supply, dq psi, double theta, double omega_e)
{
    const double c = cos(theta), s = sin(theta), R = plant->R + supply->series;
    const dq i = current_of(psi);
    const dq change = {c * supply->alpha + s * supply->beta - R * i.d + omega_e * psi.q,
                       c * supply->beta - s * supply->alpha - R * i.q - omega_e * psi.d};
    return change;
}

static dq along(dq from, double h, dq change)
{
    const dq to = {from.d + h * change.d, from.q + h * change.q};
    return to;
}

void pmsm_plant_advance(pmsm_plant *plant, const pmsm_supply *supply, double whole)
{
    pmsm_plant_state *state = &plant->state;
    const double p = plant->machine.pole_pairs, a = plant->acceleration, h = whole / PIECES;
    dq psi = flux_of(plant);
    double theta_M = state->theta_M, omega_M = state->omega_M;
    for (int k = 0; k < PIECES; k++) {
        const double middle = theta_M + 0.5 * h * (omega_M + 0.25 * a * h), end = theta_M + h * (omega_M + 0.5 * a * h);
        const double w_middle = p * (omega_M + 0.5 * a * h), w_end = p * (omega_M + a * h);
        const dq k1 = slope(plant, supply, psi, p * theta_M, p * omega_M);
        const dq k2 = slope(plant, supply, along(psi, 0.5 * h, k1), p * middle, w_middle);
        const dq k3 = slope(plant, supply, along(psi, 0.5 * h, k2), p * middle, w_middle);
        const dq k4 = slope(plant, supply, along(psi, h, k3), p * end, w_end);
        psi.d += h / 6.0 * (k1.d + 2.0 * (k2.d + k3.d) + k4.d);
        psi.q += h / 6.0 * (k1.q + 2.0 * (k2.q + k3.q) + k4.q);
        theta_M = end;
        omega_M += a * h;
    }
    if (supply->blocked >= 0) /* all legs: nothing flows */
        psi = flux_without_current();
    const double turns = floor(theta_M / TURN + 0.5);
    state->turns += (int64_t)turns;
    state->theta_M = theta_M - TURN * turns;
    state->omega_M = omega_M;
    show(plant, psi);
    plant->u_alpha = supply->alpha;
    plant->u_beta = supply->beta;
}

void pmsm_plant_set_iron_current(pmsm_plant *plant, double u_alpha, double u_beta)
{
    (void)u_alpha;
    (void)u_beta;
    plant->iron_alpha = plant->iron_beta = 0.0;
}

/* What only a bridge with floating legs asks for. */
double pmsm_plant_hold_voltage(const pmsm_plant *plant, const pmsm_supply *supply, int x, double *slope_per_volt)
{
    (void)plant;
    (void)slope_per_volt;
    return supply->v[x];
}

void pmsm_plant_emf(const pmsm_plant *plant, double emf[3])
{
    const double E = plant->machine.pole_pairs * plant->state.omega_M * flux_without_current().d;
    const double c = plant->state.cos_e, s = plant->state.sin_e;
    emf[0] = -E * s;
    emf[1] = E * (0.5 * s + HALF_SQRT3 * c);
    emf[2] = E * (0.5 * s - HALF_SQRT3 * c);
}

void pmsm_plant_clear_current(pmsm_plant *plant, int x)
{
    (void)x;
    show(plant, flux_without_current());
}

void pmsm_plant_heat(pmsm_plant *plant, double h)
{
    (void)plant;
    (void)h;
}

double pmsm_plant_smallest_inductance(const pmsm_plant *plant)
{
    (void)plant;
    const dq rest = flux_without_current(), d = {rest.d + PROBE, 0.0}, q = {rest.d, PROBE};
    return PROBE / fmax(current_of(d).d, current_of(q).q);
}
