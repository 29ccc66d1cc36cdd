/* SPDX-License-Identifier: MIT */
/* Phase equations of the machine.
 *
 * Coil x links the flux  lambda_x = sum_y L_xy(theta) m_y + magnet_x(theta) + damper currents through it,  with the
 * inductances of sinusoidal windings behind a gap whose permeance has a mean and a second harmonic, and the magnet's
 * field wave with its 5th, 7th and 11th space harmonic. The core is a resistor across each coil's induced voltage:
 * terminal current = m + iron. Eddy currents in the rotor are two short-circuited coils on its axes. One step is the
 * trapezoid of all circuits at the angle where the step ends, solved for the line currents; the shaft is
 * velocity-Verlet with a predicted speed. Both are of second order, the electrical one stable for any step.
 */
#include "phase_machine.h"

#include <math.h>
#include <string.h>

/* Step against the winding's time constant, the electrical angle (rad) and the eddy currents' time constant: the
 * trapezoid's rate is wrong by a twelfth of the square, 3e-5 of R and 3e-3 of the eddy rate. */
#define STEP_OF_WINDING 0.02
#define STEP_OF_ANGLE 0.02
#define STEP_OF_EDDY 0.2
#define SHORTEST 1e-13 /* s, of a step */
#define LEAKAGE_SHARE 0.1 /* of the smaller inductance; seen by no current of an isolated star */

static const double HALF_SQRT3 = 0.86602540378443864676;
static const double TURN = 6.28318530717958647693;

typedef struct {
    double c[3], s[3];         /* cosine, sine of theta_e less the coil's direction */
    double L[3][3];            /* H */
    double magnet[3], slope[3]; /* Wb, and its derivative with respect to theta_e */
} coils;

/* Cosine and sine of n x from those of x, n 5, 7 or 11. */
static void multiple(int n, double c, double s, double *cn, double *sn)
{
    const double z = c * c;
    if (n == 5) {
        *cn = c * (5.0 + z * (-20.0 + 16.0 * z));
        *sn = s * (1.0 + z * (-12.0 + 16.0 * z));
    } else if (n == 7) {
        *cn = c * (-7.0 + z * (56.0 + z * (-112.0 + 64.0 * z)));
        *sn = s * (-1.0 + z * (24.0 + z * (-80.0 + 64.0 * z)));
    } else {
        *cn = c * (-11.0 + z * (220.0 + z * (-1232.0 + z * (2816.0 + z * (-2816.0 + 1024.0 * z)))));
        *sn = s * (-1.0 + z * (60.0 + z * (-560.0 + z * (1792.0 + z * (-2304.0 + 1024.0 * z)))));
    }
}

static void wind(const pmsm_plant *plant, double theta_M, coils *at)
{
    const pmsm_machine *machine = &plant->machine;
    const double theta = machine->pole_pairs * theta_M;
    const double c = cos(theta), s = sin(theta);
    const double strength = machine->psi_f != 0.0 ? plant->psi_m / machine->psi_f : 1.0;
    const double order_5 = strength * machine->psi_6, order_7 = strength * machine->psi_7,
                 order_11 = strength * machine->psi_12;
    const double leakage = LEAKAGE_SHARE * fmin(machine->L_d, machine->L_q);
    const double mean = (0.5 * (machine->L_d + machine->L_q) - leakage) / 1.5;
    const double second = (machine->L_d - machine->L_q) / 3.0;
    at->c[0] = c;
    at->s[0] = s;
    at->c[1] = -0.5 * c + HALF_SQRT3 * s;
    at->s[1] = -0.5 * s - HALF_SQRT3 * c;
    at->c[2] = -0.5 * c - HALF_SQRT3 * s;
    at->s[2] = -0.5 * s + HALF_SQRT3 * c;
    for (int x = 0; x < 3; x++) {
        at->magnet[x] = plant->psi_m * at->c[x];
        at->slope[x] = -plant->psi_m * at->s[x];
        const double size[3] = {order_5, order_7, order_11};
        static const int order[3] = {5, 7, 11};
        for (int k = 0; k < 3; k++) {
            double cn, sn;
            if (size[k] == 0.0)
                continue;
            multiple(order[k], at->c[x], at->s[x], &cn, &sn);
            at->magnet[x] += size[k] * cn;
            at->slope[x] -= (double)order[k] * size[k] * sn;
        }
        for (int y = 0; y < 3; y++)
            at->L[x][y] = (x == y ? leakage + mean : -0.5 * mean)
                          + second * (at->c[x] * at->c[y] - at->s[x] * at->s[y]);
    }
}

/* Component along the rotor's axis d, and q. */
static double along_d(const coils *at, const double x[3])
{
    return (x[0] * at->c[0] + x[1] * at->c[1] + x[2] * at->c[2]) * (2.0 / 3.0);
}

static double along_q(const coils *at, const double x[3])
{
    return -(x[0] * at->s[0] + x[1] * at->s[1] + x[2] * at->s[2]) * (2.0 / 3.0);
}

static void own_currents(const pmsm_plant *plant, double m[3])
{
    m[0] = plant->OWN_M_A;
    m[1] = plant->OWN_M_B;
    m[2] = -m[0] - m[1];
}

static void own_flux(const pmsm_plant *plant, double flux[3])
{
    flux[0] = plant->state.psi_alpha;
    flux[1] = -0.5 * plant->state.psi_alpha + HALF_SQRT3 * plant->state.psi_beta;
    flux[2] = -0.5 * plant->state.psi_alpha - HALF_SQRT3 * plant->state.psi_beta;
}

/* From the co-energy of coils, magnet and damper coils. */
static double air_gap_torque(const pmsm_plant *plant, const coils *at, const double m[3], double damper_d,
                             double damper_q)
{
    const pmsm_machine *machine = &plant->machine;
    const double second = (machine->L_d - machine->L_q) / 3.0;
    double sum = 0.0;
    for (int x = 0; x < 3; x++) {
        for (int y = 0; y < 3; y++) /* d/dtheta of second * cos(2 theta - x - y), halved for the energy */
            sum -= second * m[x] * m[y] * (at->s[x] * at->c[y] + at->c[x] * at->s[y]);
        sum += m[x] * (at->slope[x] - machine->L_d * damper_d * at->s[x] - machine->L_q * damper_q * at->c[x]);
    }
    return machine->pole_pairs * sum;
}

/* ---- one step -------------------------------------------------------------------------------------------- */

double phase_longest_step(const pmsm_plant *plant, double r)
{
    const pmsm_machine *machine = &plant->machine;
    const double omega = fabs(machine->pole_pairs * plant->state.omega_M);
    double h = STEP_OF_WINDING * fmin(machine->L_d, machine->L_q) / (plant->R + r);
    if (omega * h > STEP_OF_ANGLE)
        h = STEP_OF_ANGLE / omega;
    if (machine->eddy_rate > 0.0)
        h = fmin(h, STEP_OF_EDDY / machine->eddy_rate);
    return h;
}

/* Trapezoid of a damper coil, L_m (i' + m') + leakage i' + R i = 0: its current is past - share * m. */
static void damper_step(double L_m, double eddy, double rate, double h, double i, double m, double *past,
                        double *share)
{
    *past = *share = 0.0;
    if (rate <= 0.0 || eddy <= 0.0)
        return;
    const double leakage = 1.0 / eddy, drop = 0.5 * h * rate / eddy;
    const double inverse = 1.0 / (L_m + leakage + drop);
    *past = ((L_m + leakage - drop) * i + L_m * m) * inverse;
    *share = L_m * inverse;
}

static void solve(double a[3][4], double x[3])
{
    const double m00 = a[1][1] * a[2][2] - a[1][2] * a[2][1], m10 = a[1][0] * a[2][2] - a[1][2] * a[2][0],
                 m20 = a[1][0] * a[2][1] - a[1][1] * a[2][0];
    const double inverse = 1.0 / (a[0][0] * m00 - a[0][1] * m10 + a[0][2] * m20);
    const double b0 = a[0][3], b1 = a[1][3], b2 = a[2][3];
    x[0] = (b0 * m00 - a[0][1] * (b1 * a[2][2] - a[1][2] * b2) + a[0][2] * (b1 * a[2][1] - a[1][1] * b2)) * inverse;
    x[1] = (a[0][0] * (b1 * a[2][2] - a[1][2] * b2) - b0 * m10 + a[0][2] * (a[1][0] * b2 - b1 * a[2][0])) * inverse;
    x[2] = (a[0][0] * (a[1][1] * b2 - b1 * a[2][1]) - a[0][1] * (a[1][0] * b2 - b1 * a[2][0]) + b0 * m20) * inverse;
}

void phase_try(const pmsm_plant *plant, const phase_sources *sources, double h, phase_step *step)
{
    const pmsm_machine *machine = &plant->machine;
    const pmsm_plant_state *state = &plant->state;
    const double direction = machine->rotor == PMSM_ROTOR_FREE ? shaft_direction(plant, state->torque) : 0.0;
    const shaft_acceleration a0 = shaft_accelerate(plant, state->theta_M, state->omega_M, state->twist,
                                                   state->omega_load, state->torque, direction);
    const double iron = machine->R_iron > 0.0 ? 1.0 / machine->R_iron : 0.0;
    double m0[3], flux0[3], rows[3][4], x[3];
    double past_d, share_d, past_q, share_q;
    coils at;
    int connected = 0;

    step->h = h;
    step->theta = state->theta_M + h * (state->omega_M + 0.5 * h * a0.rotor);
    step->twist = state->twist + h * (state->omega_M - state->omega_load + 0.5 * h * (a0.rotor - a0.load));
    wind(plant, step->theta, &at);
    own_currents(plant, m0);
    own_flux(plant, flux0);
    damper_step(machine->L_d, machine->eddy_d, machine->eddy_rate, h, plant->OWN_DAMPER_D, state->i_d, &past_d,
                &share_d);
    damper_step(machine->L_q, machine->eddy_q, machine->eddy_rate, h, plant->OWN_DAMPER_Q, state->i_q, &past_q,
                &share_q);
    const double react_d = machine->L_d * share_d * (2.0 / 3.0), react_q = machine->L_q * share_q * (2.0 / 3.0);
    double held[3];
    for (int j = 0; j < 3; j++) {
        for (int k = 0; k < 3; k++)
            at.L[j][k] -= react_d * at.c[j] * at.c[k] + react_q * at.s[j] * at.s[k];
        held[j] = at.magnet[j] + machine->L_d * past_d * at.c[j] - machine->L_q * past_q * at.s[j] - flux0[j];
    }
    for (int j = 0; j < 3; j++) { /* unknown: m of a, m of b, voltage of the star point */
        const double of_a = at.L[j][0] - at.L[j][2], of_b = at.L[j][1] - at.L[j][2];
        const double own_a = j == 0 ? 1.0 : j == 2 ? -1.0 : 0.0, own_b = j == 1 ? 1.0 : j == 2 ? -1.0 : 0.0;
        double flux_rate, current, rhs, star;
        if (sources->blocked[j]) {
            flux_rate = iron / h;
            current = 1.0;
            rhs = 0.0;
            star = 0.0;
        } else {
            const double r = plant->R + sources->r[j];
            flux_rate = (1.0 + r * iron) / h;
            current = 0.5 * r;
            rhs = sources->v[j] - 0.5 * r * m0[j];
            star = 1.0;
            connected++;
        }
        rows[j][0] = flux_rate * of_a + current * own_a;
        rows[j][1] = flux_rate * of_b + current * own_b;
        rows[j][2] = star;
        rows[j][3] = rhs - flux_rate * held[j];
    }
    if (!connected) { /* the third row says nothing new, and the star point is nowhere */
        const double nowhere[4] = {0.0, 0.0, 1.0, 0.0};
        memcpy(rows[2], nowhere, sizeof nowhere);
    }
    solve(rows, x);
    step->m[0] = x[0];
    step->m[1] = x[1];
    step->m[2] = -x[0] - x[1];
    for (int j = 0; j < 3; j++) {
        const double change = held[j] + at.L[j][0] * step->m[0] + at.L[j][1] * step->m[1] + at.L[j][2] * step->m[2];
        step->emf[j] = change / h;
        step->flux[j] = flux0[j] + change;
        step->iron[j] = iron * step->emf[j];
        step->i_start[j] = sources->blocked[j] ? 0.0 : m0[j] + step->iron[j];
        step->i_mean[j] = sources->blocked[j] ? 0.0 : 0.5 * (m0[j] + step->m[j]) + step->iron[j];
        step->i_end[j] = sources->blocked[j] ? 0.0 : step->m[j] + step->iron[j];
        step->u[j] = step->emf[j] + plant->R * step->i_mean[j];
        step->v_leg[j] = sources->blocked[j] ? x[2] + step->u[j] : sources->v[j];
    }
    step->damper_d = past_d - share_d * along_d(&at, step->m);
    step->damper_q = past_q - share_q * along_q(&at, step->m);
    memcpy(step->cosine, at.c, sizeof at.c);
    memcpy(step->sine, at.s, sizeof at.s);
    step->torque = air_gap_torque(plant, &at, step->m, step->damper_d, step->damper_q);

    const double omega_guess = state->omega_M + h * a0.rotor, load_guess = state->omega_load + h * a0.load;
    const shaft_acceleration a1 =
        shaft_accelerate(plant, step->theta, omega_guess, step->twist, load_guess, step->torque, direction);
    step->omega = state->omega_M + 0.5 * h * (a0.rotor + a1.rotor);
    step->omega_load = state->omega_load + 0.5 * h * (a0.load + a1.load);
    if (machine->rotor == PMSM_ROTOR_LOCKED)
        step->omega = step->omega_load = 0.0;
    step->rest_after = 1.0;
    if (machine->rotor == PMSM_ROTOR_FREE && machine->tau_c > 0.0 && direction * step->omega <= 0.0) {
        /* at rest: held, or off in the other direction, from the next step on */
        if (direction != 0.0)
            step->rest_after = state->omega_M / (state->omega_M - step->omega);
        step->omega = 0.0;
    }
}

void phase_try_to_rest(const pmsm_plant *plant, const phase_sources *sources, double h, phase_step *step)
{
    phase_try(plant, sources, h, step);
    if (step->rest_after * h > SHORTEST && step->rest_after < 1.0) {
        phase_try(plant, sources, step->rest_after * h, step);
        step->omega = 0.0;
    }
}

/* Write what follows from coil currents and the rotor. */
static void show(pmsm_plant *plant, const coils *at, const double m[3], const double i[3])
{
    pmsm_plant_state *state = &plant->state;
    state->cos_e = at->c[0];
    state->sin_e = at->s[0];
    state->i_d = along_d(at, m);
    state->i_q = along_q(at, m);
    phase_vector(i, &state->i_alpha, &state->i_beta);
    state->torque = air_gap_torque(plant, at, m, plant->OWN_DAMPER_D, plant->OWN_DAMPER_Q);
}

void phase_accept(pmsm_plant *plant, const phase_step *step)
{
    pmsm_plant_state *state = &plant->state;
    const double half = 0.5 * TURN;
    state->theta_M = step->theta;
    if (state->theta_M >= half) {
        state->theta_M -= TURN;
        state->turns++;
    } else if (state->theta_M < -half) {
        state->theta_M += TURN;
        state->turns--;
    }
    state->omega_M = step->omega;
    state->twist = plant->machine.J_load > 0.0 ? step->twist : 0.0;
    state->omega_load = plant->machine.J_load > 0.0 ? step->omega_load : step->omega;
    state->sticking = plant->machine.rotor == PMSM_ROTOR_FREE && step->omega == 0.0;
    phase_vector(step->flux, &state->psi_alpha, &state->psi_beta);
    plant->OWN_M_A = step->m[0];
    plant->OWN_M_B = step->m[1];
    plant->OWN_DAMPER_D = step->damper_d;
    plant->OWN_DAMPER_Q = step->damper_q;
    plant->OWN_IRON_A = step->iron[0];
    plant->OWN_IRON_B = step->iron[1];
    phase_vector(step->u, &plant->u_alpha, &plant->u_beta);
    state->cos_e = step->cosine[0];
    state->sin_e = step->sine[0];
    double d = 0.0, q = 0.0;
    for (int x = 0; x < 3; x++) {
        d += step->m[x] * step->cosine[x];
        q -= step->m[x] * step->sine[x];
    }
    state->i_d = d * (2.0 / 3.0);
    state->i_q = q * (2.0 / 3.0);
    phase_vector(step->i_end, &state->i_alpha, &state->i_beta);
    state->torque = step->torque;
}

/* ---- what the closed loop asks of a plant ----------------------------------------------------------------- */

void pmsm_plant_set_temperatures(pmsm_plant *plant, double T_winding, double T_magnet)
{
    const pmsm_machine *machine = &plant->machine;
    plant->T_winding = T_winding;
    plant->T_magnet = T_magnet;
    plant->R = machine->R_copper * (1.0 + machine->alpha_R * (T_winding - machine->T_ref)) + machine->R_fixed;
    plant->psi_m = machine->psi_f * (1.0 + machine->alpha_psi * (T_magnet - machine->T_ref));
    plant->iron_factor = 0.0; /* this plant's terminal currents hold the iron current already */
}

void pmsm_plant_refresh(pmsm_plant *plant)
{
    const pmsm_machine *machine = &plant->machine;
    coils at;
    double flux[3], rest[3], m[3];
    wind(plant, plant->state.theta_M, &at);
    own_flux(plant, flux);
    for (int x = 0; x < 3; x++)
        rest[x] = flux[x] - at.magnet[x];
    const double m_d = along_d(&at, rest) / machine->L_d - plant->OWN_DAMPER_D;
    const double m_q = along_q(&at, rest) / machine->L_q - plant->OWN_DAMPER_Q;
    for (int x = 0; x < 3; x++)
        m[x] = m_d * at.c[x] - m_q * at.s[x];
    plant->OWN_M_A = m[0];
    plant->OWN_M_B = m[1];
    const double iron[3] = {plant->OWN_IRON_A, plant->OWN_IRON_B, -plant->OWN_IRON_A - plant->OWN_IRON_B};
    const double i[3] = {m[0] + iron[0], m[1] + iron[1], m[2] + iron[2]};
    show(plant, &at, m, i);
}

void pmsm_plant_start(pmsm_plant *plant, double theta_M, double omega_M)
{
    coils at;
    pmsm_plant_set_temperatures(plant, plant->T_winding, plant->T_magnet);
    const double turns = floor(theta_M / TURN + 0.5);
    plant->state.turns = (int64_t)turns;
    plant->state.theta_M = theta_M - turns * TURN;
    plant->state.omega_M = plant->machine.rotor == PMSM_ROTOR_LOCKED ? 0.0 : omega_M;
    plant->state.omega_load = plant->state.omega_M;
    wind(plant, plant->state.theta_M, &at);
    phase_vector(at.magnet, &plant->state.psi_alpha, &plant->state.psi_beta);
    pmsm_plant_refresh(plant);
}

void pmsm_plant_clear_current(pmsm_plant *plant, int x)
{
    const pmsm_machine *machine = &plant->machine;
    double m[3], i[3], flux[3];
    coils at;
    own_currents(plant, m);
    if (x < 3) { /* the others share what it carried */
        const double half = 0.5 * m[x];
        for (int y = 0; y < 3; y++)
            m[y] = y == x ? 0.0 : m[y] + half;
    } else {
        m[0] = m[1] = m[2] = 0.0;
    }
    wind(plant, plant->state.theta_M, &at);
    for (int y = 0; y < 3; y++) {
        flux[y] = at.magnet[y] + at.L[y][0] * m[0] + at.L[y][1] * m[1] + at.L[y][2] * m[2]
                  + machine->L_d * plant->OWN_DAMPER_D * at.c[y] - machine->L_q * plant->OWN_DAMPER_Q * at.s[y];
        i[y] = m[y];
    }
    phase_vector(flux, &plant->state.psi_alpha, &plant->state.psi_beta);
    plant->OWN_M_A = m[0];
    plant->OWN_M_B = m[1];
    plant->OWN_IRON_A = plant->OWN_IRON_B = 0.0;
    show(plant, &at, m, i);
}

void pmsm_plant_heat(pmsm_plant *plant, double h)
{
    const pmsm_machine *machine = &plant->machine;
    const double copper = machine->R_copper * (1.0 + machine->alpha_R * (plant->T_winding - machine->T_ref));
    double flow = 0.0;
    for (int x = 0; x < 3; x++) {
        const double i = pmsm_plant_leg_current(plant, x);
        flow += copper * i * i;
    }
    if (machine->thermal_resistance > 0.0)
        flow -= (plant->T_winding - machine->T_ambient) / machine->thermal_resistance;
    pmsm_plant_set_temperatures(plant, plant->T_winding + h * flow / machine->thermal_capacity, plant->T_magnet);
}

/* A vector of voltage at ideal terminals, for pmsm_sim_drive_plant(): the supply's legs and their errors are the other
 * bridge's and do not occur here. */
void pmsm_plant_advance(pmsm_plant *plant, const pmsm_supply *supply, double h)
{
    phase_sources sources = {{supply->alpha, -0.5 * supply->alpha + HALF_SQRT3 * supply->beta,
                              -0.5 * supply->alpha - HALF_SQRT3 * supply->beta},
                             {supply->series, supply->series, supply->series},
                             {0, 0, 0}};
    phase_step step;
    while (h > SHORTEST) {
        const double pieces = ceil(h / phase_longest_step(plant, supply->series));
        phase_try_to_rest(plant, &sources, h / pieces, &step);
        phase_accept(plant, &step);
        h -= step.h;
    }
}
