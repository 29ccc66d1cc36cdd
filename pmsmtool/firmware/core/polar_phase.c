/* SPDX-License-Identifier: MIT */
/* Voltage phase (and amplitude) control of Miyajima, Fujimoto, Fujitsuna: PID controllers that place the poles of the
 * model linearised at the present equilibrium, rescheduled every period. Derivation: the linearised plant is
 * (n1 s + n0)/(s^2 + 2 alpha s + alpha^2 + omega^2), the target (s^2 + 2 sigma s + m)^2 with m = alpha^2 + omega^2: two
 * coincident pole pairs on the circle through the plant's poles. Turning backwards the machine is seen in a mirror:
 * (i_d, i_q, omega) -> (i_d, -i_q, -omega), v_q -> -v_q.
 */
#include "polar.h"

#define SCHEDULE_SINE PMSM_C(0.98) /* largest argument of the equilibrium's arc sine: unreachable torque is cut here */
#define REACH PMSM_C(0.97)         /* share of the largest sine that a reference may ask for */
#define PHASE_LIMIT (PMSM_C(0.5) * PMSM_PI)
/* Share of the set-point that P and D see in the form "on the measurement". None at all (I-PD) lets the integrator do
 * the whole step: 6 % overshoot of i_q and 3.7 A of positive i_d after the reference's step-down, 0.35 of it gives 1 %
 * and 2.2 A; the full error (PID) 1 % and 5.0 A. */
#define SET_POINT_SHARE PMSM_C(0.35)
#define SMALLEST_SHARE PMSM_C(1e-3) /* of V: the amplitude of the schedule stays away from zero */

typedef struct {
    pmsm_real K_p, K_i, K_d, a; /* C(s) = K_p + K_i/s + K_d a s/(s + a) */
} pid;

typedef struct {
    pmsm_real sine, cosine; /* of delta_o */
} equilibrium;

/* (9): the phase that holds i_q at amplitude V_a, stable branch. */
static equilibrium find_equilibrium(const polar_plant *p, pmsm_real i_q, pmsm_real V_a)
{
    const pmsm_real X = p->omega * p->L;
    const pmsm_real Z = PMSM_SQRT(p->R * p->R + X * X);
    const pmsm_real argument = (Z * Z * i_q + p->omega * p->R * p->psi) / (V_a * Z);
    const pmsm_real s = pmsm_clamp(argument, -SCHEDULE_SINE, SCHEDULE_SINE);
    const pmsm_real c = PMSM_SQRT(PMSM_C(1.0) - s * s);
    const equilibrium e = {(s * X - c * p->R) / Z, (c * X + s * p->R) / Z}; /* minus atan2(R, X) */
    return e;
}

/* The i_q asked for, cut to what full amplitude can hold: beyond it the phase would run past the torque's maximum,
 * where the loop's sign turns, and stay there. */
static pmsm_real within_reach(const polar_plant *p, pmsm_real i_q)
{
    const pmsm_real X = p->omega * p->L;
    const pmsm_real square = p->R * p->R + X * X;
    const pmsm_real reach = REACH * p->V * PMSM_SQRT(square);
    const pmsm_real back_emf = p->omega * p->R * p->psi;
    return pmsm_clamp(i_q, (-reach - back_emf) / square, (reach - back_emf) / square);
}

/* The placement is singular at standstill (its determinant is omega^2): the gains are those of omega = R/L at least,
 * below which the phase is not the input for i_q any more. */
static polar_plant schedule_plant(const polar_plant *plant)
{
    polar_plant p = *plant;
    p.omega = pmsm_max(p.omega, p.alpha);
    return p;
}

/* Gains that place both pole pairs; (7), (8), (11). No gain at all where they cannot be placed: the input is held. */
static pid place(const polar_plant *p, pmsm_real sigma, pmsm_real n1, pmsm_real n0)
{
    const pmsm_real w0 = p->alpha * p->alpha + p->omega * p->omega;
    const pmsm_real m = pmsm_max(w0, sigma * sigma);
    const pmsm_real c3 = PMSM_C(4.0) * sigma - PMSM_C(2.0) * p->alpha;
    const pmsm_real c2 = PMSM_C(4.0) * sigma * sigma + PMSM_C(2.0) * m - w0 - PMSM_C(2.0) * p->alpha * c3;
    const pmsm_real b0 = m * m / n0;
    const pmsm_real c1 = PMSM_C(4.0) * sigma * m - n1 * b0 - w0 * c3;
    const pmsm_real k0 = n0 - PMSM_C(2.0) * p->alpha * n1;
    const pmsm_real det = k0 * n0 + w0 * n1 * n1;
    const pmsm_real b2 = (c2 * n0 - n1 * c1) / det;
    const pmsm_real b1 = (k0 * c1 + w0 * n1 * c2) / det;
    pid C;
    C.a = c3 - n1 * b2;
    if (!(C.a > PMSM_C(0.0))) {
        const pid none = {PMSM_C(0.0), PMSM_C(0.0), PMSM_C(0.0), sigma};
        return none;
    }
    C.K_i = b0 / C.a;
    C.K_p = (b1 - C.K_i) / C.a;
    C.K_d = (b2 - C.K_p) / C.a;
    return C;
}

/* One Tustin step of a PID. The integral of K_i e (not of e), and a derivative part that remembers its input (not its
 * output), keep gain changes bumpless. */
typedef struct {
    pmsm_real output;
    pmsm_polar_pid memory; /* if this step is kept */
} pid_step;

static pid_step advance(const pid *C, pmsm_real T_s, const pmsm_polar_pid *memory, pmsm_real e, pmsm_real x)
{
    const pmsm_real width = C->a * T_s;
    const pmsm_real half = PMSM_C(0.5) * C->K_i * T_s * e;
    pid_step step;
    step.memory.low = ((PMSM_C(2.0) - width) * memory->low + width * (x + memory->last)) / (PMSM_C(2.0) + width);
    step.output = C->K_p * x + (memory->integral + half) + C->K_d * C->a * (x - step.memory.low);
    step.memory.integral = memory->integral + PMSM_C(2.0) * half;
    step.memory.last = x;
    return step;
}

static uint32_t option(const pmsm_period *period, uint32_t bit)
{
    return ((period->params->polar_options & bit) != 0u) ? 1u : 0u;
}

/* A step is kept unless the output is at its limit: the memory (integral and derivative filter) is then frozen, but the
 * output is still evaluated every period, so it leaves the limit by itself. */
static uint32_t is_kept(const pmsm_period *period, pmsm_real output, pmsm_real limited)
{
    return (limited == output || option(period, PMSM_POLAR_NO_ANTI_WINDUP) != 0u) ? 1u : 0u;
}

static pmsm_real set_point_share(const pmsm_period *period)
{
    return (option(period, PMSM_POLAR_ON_MEASUREMENT) != 0u) ? SET_POINT_SHARE : PMSM_C(1.0);
}

static pmsm_real phase_step(pmsm_period *period, const polar_plant *p, pmsm_dq i, pmsm_dq target, pmsm_real V_a)
{
    pmsm_polar_state *memory = &period->state->polar;
    const equilibrium eq = find_equilibrium(p, target.q, V_a);
    const pmsm_real scale = V_a / p->L;
    const pmsm_real n1 = -scale * eq.sine;
    const pmsm_real n0 = scale * (p->omega * eq.cosine - p->alpha * eq.sine);
    const pid C = place(p, (pmsm_real)period->params->polar_sigma_phase_rad_s, n1, n0);
    const pmsm_real e = target.q - i.q;
    const pmsm_real x = set_point_share(period) * target.q - i.q;
    const pid_step step = advance(&C, p->T_s, &memory->phase_pid, e, x);
    const pmsm_real delta = pmsm_clamp(step.output, -PHASE_LIMIT, PHASE_LIMIT);
    if (is_kept(period, step.output, delta) != 0u) {
        memory->phase_pid = step.memory;
    }
    return delta;
}

static pmsm_real amplitude_step(pmsm_period *period, const polar_plant *p, pmsm_dq i, pmsm_dq target, pmsm_real V_a)
{
    pmsm_polar_state *memory = &period->state->polar;
    const equilibrium eq = find_equilibrium(p, target.q, V_a);
    const pmsm_real n1 = -eq.sine / p->L;
    const pmsm_real n0 = (p->omega * eq.cosine - p->alpha * eq.sine) / p->L;
    const pid C = place(p, (pmsm_real)period->params->polar_sigma_amplitude_rad_s, n1, n0);
    const pmsm_real e = target.d - i.d;
    const pid_step step = advance(&C, p->T_s, &memory->amplitude_pid, e, e);
    const pmsm_real limited = pmsm_clamp(step.output, PMSM_C(0.0), p->V);
    if (is_kept(period, step.output, limited) != 0u) {
        memory->amplitude_pid = step.memory;
    }
    return limited;
}

/* Memory for a start without a jump from a voltage. */
void pmsm_polar_phase_start(pmsm_period *period, const polar_plant *plant, pmsm_dq v)
{
    pmsm_polar_state *memory = &period->state->polar;
    const pmsm_real mirror = (period->omega_e < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    memory->delta = pmsm_arctan(-v.d, mirror * v.q);
    memory->amplitude = pmsm_min(PMSM_SQRT(pmsm_square(v)), plant->V);
    memory->phase_pid.integral = memory->delta;
    memory->amplitude_pid.integral = memory->amplitude;
    memory->phase_pid.low = mirror * (set_point_share(period) * period->reference.q - period->i.q);
    memory->phase_pid.last = memory->phase_pid.low;
    memory->amplitude_pid.low = PMSM_C(0.0); /* a weakened current drives the amplitude into its limit at once */
    memory->amplitude_pid.last = PMSM_C(0.0);
}

void pmsm_polar_phase(pmsm_period *period, const polar_plant *plant)
{
    pmsm_polar_state *memory = &period->state->polar;
    const pmsm_real mirror = (period->omega_e < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    const pmsm_dq i = {period->i_model.d, mirror * period->i_model.q};
    const pmsm_dq target = {period->reference.d, within_reach(plant, mirror * period->reference.q)};
    const polar_plant scheduled = schedule_plant(plant);
    pmsm_real V_a = plant->V;
    pmsm_real V_schedule = plant->V;
    if (period->params->polar_mode == PMSM_POLAR_PROPOSED) {
        V_schedule = pmsm_max(memory->amplitude, SMALLEST_SHARE * plant->V);
        V_a = amplitude_step(period, &scheduled, i, target, V_schedule);
    }
    const pmsm_real delta = phase_step(period, &scheduled, i, target, V_schedule);
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(delta, &sine, &cosine);
    period->u.d = -V_a * sine;
    period->u.q = mirror * V_a * cosine;
    memory->delta = delta;
    memory->amplitude = V_a;
}
