/* SPDX-License-Identifier: MIT */
/* The machine: one RK4 step of stator flux, speed and angle per interval; see plant.h.
 *
 * psi_dq = R(-theta_e) psi_ab, i_ab = R(theta_e) i_dq(psi_dq), psi_ab' = u_ab - R i_ab.
 */
#include <stddef.h>

#include "plant_point.h"

#define EVENTS_MAX 8        /* speed reversals inside one interval; more is counted as an overrun */
#define SECANT_STEPS 3      /* to the instant of standstill, from a nearly straight speed */
#define TURNS_MAX 64u       /* steps by multiplication before sine and cosine are computed afresh: drift below 1e-14 */

/* Stator-frame terminal voltage at a point. */
static inline void terminal_voltage(const pmsm_plant *m, const pmsm_supply *supply, const pmsm_point *at, double omega_e,
                                    const int general, double *u_alpha, double *u_beta)
{
    if (general) {
        double v[3];
        pmsm_point_leg_voltages(m, supply, at, v);
        if (supply->blocked >= 0)
            v[supply->blocked] = pmsm_point_hold_voltage(m, at, omega_e, supply->blocked, v, NULL);
        pmsm_leg_vector(v, u_alpha, u_beta);
    } else {
        *u_alpha = supply->alpha;
        *u_beta = supply->beta;
    }
}

/* ---- mechanical side ---------------------------------------------------------------------------- */

static inline double cogging_torque(double amplitude, double periods, double theta_M)
{
    double s, c;
    if (amplitude == 0.0)
        return 0.0;
    pmsm_real64_sincos(periods * theta_M, &s, &c);
    return amplitude * s;
}

/* Coulomb torque at an angle and a speed; the largest of a speed at rest. */
static inline double coulomb_torque(const pmsm_machine *k, double theta_M, double omega)
{
    double torque = k->tau_c;
    if (k->friction_once != 0.0) {
        double s, c;
        pmsm_real64_sincos(theta_M, &s, &c);
        torque *= 1.0 + k->friction_once * s;
    }
    if (k->stribeck > 0.0) {
        const double x = omega / k->stribeck_speed;
        torque *= 1.0 + k->stribeck * pmsm_real64_exp(-x * x);
    }
    return torque;
}

/* Accelerations of rotor and second mass (rad/s2) at speeds omega, omega_load and angle theta_M. */
static inline void accelerations(const pmsm_plant *m, double torque, double theta_M, double omega, double twist,
                                 double omega_load, double *rotor, double *load)
{
    const pmsm_machine *k = &m->machine;
    double net = torque - (k->B + k->drag * pmsm_real64_abs(omega)) * omega;
    if (m->friction_sign != 0.0)
        net -= m->friction_sign * coulomb_torque(k, theta_M, omega);
    net -= cogging_torque(k->cogging, k->cogging_periods, theta_M);
    net -= cogging_torque(k->cogging_slot, k->cogging_slot_periods, theta_M);
    net -= cogging_torque(k->cogging_pole, k->cogging_pole_periods, theta_M);
    if (k->J_load > 0.0) {
        const double play = 0.5 * k->backlash;
        const double bent = twist > play ? twist - play : twist < -play ? twist + play : 0.0;
        const double shaft = play > 0.0 && bent == 0.0
                                 ? 0.0
                                 : k->coupling_stiffness * bent + k->coupling_damping * (omega - omega_load);
        *load = (shaft - m->load - k->load_viscous * omega_load) / k->J_load;
        net -= shaft;
    } else {
        *load = 0.0;
        net -= m->load + k->load_viscous * omega;
    }
    *rotor = net / k->J;
}

/* cos, sin of an angle increment and their product with (c, s). */
static inline void rotate(double c, double s, double increment, double *c_out, double *s_out)
{
    double ds, dc;
    if (increment == 0.0) {
        *c_out = c;
        *s_out = s;
        return;
    }
    if (increment < PMSM_REAL64_SINCOS_SMALL_MAX && increment > -PMSM_REAL64_SINCOS_SMALL_MAX)
        pmsm_real64_sincos_small(increment, &ds, &dc);
    else
        pmsm_real64_sincos(increment, &ds, &dc);
    *c_out = c * dc - s * ds;
    *s_out = s * dc + c * ds;
}

static inline void set_angle(pmsm_plant_state *state, double theta_M)
{
    if (theta_M >= PMSM_REAL64_PI) {
        theta_M -= PMSM_REAL64_TWO_PI;
        state->turns++;
    } else if (theta_M < -PMSM_REAL64_PI) {
        theta_M += PMSM_REAL64_TWO_PI;
        state->turns--;
    }
    state->theta_M = theta_M;
}

/* ---- one step ------------------------------------------------------------------------------------- */

/* The point h along the given slopes, at another angle; its currents are still those of `from`. */
static inline pmsm_point moved(const pmsm_point *from, double h, double d_alpha, double d_beta, double d_chi_d,
                               double d_chi_q, double c, double s)
{
    pmsm_point at = *from;
    at.psi_alpha += h * d_alpha;
    at.psi_beta += h * d_beta;
    at.chi_d += h * d_chi_d;
    at.chi_q += h * d_chi_q;
    at.c = c;
    at.s = s;
    return at;
}

/* Flux with the angle given: locked, driven, or held by friction. */
static inline void step_imposed(pmsm_plant *m, const pmsm_supply *supply, double h, double omega, double acceleration,
                                const int general)
{
    pmsm_plant_state *state = &m->state;
    const double p = m->machine.pole_pairs, R = m->R + supply->series, f = m->iron_factor;
    const double half_h = 0.5 * h, omega_half = omega + acceleration * half_h, omega_full = omega + acceleration * h;
    const pmsm_point first = pmsm_point_here(state);
    pmsm_point mid, last;
    double u_alpha, u_beta, k1a, k1b, k2a, k2b;

    if (m->rotation_h != h || m->rotation_omega != omega || acceleration != 0.0) {
        rotate(1.0, 0.0, p * half_h * (omega + 0.5 * acceleration * half_h), &m->half_cos, &m->half_sin);
        if (acceleration == 0.0) { /* twice the angle */
            m->full_cos = 1.0 - 2.0 * m->half_sin * m->half_sin;
            m->full_sin = 2.0 * m->half_sin * m->half_cos;
            m->rotation_h = h;
        } else {
            rotate(1.0, 0.0, p * h * (omega + 0.5 * acceleration * h), &m->full_cos, &m->full_sin);
            m->rotation_h = -1.0;
        }
        m->rotation_omega = omega;
    }
    const double mid_c = first.c * m->half_cos - first.s * m->half_sin;
    const double mid_s = first.s * m->half_cos + first.c * m->half_sin;
    const double last_c = first.c * m->full_cos - first.s * m->full_sin;
    const double last_s = first.s * m->full_cos + first.c * m->full_sin;

    terminal_voltage(m, supply, &first, p * omega, general, &u_alpha, &u_beta);
    k1a = (u_alpha - R * first.i_alpha) * f;
    k1b = (u_beta - R * first.i_beta) * f;
    mid = moved(&first, half_h, k1a, k1b, first.d_chi_d, first.d_chi_q, mid_c, mid_s);
    pmsm_find_currents(m, &mid);
    terminal_voltage(m, supply, &mid, p * omega_half, general, &u_alpha, &u_beta);
    k2a = (u_alpha - R * mid.i_alpha) * f;
    k2b = (u_beta - R * mid.i_beta) * f;
    if (supply->brief) {
        last = moved(&first, h, k2a, k2b, mid.d_chi_d, mid.d_chi_q, last_c, last_s);
    } else {
        double k3a, k3b, k4a, k4b;
        const pmsm_point second = mid;
        mid = moved(&first, half_h, k2a, k2b, second.d_chi_d, second.d_chi_q, mid_c, mid_s);
        pmsm_find_currents(m, &mid);
        terminal_voltage(m, supply, &mid, p * omega_half, general, &u_alpha, &u_beta);
        k3a = (u_alpha - R * mid.i_alpha) * f;
        k3b = (u_beta - R * mid.i_beta) * f;
        last = moved(&first, h, k3a, k3b, mid.d_chi_d, mid.d_chi_q, last_c, last_s);
        pmsm_find_currents(m, &last);
        terminal_voltage(m, supply, &last, p * omega_full, general, &u_alpha, &u_beta);
        k4a = (u_alpha - R * last.i_alpha) * f;
        k4b = (u_beta - R * last.i_beta) * f;
        last = moved(&first, h * (1.0 / 6.0), k1a + 2.0 * (k2a + k3a) + k4a, k1b + 2.0 * (k2b + k3b) + k4b,
                     first.d_chi_d + 2.0 * (second.d_chi_d + mid.d_chi_d) + last.d_chi_d,
                     first.d_chi_q + 2.0 * (second.d_chi_q + mid.d_chi_q) + last.d_chi_q, last_c, last_s);
    }

    m->u_alpha = u_alpha;
    m->u_beta = u_beta;
    state->omega_M = omega_full;
    set_angle(state, state->theta_M + (omega * h + 0.5 * acceleration * h * h));
    if (++state->turned < TURNS_MAX) {
        state->cos_e = last.c;
        state->sin_e = last.s;
    } else {
        pmsm_real64_sincos(p * state->theta_M, &state->sin_e, &state->cos_e);
        state->turned = 0;
        last.c = state->cos_e;
        last.s = state->sin_e;
    }
    pmsm_find_currents(m, &last);
    pmsm_keep_point(m, &last);
}

/* Flux, speed, angle and twist together. */
static inline void step_free(pmsm_plant *m, const pmsm_supply *supply, double h, const int general)
{
    static const double place[4] = {0.0, 0.5, 0.5, 1.0};
    static const double weights[2][4] = {{1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0}, {0.0, 1.0, 0.0, 0.0}};
    const double *weight = weights[supply->brief != 0];
    const int stages = supply->brief ? 2 : 4;
    pmsm_plant_state *state = &m->state;
    const double p = m->machine.pole_pairs, R = m->R + supply->series, f = m->iron_factor;
    const pmsm_point first = pmsm_point_here(state);
    pmsm_point at = first;
    double ka = 0.0, kb = 0.0, kw = 0.0, kl = 0.0, omega = state->omega_M, omega_load = state->omega_load;
    double d_theta = 0.0, twist = state->twist, torque = state->torque, u_alpha = 0.0, u_beta = 0.0;
    double sum_a = 0.0, sum_b = 0.0, sum_d = 0.0, sum_q = 0.0, sum_w = 0.0, sum_l = 0.0, sum_theta = 0.0, sum_twist = 0.0;
    for (int j = 0; j < stages; j++) {
        if (j > 0) { /* omega, omega_load still belong to the previous stage: they move the angles */
            const double hj = h * place[j];
            d_theta = hj * omega;
            twist = state->twist + hj * (omega - omega_load);
            omega = state->omega_M + hj * kw;
            omega_load = state->omega_load + hj * kl;
            double c, s;
            rotate(first.c, first.s, p * d_theta, &c, &s);
            at = moved(&first, hj, ka, kb, at.d_chi_d, at.d_chi_q, c, s);
            pmsm_find_currents(m, &at);
            torque = pmsm_air_gap_torque(m, &at);
        }
        terminal_voltage(m, supply, &at, p * omega, general, &u_alpha, &u_beta);
        ka = (u_alpha - R * at.i_alpha) * f;
        kb = (u_beta - R * at.i_beta) * f;
        accelerations(m, torque, state->theta_M + d_theta, omega, twist, omega_load, &kw, &kl);
        sum_a += weight[j] * ka;
        sum_b += weight[j] * kb;
        sum_d += weight[j] * at.d_chi_d;
        sum_q += weight[j] * at.d_chi_q;
        sum_w += weight[j] * kw;
        sum_l += weight[j] * kl;
        sum_theta += weight[j] * omega;
        sum_twist += weight[j] * (omega - omega_load);
    }
    m->u_alpha = u_alpha;
    m->u_beta = u_beta;
    state->omega_M += h * sum_w;
    state->omega_load += h * sum_l;
    state->twist += h * sum_twist;
    set_angle(state, state->theta_M + h * sum_theta);
    pmsm_real64_sincos(p * state->theta_M, &state->sin_e, &state->cos_e);
    state->turned = 0;
    at = moved(&first, h, sum_a, sum_b, sum_d, sum_q, state->cos_e, state->sin_e);
    pmsm_find_currents(m, &at);
    pmsm_keep_point(m, &at);
}

/* No current flows all along: the shaft alone, the flux is the magnet's, and its iron loss comes from the shaft. */
static void step_open(pmsm_plant *m, double h, int moves_freely, double omega, double acceleration)
{
    static const double place[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    pmsm_plant_state *state = &m->state;
    double d_theta = omega * h + 0.5 * acceleration * h * h;
    if (moves_freely) {
        double kw = 0.0, kl = 0.0, w = state->omega_M, wl = state->omega_load, at = 0.0, twist = state->twist;
        double sum_w = 0.0, sum_l = 0.0, sum_theta = 0.0, sum_twist = 0.0;
        for (int j = 0; j < 4; j++) {
            const double hj = h * place[j];
            at = hj * w;
            twist = state->twist + hj * (w - wl);
            w = state->omega_M + hj * kw;
            wl = state->omega_load + hj * kl;
            accelerations(m, -m->iron_drag * w, state->theta_M + at, w, twist, wl, &kw, &kl);
            sum_w += weight[j] * kw;
            sum_l += weight[j] * kl;
            sum_theta += weight[j] * w;
            sum_twist += weight[j] * (w - wl);
        }
        state->omega_M += h * sum_w;
        state->omega_load += h * sum_l;
        state->twist += h * sum_twist;
        d_theta = h * sum_theta;
    } else {
        state->omega_M = omega + acceleration * h;
    }
    set_angle(state, state->theta_M + d_theta);
    pmsm_real64_sincos(m->machine.pole_pairs * state->theta_M, &state->sin_e, &state->cos_e);
    state->turned = 0;
    m->u_alpha = m->u_beta = m->iron_alpha = m->iron_beta = 0.0;
    pmsm_plant_clear_current(m, PMSM_ALL_LEGS);
}

/* The second mass swings on the coupling while friction holds the rotor. */
static void step_load(pmsm_plant *m, double h)
{
    static const double place[4] = {0.0, 0.5, 0.5, 1.0}, weight[4] = {1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0};
    pmsm_plant_state *state = &m->state;
    double rotor, kl = 0.0, wl = state->omega_load, twist = state->twist, sum_l = 0.0, sum_twist = 0.0;
    for (int j = 0; j < 4; j++) {
        if (j > 0) {
            const double hj = place[j] * h;
            twist = state->twist - hj * wl;
            wl = state->omega_load + hj * kl;
        }
        accelerations(m, 0.0, state->theta_M, 0.0, twist, wl, &rotor, &kl);
        sum_l += weight[j] * kl;
        sum_twist -= weight[j] * wl;
    }
    state->omega_load += h * sum_l;
    state->twist += h * sum_twist;
}

static void step(pmsm_plant *m, const pmsm_supply *supply, double h)
{
    const int moves_freely = m->machine.rotor == PMSM_ROTOR_FREE && !m->state.sticking;
    const double omega = m->state.sticking ? 0.0 : m->state.omega_M;
    const double acceleration = m->machine.rotor == PMSM_ROTOR_DRIVEN ? m->acceleration : 0.0;
    if (m->state.sticking && m->machine.J_load > 0.0)
        step_load(m, h);
    if (supply->blocked == PMSM_ALL_LEGS) {
        step_open(m, h, moves_freely, omega, acceleration);
    } else if (moves_freely) {
        if (supply->general)
            step_free(m, supply, h, 1);
        else
            step_free(m, supply, h, 0);
    } else {
        if (supply->general)
            step_imposed(m, supply, h, omega, acceleration, 1);
        else
            step_imposed(m, supply, h, omega, acceleration, 0);
    }
}

/* ---- stick-slip ------------------------------------------------------------------------------------ */

/* At standstill: hold, or the direction of the break-away. */
static void decide_stick(pmsm_plant *m)
{
    double acceleration, load_acceleration;
    m->friction_sign = 0.0;
    accelerations(m, m->state.torque, m->state.theta_M, 0.0, m->state.twist, m->state.omega_load, &acceleration,
                  &load_acceleration);
    const double torque = acceleration * m->machine.J;
    m->state.sticking = pmsm_real64_abs(torque) <= coulomb_torque(&m->machine, m->state.theta_M, 0.0);
    if (!m->state.sticking)
        m->friction_sign = torque > 0.0 ? 1.0 : -1.0;
}

void pmsm_plant_advance(pmsm_plant *m, const pmsm_supply *supply, double h)
{
    if (m->machine.rotor != PMSM_ROTOR_FREE || !(m->machine.tau_c > 0.0)) {
        step(m, supply, h);
        return;
    }
    for (int event = 0; h > 0.0; event++) {
        const pmsm_plant_state before = m->state;
        if (before.omega_M == 0.0) {
            decide_stick(m);
        } else {
            m->state.sticking = 0;
            m->friction_sign = before.omega_M > 0.0 ? 1.0 : -1.0;
        }
        const uint32_t sticking = m->state.sticking;
        step(m, supply, h);
        if (sticking || m->state.omega_M * m->friction_sign >= 0.0)
            return;
        if (before.omega_M == 0.0) { /* the break-away torque was gone within the interval */
            m->state.omega_M = 0.0;
            return;
        }
        if (event >= EVENTS_MAX) {
            m->event_overruns++;
            return;
        }
        double tau = h;
        for (int trial = 0; trial < SECANT_STEPS; trial++) {
            tau *= before.omega_M / (before.omega_M - m->state.omega_M);
            m->state = before;
            m->state.sticking = 0;
            step(m, supply, tau);
        }
        m->state.omega_M = 0.0;
        h -= tau;
    }
}

