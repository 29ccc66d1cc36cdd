/* The machine: one RK4 step of stator flux, speed and angle per interval; see plant.h.
 *
 * psi_dq = R(-theta_e) psi_ab, i_ab = R(theta_e) i_dq(psi_dq), psi_ab' = u_ab - R i_ab.
 */
#include "plant.h"

#include <stddef.h>

#include "elementary.h"

#define EVENTS_MAX 8        /* speed reversals inside one interval; more is counted as an overrun */
#define SECANT_STEPS 3      /* to the instant of standstill, from a nearly straight speed */
#define ZERO_FLUX_STEPS 20  /* Newton steps to the flux without current */
#define ALL_LEGS 3
#define TURNS_MAX 64u       /* steps by multiplication before sine and cosine are computed afresh: drift below 1e-14 */

/* A point of the trajectory inside an interval. */
typedef struct {
    double psi_alpha, psi_beta, c, s;
    double i_d, i_q, i_alpha, i_beta;
} point;

/* ---- electrical side ---------------------------------------------------------------------------- */

/* Harmonics of the magnet flux at angle (c, s): value and derivative with respect to theta_e. */
static void magnet_harmonics(const pmsm_machine *machine, double c, double s, double h[2], double dh[2])
{
    const double c2 = c * c - s * s, s2 = 2.0 * c * s;
    const double c3 = c2 * c - s2 * s, s3 = s2 * c + c2 * s;
    const double c6 = c3 * c3 - s3 * s3, s6 = 2.0 * c3 * s3;
    const double c12 = c6 * c6 - s6 * s6, s12 = 2.0 * c6 * s6;
    h[0] = machine->psi_6 * c6 + machine->psi_12 * c12;
    h[1] = -machine->psi_6 * s6 - machine->psi_12 * s12;
    dh[0] = -6.0 * machine->psi_6 * s6 - 12.0 * machine->psi_12 * s12;
    dh[1] = -6.0 * machine->psi_6 * c6 - 12.0 * machine->psi_12 * c12;
}

static inline int has_harmonics(const pmsm_machine *machine)
{
    return machine->psi_6 != 0.0 || machine->psi_12 != 0.0;
}

/* Currents of a point from its flux and angle. */
static inline void find_currents(pmsm_plant *m, point *at)
{
    const double c = at->c, s = at->s;
    double psi_d = c * at->psi_alpha + s * at->psi_beta;
    double psi_q = c * at->psi_beta - s * at->psi_alpha;
    if (has_harmonics(&m->machine)) {
        double h[2], dh[2];
        magnet_harmonics(&m->machine, c, s, h, dh);
        psi_d -= h[0];
        psi_q -= h[1];
    }
    if (m->machine.map) {
        if (pmsm_flux_map_current(m->machine.map, psi_d - m->psi_shift, psi_q, &at->i_d, &at->i_q))
            m->outside_count++;
    } else {
        at->i_d = (psi_d - m->psi_m) * m->L_d_inverse;
        at->i_q = psi_q * m->L_q_inverse;
    }
    at->i_alpha = c * at->i_d - s * at->i_q;
    at->i_beta = s * at->i_d + c * at->i_q;
}

/* di_dq/dpsi_dq at a point (A/Wb). */
static void find_reluctance(const pmsm_plant *m, const point *at, double g[4])
{
    if (m->machine.map) {
        double h[2] = {0.0, 0.0}, dh[2], i[2];
        if (has_harmonics(&m->machine))
            magnet_harmonics(&m->machine, at->c, at->s, h, dh);
        const double psi_d = at->c * at->psi_alpha + at->s * at->psi_beta - h[0] - m->psi_shift;
        const double psi_q = at->c * at->psi_beta - at->s * at->psi_alpha - h[1];
        (void)pmsm_flux_map_current_jacobian(m->machine.map, psi_d, psi_q, i, g);
    } else {
        g[0] = m->L_d_inverse;
        g[1] = 0.0;
        g[2] = 0.0;
        g[3] = m->L_q_inverse;
    }
}

static inline double air_gap_torque(const pmsm_plant *m, const point *at)
{
    double flux_current = at->psi_alpha * at->i_beta - at->psi_beta * at->i_alpha;
    if (has_harmonics(&m->machine)) { /* from the co-energy: i . d psi_pm / d theta_e */
        double h[2], dh[2];
        magnet_harmonics(&m->machine, at->c, at->s, h, dh);
        flux_current += at->i_d * dh[0] + at->i_q * dh[1];
    }
    return 1.5 * m->machine.pole_pairs * flux_current;
}

/* Leg voltages behind slope and error at the point's currents. */
static void leg_voltages(const pmsm_supply *supply, const point *at, double v[3])
{
    for (int x = 0; x < 3; x++) {
        const double i = pmsm_leg_alpha[x] * at->i_alpha + pmsm_leg_beta[x] * at->i_beta;
        v[x] = supply->v[x] - supply->r[x] * i;
        if (supply->error)
            v[x] -= pmsm_leg_error_voltage(supply->error, x, i);
    }
}

/* Voltage of leg x that keeps its current, the others at v: solves d i_x/dt = 0, which is linear in v_x. */
static double hold_voltage(const pmsm_plant *m, const point *at, double omega_e, int x, const double v_legs[3],
                           double *slope_per_volt)
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
    if (has_harmonics(&m->machine)) {
        double h[2], dh[2];
        magnet_harmonics(&m->machine, c, s, h, dh);
        d_psi_d -= omega_e * dh[0];
        d_psi_q -= omega_e * dh[1];
    }
    find_reluctance(m, at, g);
    const double n_d = c * pmsm_leg_alpha[x] + s * pmsm_leg_beta[x], n_q = c * pmsm_leg_beta[x] - s * pmsm_leg_alpha[x];
    const double di_d = g[0] * d_psi_d + g[1] * d_psi_q - omega_e * at->i_q;
    const double di_q = g[2] * d_psi_d + g[3] * d_psi_q + omega_e * at->i_d;
    const double per_volt = (2.0 / 3.0) * m->iron_factor
                            * (n_d * (g[0] * n_d + g[1] * n_q) + n_q * (g[2] * n_d + g[3] * n_q));
    if (slope_per_volt)
        *slope_per_volt = per_volt;
    return -(n_d * di_d + n_q * di_q) / per_volt;
}

/* Stator-frame terminal voltage at a point. */
static inline void terminal_voltage(const pmsm_plant *m, const pmsm_supply *supply, const point *at, double omega_e,
                                    const int general, double *u_alpha, double *u_beta)
{
    if (general) {
        double v[3];
        leg_voltages(supply, at, v);
        if (supply->blocked >= 0)
            v[supply->blocked] = hold_voltage(m, at, omega_e, supply->blocked, v, NULL);
        pmsm_leg_vector(v, u_alpha, u_beta);
    } else {
        *u_alpha = supply->alpha;
        *u_beta = supply->beta;
    }
}

/* ---- mechanical side ---------------------------------------------------------------------------- */

/* Accelerations of rotor and second mass (rad/s2) at speeds omega, omega_load and angle theta_M. */
static inline void accelerations(const pmsm_plant *m, double torque, double theta_M, double omega, double twist,
                                 double omega_load, double *rotor, double *load)
{
    const pmsm_machine *k = &m->machine;
    double net = torque - k->B * omega - k->tau_c * m->friction_sign;
    if (k->cogging != 0.0) {
        double s, c;
        pmsm_real64_sincos(k->cogging_periods * theta_M, &s, &c);
        net -= k->cogging * s;
    }
    if (k->J_load > 0.0) {
        const double shaft = k->coupling_stiffness * twist + k->coupling_damping * (omega - omega_load);
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

static inline void keep(pmsm_plant *m, const point *at)
{
    pmsm_plant_state *state = &m->state;
    state->psi_alpha = at->psi_alpha;
    state->psi_beta = at->psi_beta;
    state->i_d = at->i_d;
    state->i_q = at->i_q;
    state->i_alpha = at->i_alpha;
    state->i_beta = at->i_beta;
    state->torque = air_gap_torque(m, at);
}

static point here(const pmsm_plant_state *state)
{
    const point at = {state->psi_alpha, state->psi_beta, state->cos_e,   state->sin_e,
                      state->i_d,       state->i_q,      state->i_alpha, state->i_beta};
    return at;
}

/* ---- one step ------------------------------------------------------------------------------------- */

/* Flux with the angle given: locked, driven, or held by friction. */
static inline void step_imposed(pmsm_plant *m, const pmsm_supply *supply, double h, double omega, double acceleration,
                                const int general)
{
    pmsm_plant_state *state = &m->state;
    const double p = m->machine.pole_pairs, R = m->R, f = m->iron_factor;
    const double half_h = 0.5 * h, omega_half = omega + acceleration * half_h, omega_full = omega + acceleration * h;
    const point first = here(state);
    point mid, last;
    double u_alpha, u_beta, k1a, k1b, k2a, k2b;

    if (m->rotation_h != h || m->rotation_omega != omega || acceleration != 0.0) {
        rotate(1.0, 0.0, p * half_h * (omega + 0.5 * acceleration * half_h), &m->half_cos, &m->half_sin);
        if (acceleration == 0.0) {
            m->full_cos = 1.0 - 2.0 * m->half_sin * m->half_sin;
            m->full_sin = 2.0 * m->half_sin * m->half_cos;
            m->rotation_h = h;
        } else {
            rotate(1.0, 0.0, p * h * (omega + 0.5 * acceleration * h), &m->full_cos, &m->full_sin);
            m->rotation_h = -1.0;
        }
        m->rotation_omega = omega;
    }
    mid.c = first.c * m->half_cos - first.s * m->half_sin;
    mid.s = first.s * m->half_cos + first.c * m->half_sin;
    last.c = first.c * m->full_cos - first.s * m->full_sin;
    last.s = first.s * m->full_cos + first.c * m->full_sin;

    terminal_voltage(m, supply, &first, p * omega, general, &u_alpha, &u_beta);
    k1a = (u_alpha - R * first.i_alpha) * f;
    k1b = (u_beta - R * first.i_beta) * f;
    mid.psi_alpha = first.psi_alpha + half_h * k1a;
    mid.psi_beta = first.psi_beta + half_h * k1b;
    find_currents(m, &mid);
    terminal_voltage(m, supply, &mid, p * omega_half, general, &u_alpha, &u_beta);
    k2a = (u_alpha - R * mid.i_alpha) * f;
    k2b = (u_beta - R * mid.i_beta) * f;
    if (supply->brief) {
        last.psi_alpha = first.psi_alpha + h * k2a;
        last.psi_beta = first.psi_beta + h * k2b;
    } else {
        double k3a, k3b, k4a, k4b;
        mid.psi_alpha = first.psi_alpha + half_h * k2a;
        mid.psi_beta = first.psi_beta + half_h * k2b;
        find_currents(m, &mid);
        terminal_voltage(m, supply, &mid, p * omega_half, general, &u_alpha, &u_beta);
        k3a = (u_alpha - R * mid.i_alpha) * f;
        k3b = (u_beta - R * mid.i_beta) * f;
        last.psi_alpha = first.psi_alpha + h * k3a;
        last.psi_beta = first.psi_beta + h * k3b;
        find_currents(m, &last);
        terminal_voltage(m, supply, &last, p * omega_full, general, &u_alpha, &u_beta);
        k4a = (u_alpha - R * last.i_alpha) * f;
        k4b = (u_beta - R * last.i_beta) * f;
        last.psi_alpha = first.psi_alpha + h * (1.0 / 6.0) * (k1a + 2.0 * (k2a + k3a) + k4a);
        last.psi_beta = first.psi_beta + h * (1.0 / 6.0) * (k1b + 2.0 * (k2b + k3b) + k4b);
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
    find_currents(m, &last);
    keep(m, &last);
}

/* Flux, speed, angle and twist together. */
static inline void step_free(pmsm_plant *m, const pmsm_supply *supply, double h, const int general)
{
    static const double place[4] = {0.0, 0.5, 0.5, 1.0};
    static const double weights[2][4] = {{1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0}, {0.0, 1.0, 0.0, 0.0}};
    const double *weight = weights[supply->brief != 0];
    const int stages = supply->brief ? 2 : 4;
    pmsm_plant_state *state = &m->state;
    const double p = m->machine.pole_pairs, R = m->R, f = m->iron_factor;
    const point first = here(state);
    point at = first;
    double ka = 0.0, kb = 0.0, kw = 0.0, kl = 0.0, omega = state->omega_M, omega_load = state->omega_load;
    double d_theta = 0.0, twist = state->twist, torque = state->torque, u_alpha = 0.0, u_beta = 0.0;
    double sum_a = 0.0, sum_b = 0.0, sum_w = 0.0, sum_l = 0.0, sum_theta = 0.0, sum_twist = 0.0;
    for (int j = 0; j < stages; j++) {
        if (j > 0) { /* omega, omega_load still belong to the previous stage: they move the angles */
            const double hj = h * place[j];
            d_theta = hj * omega;
            twist = state->twist + hj * (omega - omega_load);
            omega = state->omega_M + hj * kw;
            omega_load = state->omega_load + hj * kl;
            at.psi_alpha = first.psi_alpha + hj * ka;
            at.psi_beta = first.psi_beta + hj * kb;
            rotate(first.c, first.s, p * d_theta, &at.c, &at.s);
            find_currents(m, &at);
            torque = air_gap_torque(m, &at);
        }
        terminal_voltage(m, supply, &at, p * omega, general, &u_alpha, &u_beta);
        ka = (u_alpha - R * at.i_alpha) * f;
        kb = (u_beta - R * at.i_beta) * f;
        accelerations(m, torque, state->theta_M + d_theta, omega, twist, omega_load, &kw, &kl);
        sum_a += weight[j] * ka;
        sum_b += weight[j] * kb;
        sum_w += weight[j] * kw;
        sum_l += weight[j] * kl;
        sum_theta += weight[j] * omega;
        sum_twist += weight[j] * (omega - omega_load);
    }
    at.psi_alpha = first.psi_alpha + h * sum_a;
    at.psi_beta = first.psi_beta + h * sum_b;
    m->u_alpha = u_alpha;
    m->u_beta = u_beta;
    state->omega_M += h * sum_w;
    state->omega_load += h * sum_l;
    state->twist += h * sum_twist;
    set_angle(state, state->theta_M + h * sum_theta);
    pmsm_real64_sincos(p * state->theta_M, &state->sin_e, &state->cos_e);
    state->turned = 0;
    at.c = state->cos_e;
    at.s = state->sin_e;
    find_currents(m, &at);
    keep(m, &at);
}

static void step(pmsm_plant *m, const pmsm_supply *supply, double h)
{
    const int moves_freely = m->machine.rotor == PMSM_ROTOR_FREE && !m->state.sticking;
    const int general = supply->general && supply->blocked != ALL_LEGS;
    if (moves_freely) {
        if (general)
            step_free(m, supply, h, 1);
        else
            step_free(m, supply, h, 0);
    } else {
        const double omega = m->state.sticking ? 0.0 : m->state.omega_M;
        const double acceleration = m->machine.rotor == PMSM_ROTOR_DRIVEN ? m->acceleration : 0.0;
        if (general)
            step_imposed(m, supply, h, omega, acceleration, 1);
        else
            step_imposed(m, supply, h, omega, acceleration, 0);
    }
    if (supply->blocked == ALL_LEGS) /* no current all along: the flux is the magnet's */
        pmsm_plant_clear_current(m, ALL_LEGS);
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
    m->state.sticking = pmsm_real64_abs(torque) <= m->machine.tau_c;
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

/* ---- around the step --------------------------------------------------------------------------------- */

void pmsm_plant_refresh(pmsm_plant *m)
{
    point at;
    pmsm_real64_sincos(m->machine.pole_pairs * m->state.theta_M, &m->state.sin_e, &m->state.cos_e);
    m->state.turned = 0;
    at.psi_alpha = m->state.psi_alpha;
    at.psi_beta = m->state.psi_beta;
    at.c = m->state.cos_e;
    at.s = m->state.sin_e;
    find_currents(m, &at);
    keep(m, &at);
}

void pmsm_plant_set_temperatures(pmsm_plant *m, double T_winding, double T_magnet)
{
    const pmsm_machine *k = &m->machine;
    m->T_winding = T_winding;
    m->T_magnet = T_magnet;
    m->R = k->R_copper * (1.0 + k->alpha_R * (T_winding - k->T_ref)) + k->R_fixed;
    m->psi_shift = k->psi_f * k->alpha_psi * (T_magnet - k->T_ref);
    m->psi_m = k->psi_f + m->psi_shift;
    m->iron_factor = k->R_iron > 0.0 ? 1.0 / (1.0 + m->R / k->R_iron) : 1.0;
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
    m->rotation_h = -1.0;
    m->u_alpha = 0.0;
    m->u_beta = 0.0;
    if (m->machine.map)
        find_zero_flux(m);
    pmsm_plant_set_temperatures(m, m->T_winding, m->T_magnet);
    pmsm_real64_sincos(m->machine.pole_pairs * m->state.theta_M, &m->state.sin_e, &m->state.cos_e);
    pmsm_plant_clear_current(m, ALL_LEGS);
    m->outside_count = m->event_overruns = 0;
}

double pmsm_plant_hold_voltage(const pmsm_plant *m, const pmsm_supply *supply, int x, double *slope_per_volt)
{
    const point at = here(&m->state);
    double v[3];
    leg_voltages(supply, &at, v);
    return hold_voltage(m, &at, m->machine.pole_pairs * m->state.omega_M, x, v, slope_per_volt);
}

static void zero_current_flux(const pmsm_plant *m, double c, double s, double *psi_d, double *psi_q)
{
    double h[2] = {0.0, 0.0}, dh[2];
    if (has_harmonics(&m->machine))
        magnet_harmonics(&m->machine, c, s, h, dh);
    *psi_d = (m->machine.map ? m->psi_zero_d + m->psi_shift : m->psi_m) + h[0];
    *psi_q = (m->machine.map ? m->psi_zero_q : 0.0) + h[1];
}

void pmsm_plant_emf(const pmsm_plant *m, double emf[3])
{
    const double c = m->state.cos_e, s = m->state.sin_e, omega_e = m->machine.pole_pairs * m->state.omega_M;
    double psi_d, psi_q, h[2], dh[2] = {0.0, 0.0};
    zero_current_flux(m, c, s, &psi_d, &psi_q);
    if (has_harmonics(&m->machine))
        magnet_harmonics(&m->machine, c, s, h, dh);
    const double u_d = omega_e * (dh[0] - psi_q), u_q = omega_e * (dh[1] + psi_d);
    for (int x = 0; x < 3; x++)
        emf[x] = pmsm_leg_alpha[x] * (c * u_d - s * u_q) + pmsm_leg_beta[x] * (s * u_d + c * u_q);
}

void pmsm_plant_clear_current(pmsm_plant *m, int x)
{
    point at = here(&m->state);
    if (x == ALL_LEGS) {
        double psi_d, psi_q;
        zero_current_flux(m, at.c, at.s, &psi_d, &psi_q);
        at.psi_alpha = at.c * psi_d - at.s * psi_q;
        at.psi_beta = at.s * psi_d + at.c * psi_q;
        at.i_d = at.i_q = at.i_alpha = at.i_beta = 0.0;
    } else {
        for (int n = 0; n < 2; n++) { /* one step is exact for constant inductances */
            double g[4];
            find_reluctance(m, &at, g);
            const double n_d = at.c * pmsm_leg_alpha[x] + at.s * pmsm_leg_beta[x];
            const double n_q = at.c * pmsm_leg_beta[x] - at.s * pmsm_leg_alpha[x];
            const double i = pmsm_leg_alpha[x] * at.i_alpha + pmsm_leg_beta[x] * at.i_beta;
            const double k = -i / (n_d * (g[0] * n_d + g[1] * n_q) + n_q * (g[2] * n_d + g[3] * n_q));
            at.psi_alpha += k * pmsm_leg_alpha[x];
            at.psi_beta += k * pmsm_leg_beta[x];
            find_currents(m, &at);
        }
    }
    keep(m, &at);
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
