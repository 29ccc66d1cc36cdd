/* SPDX-License-Identifier: MIT */
/* The bridge: three legs, each a source behind a resistance, a capacitor, or no path.
 *
 * switched  A leg's gate opens at the edge its duty ratio asks for, and the other one closes a dead time later. In
 *           between the current charges the node's capacitance (by its companion model, exact for the trapezoid)
 *           until a diode takes it over. A diode's current ends at zero; a leg at rest starts again when the
 *           circuit's own voltage leaves the band between its thresholds. All by trial: a step in which a leg would
 *           leave its state is shortened to that instant by a secant, and the leg changes state there.
 * averaged  duty ratio times link, less the error laws the data sheet names, at the step's mean current.
 */
#include <math.h>

#include "inverter.h"
#include "phase_machine.h"

#define NEVER 1e30
#define STEPS_OF_PERIOD 8.0
#define STEP_OF_RINGING 0.2   /* rad, of node capacitance and winding */
#define SAME_INSTANT 1e-13    /* s */
#define TRIALS 12
#define SLACK 1e-6            /* of the link: how far a node may pass its clamp unnoticed */
#define DEAD_TIME_STEPS 400.0 /* that a dead time may take at the smallest capacitance */
#define SIGN_KNEE 1e-3        /* of the current that the link drives through the winding in one period */

enum { LOW = 0, HIGH = 1 };
enum { SOURCE = 0, TWO_SIDED, CAPACITOR, CUT };

/* What a leg is during a step. */
typedef struct {
    int kind;
    double v_out, r_out, v_in, r_in; /* to a current out of the leg, and into it */
} leg_kind;

double pmsm_inverter_smallest_capacitance(double dead_time, double L_min)
{
    const double radians = STEP_OF_RINGING * DEAD_TIME_STEPS;
    return dead_time * dead_time / (radians * radians * L_min);
}

static double sign_of(double x)
{
    return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0;
}

static leg_kind kind_of(const pmsm_inverter *inverter, int x)
{
    const pmsm_inverter_setup *setup = &inverter->setup;
    const pmsm_leg *leg = &inverter->leg[x];
    const double U = inverter->U_dc, more = setup->r_leg[x];
    leg_kind kind = {TWO_SIDED, 0.0, setup->r_switch + more, 0.0, setup->r_switch + more};
    if (setup->open[x]) {
        kind.kind = CUT;
    } else if (leg->gate == PMSM_GATE_NONE) {
        kind.kind = leg->sign == 0 && inverter->gates && setup->capacitance > 0.0 ? CAPACITOR : TWO_SIDED;
        kind.v_out = -setup->V_diode;
        kind.v_in = U + setup->V_diode;
        kind.r_out = kind.r_in = setup->r_diode + more;
    } else if (setup->V_switch == 0.0) { /* a channel both ways */
        kind.kind = SOURCE;
        kind.v_out = kind.v_in = leg->gate == PMSM_GATE_TOP ? U : 0.0;
    } else if (leg->gate == PMSM_GATE_TOP) {
        kind.v_out = U - setup->V_switch;
        kind.v_in = U + setup->V_diode;
        kind.r_in = setup->r_diode + more;
    } else {
        kind.v_out = -setup->V_diode;
        kind.r_out = setup->r_diode + more;
        kind.v_in = setup->V_switch;
    }
    return kind;
}

/* ---- one step of circuits ----------------------------------------------------------------------------------- */

static void follow(pmsm_inverter *inverter, pmsm_current_lag *lag, const phase_step *step)
{
    double alpha, beta;
    phase_vector(step->u, &alpha, &beta);
    inverter->volt_seconds_alpha += step->h * alpha;
    inverter->volt_seconds_beta += step->h * beta;
    inverter->elapsed += step->h;
    if (!lag || lag->tau <= 0.0)
        return;
    const double decay = exp(-step->h / lag->tau), share = (1.0 - decay) * lag->tau / step->h;
    for (int x = 0; x < 3; x++) { /* exact for a current that moves evenly */
        const double start = step->i_start[x], end = step->i_end[x];
        lag->value[x] = end + (lag->value[x] - start) * decay - (end - start) * share;
    }
}

static void sources_of(const pmsm_inverter *inverter, const leg_kind kind[3], double h, phase_sources *sources)
{
    for (int x = 0; x < 3; x++) {
        const pmsm_leg *leg = &inverter->leg[x];
        sources->blocked[x] = kind[x].kind == CUT || (kind[x].kind == TWO_SIDED && leg->sign == 0);
        sources->v[x] = leg->sign < 0 ? kind[x].v_in : kind[x].v_out;
        sources->r[x] = leg->sign < 0 ? kind[x].r_in : kind[x].r_out;
        if (kind[x].kind == CAPACITOR) {
            sources->v[x] = leg->v_node;
            sources->r[x] = inverter->setup.r_leg[x] + 0.5 * h / inverter->setup.capacitance;
        }
    }
}

/* Legs at rest whose threshold the circuit exceeds start to conduct; returns whether one did. */
static int start_resting(pmsm_inverter *inverter, const leg_kind kind[3], const phase_sources *sources,
                         const phase_step *step)
{
    const double slack = SLACK * inverter->U_dc;
    int out = -1, in = -1, connected = 0;
    double excess_out = 0.0, excess_in = 0.0;
    for (int x = 0; x < 3; x++)
        connected += !sources->blocked[x];
    for (int x = 0; x < 3; x++) {
        if (!sources->blocked[x] || kind[x].kind == CUT)
            continue;
        const double low = kind[x].v_out - step->v_leg[x], high = step->v_leg[x] - kind[x].v_in;
        if (out < 0 || low > excess_out) {
            out = x;
            excess_out = low;
        }
        if (in < 0 || high > excess_in) {
            in = x;
            excess_in = high;
        }
    }
    if (out < 0)
        return 0;
    if (!connected) { /* the star point lies where it likes: only a pair can conduct */
        if (out == in || excess_out + excess_in <= slack)
            return 0;
        inverter->leg[out].sign = 1;
        inverter->leg[in].sign = -1;
        return 1;
    }
    if (excess_out <= slack && excess_in <= slack)
        return 0;
    if (excess_out > excess_in)
        inverter->leg[out].sign = 1;
    else
        inverter->leg[in].sign = -1;
    return 1;
}

/* Share of the step after which leg x leaves its state (1: not within it), and the sign it then has. */
static double leaves_after(const pmsm_inverter *inverter, const leg_kind *kind, int x, const phase_step *step, int *sign)
{
    const pmsm_leg *leg = &inverter->leg[x];
    if (kind->kind == TWO_SIDED && leg->sign != 0) {
        const double before = (double)leg->sign * step->i_start[x], after = (double)leg->sign * step->i_end[x];
        *sign = 0;
        if (after >= 0.0)
            return 1.0;
        return before <= 0.0 ? 0.0 : before / (before - after);
    }
    if (kind->kind == CAPACITOR) {
        const double v0 = leg->v_node, slack = SLACK * inverter->U_dc;
        const double v1 = v0 - step->h * step->i_mean[x] / inverter->setup.capacitance;
        if (v1 < kind->v_out - slack) {
            *sign = 1;
            return v0 <= kind->v_out ? 0.0 : (v0 - kind->v_out) / (v0 - v1);
        }
        if (v1 > kind->v_in + slack) {
            *sign = -1;
            return v0 >= kind->v_in ? 0.0 : (kind->v_in - v0) / (v1 - v0);
        }
    }
    return 1.0;
}

/* A leg's new state; where a diode's current ends, the node stands at its clamp. */
static void pass_to(pmsm_leg *leg, const leg_kind *kind, int sign)
{
    if (kind->kind == TWO_SIDED)
        leg->v_node = leg->sign > 0 ? kind->v_out : kind->v_in;
    leg->sign = sign;
}

/* One step of at most h seconds; returns how long it was. */
static double circuit_step(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h)
{
    const double capacitance = inverter->setup.capacitance;
    leg_kind kind[3];
    phase_sources sources;
    phase_step step;
    int leaving = -1, next_sign = 0;
    for (int x = 0; x < 3; x++)
        kind[x] = kind_of(inverter, x);
    for (int x = 0; x < 3; x++)
        if (kind[x].kind == CAPACITOR)
            h = fmin(h, STEP_OF_RINGING * sqrt(inverter->L_min * capacitance));
    for (int trial = 0;; trial++) {
        double first = 1.0;
        int who = -1, sign = 0;
        sources_of(inverter, kind, h, &sources);
        phase_try(plant, &sources, h, &step);
        if (trial == TRIALS) {
            inverter->event_overruns++;
            break;
        }
        if (leaving >= 0)
            break; /* already shortened to the event */
        if (start_resting(inverter, kind, &sources, &step))
            continue;
        for (int x = 0; x < 3; x++) {
            int then = 0;
            const double share = leaves_after(inverter, &kind[x], x, &step, &then);
            if (share < first) {
                first = share;
                who = x;
                sign = then;
            }
        }
        if (step.rest_after < first && step.rest_after * h > SAME_INSTANT) { /* the rotor comes to rest before */
            phase_try_to_rest(plant, &sources, h, &step);
            h = step.h;
            break;
        }
        if (who < 0)
            break;
        if (first * h < SAME_INSTANT) { /* now: change state and try again */
            pass_to(&inverter->leg[who], &kind[who], sign);
            kind[who] = kind_of(inverter, who);
            continue;
        }
        h *= first;
        leaving = who;
        next_sign = sign;
    }
    phase_accept(plant, &step);
    follow(inverter, lag, &step);
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        if (kind[x].kind == CAPACITOR)
            leg->v_node = fmin(fmax(leg->v_node - h * step.i_mean[x] / capacitance, kind[x].v_out), kind[x].v_in);
        else if (kind[x].kind != CUT)
            leg->v_node = sources.blocked[x] ? step.v_leg[x] : sources.v[x] - sources.r[x] * step.i_end[x];
        if (kind[x].kind == SOURCE)
            leg->sign = (int32_t)sign_of(step.i_end[x]); /* a release of the gates finds the diode by it */
    }
    if (leaving >= 0)
        pass_to(&inverter->leg[leaving], &kind[leaving], next_sign);
    return h;
}

/* ---- averaged ------------------------------------------------------------------------------------------------- */

static double shape_of(const pmsm_inverter *inverter, double x, double i)
{
    switch (inverter->setup.shape) {
    case PMSM_DEADTIME_SIGN: return tanh(i / (SIGN_KNEE * inverter->U_dc * inverter->T_s / inverter->L_min));
    case PMSM_DEADTIME_ATAN: return 0.63661977236758134308 * atan(x);
    case PMSM_DEADTIME_TANH: return tanh(x);
    case PMSM_DEADTIME_CAPACITIVE: return fabs(x) < 1.0 ? 0.5 * x : sign_of(x) * (1.0 - 0.5 / fabs(x));
    default: return 0.0;
    }
}

static double averaged_step(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h)
{
    const pmsm_inverter_setup *setup = &inverter->setup;
    double i[3];
    phase_sources sources;
    phase_step step;
    for (int x = 0; x < 3; x++) {
        i[x] = pmsm_plant_leg_current(plant, x);
        sources.blocked[x] = (int)setup->open[x];
    }
    for (int pass = 0; pass < 2; pass++) {
        for (int x = 0; x < 3; x++) {
            const double knees = setup->i_knee > 0.0 ? i[x] / setup->i_knee : 1e6 * sign_of(i[x]);
            const double lost = inverter->U_dc * setup->dead_time[x] / inverter->T_s;
            sources.v[x] = inverter->averaged.v[x] - lost * shape_of(inverter, knees, i[x])
                           - setup->V_switch * tanh(knees);
            sources.r[x] = setup->r_switch + setup->r_leg[x];
        }
        phase_try_to_rest(plant, &sources, h, &step);
        for (int x = 0; x < 3; x++)
            i[x] = step.i_mean[x];
    }
    phase_accept(plant, &step);
    follow(inverter, lag, &step);
    return step.h;
}

/* ---- a period --------------------------------------------------------------------------------------------------- */

/* Open a leg's gates; the current goes on in a diode, over the node's capacitance where it has to move. */
static void release(pmsm_inverter *inverter, const pmsm_plant *plant, int x)
{
    pmsm_leg *leg = &inverter->leg[x];
    const double i = pmsm_plant_leg_current(plant, x);
    const int through_diode = inverter->setup.V_switch > 0.0
                              && ((leg->gate == PMSM_GATE_TOP && leg->sign < 0)
                                  || (leg->gate == PMSM_GATE_BOTTOM && leg->sign > 0));
    if (leg->gate == PMSM_GATE_NONE)
        return;
    leg->gate = PMSM_GATE_NONE;
    if (!through_diode)
        leg->sign = inverter->setup.capacitance > 0.0 && inverter->gates ? 0 : (int32_t)sign_of(i);
}

static void turn(pmsm_inverter *inverter, const pmsm_plant *plant, int x, uint32_t level, double t)
{
    pmsm_leg *leg = &inverter->leg[x];
    leg->target = level;
    release(inverter, plant, x);
    leg->close_at = t + inverter->setup.dead_time[x];
}

/* Carry out what is due; returns when the next event is. */
static double due(pmsm_inverter *inverter, const pmsm_plant *plant, double t)
{
    double next = NEVER;
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        while (leg->next_edge < leg->edges && leg->edge[leg->next_edge] <= t + SAME_INSTANT) {
            turn(inverter, plant, x, !leg->target, leg->edge[leg->next_edge]);
            leg->next_edge++;
        }
        if (leg->close_at <= t + SAME_INSTANT) {
            leg->gate = leg->target == HIGH ? PMSM_GATE_TOP : PMSM_GATE_BOTTOM;
            leg->sign = (int32_t)sign_of(pmsm_plant_leg_current(plant, x));
            leg->close_at = NEVER;
        }
        next = fmin(next, leg->close_at);
        if (leg->next_edge < leg->edges)
            next = fmin(next, leg->edge[leg->next_edge]);
    }
    return next;
}

void pmsm_inverter_start(pmsm_inverter *inverter, const pmsm_plant *plant)
{
    inverter->L_min = fmin(plant->machine.L_d, plant->machine.L_q);
    for (int x = 0; x < 3; x++)
        inverter->leg[x].close_at = NEVER;
}

void pmsm_inverter_begin(pmsm_inverter *inverter, const double duty[3], uint32_t gates, double U_dc, double T_s)
{
    const pmsm_inverter_setup *setup = &inverter->setup;
    const double gone = inverter->elapsed > 0.0 ? inverter->T_s : 0.0;
    inverter->U_dc = U_dc;
    inverter->T_s = T_s;
    inverter->elapsed = inverter->volt_seconds_alpha = inverter->volt_seconds_beta = 0.0;
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        const double d = fmin(fmax(duty[x], 0.0), 1.0);
        const uint32_t always = (1.0 - d) * T_s < setup->minimum_pulse || d == 1.0;
        const uint32_t never = d * T_s < setup->minimum_pulse || d == 0.0;
        inverter->averaged.v[x] = d * U_dc;
        leg->edges = leg->next_edge = 0;
        if (!gates) {
            leg->gate = PMSM_GATE_NONE;
            leg->target = LOW;
            leg->close_at = NEVER;
            continue;
        }
        if (!inverter->gates) { /* first period: every leg is asked for its level at once */
            leg->target = LOW;
            leg->close_at = setup->dead_time[x];
        } else {
            leg->close_at -= leg->close_at < NEVER ? gone : 0.0;
        }
        if (leg->target != (always && !never))
            leg->edge[leg->edges++] = 0.0;
        if (!always && !never) {
            leg->edge[leg->edges++] = 0.5 * (1.0 - d) * T_s;
            leg->edge[leg->edges++] = 0.5 * (1.0 + d) * T_s;
        }
    }
    inverter->gates = gates;
}

void pmsm_inverter_run(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double t_from, double t_to)
{
    const pmsm_inverter_setup *setup = &inverter->setup;
    const int averaged = setup->model == PMSM_INVERTER_AVERAGED && inverter->gates;
    const double r = setup->r_switch + setup->r_diode + fmax(setup->r_leg[0], fmax(setup->r_leg[1], setup->r_leg[2]));
    const double longest = fmin(inverter->T_s / STEPS_OF_PERIOD, phase_longest_step(plant, r));
    double t = t_from;
    while (t_to - t > SAME_INSTANT) {
        if (averaged) {
            const double pieces = ceil((t_to - t) / longest);
            t += averaged_step(inverter, plant, lag, (t_to - t) / pieces);
            continue;
        }
        const double next = fmin(t_to, due(inverter, plant, t));
        const double pieces = ceil((next - t) / longest);
        if (pieces > 0.0)
            t += circuit_step(inverter, plant, lag, (next - t) / pieces);
        else
            t = next;
    }
}
