/* SPDX-License-Identifier: MIT */
/* Averaged and switch-level inverter: what the legs are at each instant; see inverter.h. */
#include "inverter.h"

#include <stddef.h>

#include "elementary.h"
#include "leg_circuit.h"

#define NEVER 1.0e300           /* s */
#define I_LEAST 1.0e-9          /* A, knee of a shape that was given none */
#define BRIEF 1.0e-3            /* R h / L of an interval whose midpoint rule is as good as RK4: 2e-10 of the current */
#define BRIEF_ERROR 0.03        /* h g / L of an averaged error's slope g, likewise: 5 uA of 11 A in 20000 periods */
#define STIFFNESS 1.0           /* largest h g / L of an averaged substep (RK4 is stable to 2.78) */
#define SUBSTEPS_MAX 64u
#define SIGN_SUBSTEPS 4u        /* substeps that resolve the sign shape */
#define LAG_SUBSTEPS 4u         /* with a slow sensor lag, so that the current is straight over a substep */
#define LAG_MEMORY 8.0          /* time constants after which a sensor lag has forgotten: exp(-8) = 3e-4 */
#define DIODE_SUBSTEPS 4u       /* with gates off */
#define REST_SHARE 0.8          /* of the DC link, for the line back-EMF of an idle machine */
#define COMMUTATION_STEP 0.3    /* substep of a floating node, in sqrt(L C) */
#define COMMUTATION_STEPS_MAX 128 /* 70 for 3 us of dead time, 86 pF and 0.24 mH */
#define FIRM_CURRENT 4.0        /* a current this many times what a dead time can change keeps its sign */

/* ---- averaged error --------------------------------------------------------------------------------- */

static double shape_value(uint32_t shape, double x)
{
    const double a = pmsm_real64_abs(x);
    switch (shape) {
    case PMSM_DEADTIME_ATAN:
        return (2.0 / PMSM_REAL64_PI) * pmsm_real64_atan(x);
    case PMSM_DEADTIME_SIGN: /* i_knee is set to what a substep resolves */
    case PMSM_DEADTIME_TANH:
        return pmsm_real64_tanh(x);
    case PMSM_DEADTIME_CAPACITIVE:
        if (a < 1.0)
            return 0.5 * x;
        return x > 0.0 ? 1.0 - 0.5 / a : 0.5 / a - 1.0;
    default:
        return 0.0;
    }
}

/* Largest slope of a shape, at x = 0. */
static double shape_slope(uint32_t shape)
{
    switch (shape) {
    case PMSM_DEADTIME_ATAN:
        return 2.0 / PMSM_REAL64_PI;
    case PMSM_DEADTIME_SIGN:
    case PMSM_DEADTIME_TANH:
        return 1.0;
    case PMSM_DEADTIME_CAPACITIVE:
        return 0.5;
    default:
        return 0.0;
    }
}

double pmsm_leg_dead_voltage(const pmsm_leg_error *error, int leg, double i)
{
    return error->V_dead[leg] * shape_value(error->shape, i * error->i_knee_inverse);
}

double pmsm_leg_error_voltage(const pmsm_leg_error *error, int leg, double i)
{
    if (error->shape == PMSM_DEADTIME_TANH || error->shape == PMSM_DEADTIME_SIGN) /* one curve for both */
        return (error->V_dead[leg] + error->V_device) * pmsm_real64_tanh(i * error->i_knee_inverse);
    double v = pmsm_leg_dead_voltage(error, leg, i);
    if (error->V_device > 0.0)
        v += error->V_device * pmsm_real64_tanh(i * error->i_knee_inverse);
    return v;
}

static double largest(const double value[3])
{
    const double ab = value[0] > value[1] ? value[0] : value[1];
    return ab > value[2] ? ab : value[2];
}

static uint32_t at_least(double n, uint32_t floor_value)
{
    uint32_t steps = n > (double)SUBSTEPS_MAX ? SUBSTEPS_MAX : (uint32_t)n;
    if ((double)steps < n && steps < SUBSTEPS_MAX)
        steps++;
    return steps > floor_value ? steps : floor_value;
}

/* Error curve and substeps of this period. */
static void begin_averaged(pmsm_inverter *inverter, const double duty[3])
{
    const pmsm_inverter_setup *setup = &inverter->setup;
    pmsm_leg_error *error = &inverter->error;
    for (int x = 0; x < 3; x++)
        inverter->averaged.v[x] = duty[x] * inverter->U_dc;
    pmsm_leg_vector(inverter->averaged.v, &inverter->averaged.alpha, &inverter->averaged.beta);
    if (inverter->exact)
        return;
    const int switching = largest(duty) > 0.0; /* shorted windings have no dead time */
    const double V_max = switching ? inverter->U_dc * largest(setup->dead_time) / inverter->T_s : 0.0;
    const double reach = inverter->T_s / inverter->L_min; /* A per V that one period can move */
    double knee = setup->i_knee, slope = setup->r_switch + largest(setup->r_leg);
    uint32_t substeps = 1;
    if (setup->shape == PMSM_DEADTIME_SIGN) {
        knee = (V_max + setup->V_switch) * reach / (STIFFNESS * (double)SIGN_SUBSTEPS);
        substeps = SIGN_SUBSTEPS;
    }
    if (!(knee > 0.0))
        knee = I_LEAST;
    error->shape = V_max > 0.0 ? setup->shape : (uint32_t)PMSM_DEADTIME_NONE;
    error->i_knee_inverse = 1.0 / knee;
    error->V_device = setup->V_switch;
    for (int x = 0; x < 3; x++) {
        error->V_dead[x] = inverter->U_dc * setup->dead_time[x] / inverter->T_s;
        inverter->averaged.r[x] = setup->r_switch + setup->r_leg[x];
    }
    slope += (V_max * shape_slope(error->shape) + error->V_device) / knee;
    inverter->averaged.error = error->shape != PMSM_DEADTIME_NONE || error->V_device > 0.0 ? error : NULL;
    const double *r = inverter->averaged.r;
    inverter->averaged.general = inverter->averaged.error || r[0] != r[1] || r[1] != r[2];
    inverter->averaged.series = inverter->averaged.general ? 0.0 : r[0];
    if (inverter->averaged.error)
        substeps = at_least(slope * reach / STIFFNESS, substeps);
    inverter->substeps = substeps;
    inverter->error_rate = slope / inverter->L_min;
}

/* ---- circuits ------------------------------------------------------------------------------------------ */

static void conducting_source(const pmsm_inverter_setup *setup, pmsm_leg_sources *sources, int x, double rail, int top)
{
    const int channel = setup->V_switch == 0.0;
    const double V_reverse = channel ? 0.0 : setup->V_diode, r_reverse = channel ? setup->r_switch : setup->r_diode;
    /* out of the leg: the top transistor, or the diode below; into it: the diode above, or the bottom transistor */
    sources->v_out[x] = rail - (top ? setup->V_switch : V_reverse);
    sources->r_out[x] = top ? setup->r_switch : r_reverse;
    sources->v_in[x] = rail + (top ? V_reverse : setup->V_switch);
    sources->r_in[x] = top ? r_reverse : setup->r_switch;
}

static void diode_source(const pmsm_inverter *inverter, pmsm_leg_sources *sources, int x)
{
    sources->v_out[x] = -inverter->setup.V_diode;
    sources->v_in[x] = inverter->U_dc + inverter->setup.V_diode;
    sources->r_out[x] = sources->r_in[x] = inverter->setup.r_diode;
}

static void find_source(const pmsm_inverter *inverter, pmsm_leg_sources *sources, int x)
{
    sources->open[x] = inverter->setup.open[x];
    if (inverter->gates && inverter->setup.model == PMSM_INVERTER_AVERAGED) {
        sources->v_out[x] = sources->v_in[x] = inverter->averaged.v[x];
        sources->r_out[x] = sources->r_in[x] = inverter->averaged.r[x];
        return;
    }
    switch (inverter->leg[x].gate) {
    case PMSM_GATE_TOP:
        conducting_source(&inverter->setup, sources, x, inverter->U_dc, 1);
        break;
    case PMSM_GATE_BOTTOM:
        conducting_source(&inverter->setup, sources, x, 0.0, 0);
        break;
    default:
        diode_source(inverter, sources, x);
    }
    sources->r_out[x] += inverter->setup.r_leg[x];
    sources->r_in[x] += inverter->setup.r_leg[x];
}

static int floats(const pmsm_inverter *inverter, int x)
{
    /* the averaged model has no commutations: its legs carry no gate states */
    return inverter->setup.model == PMSM_INVERTER_SWITCHED && inverter->gates && inverter->setup.capacitance > 0.0
           && inverter->leg[x].gate == PMSM_GATE_NONE && !inverter->setup.open[x];
}

/* The node moves by -i/C between the rails and its diodes; its mean over h is what the machine sees. */
static double float_node(const pmsm_inverter *inverter, pmsm_leg *leg, double i, double h, double *v_end)
{
    const double low = -inverter->setup.V_diode, high = inverter->U_dc + inverter->setup.V_diode;
    const double step = -i * h / inverter->setup.capacitance;
    double target = leg->v_node + step;
    const double rail = target < low ? low : (target > high ? high : target);
    if (rail == target) {
        *v_end = target;
        return 0.5 * (leg->v_node + target);
    }
    const double share = step != 0.0 ? (rail - leg->v_node) / step : 0.0; /* of h, until the diode takes over */
    *v_end = rail;
    return share * 0.5 * (leg->v_node + rail) + (1.0 - share) * rail;
}

/* Interval in which at least one node floats: substeps, the node voltage leap-frogging with the current. */
static void run_commutation(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h)
{
    const double firm = FIRM_CURRENT * inverter->U_dc * h / inverter->L_min;
    const double resolved = COMMUTATION_STEP * sqrt(inverter->L_min * inverter->setup.capacitance);
    int steps = 1;
    for (int x = 0; x < 3; x++)
        if (floats(inverter, x) && pmsm_real64_abs(pmsm_plant_leg_current(plant, x)) < firm)
            steps = h < resolved * (double)COMMUTATION_STEPS_MAX ? (int)(h / resolved) + 1 : COMMUTATION_STEPS_MAX;
    const double dt = h / (double)steps;
    for (int n = 0; n < steps; n++) {
        pmsm_leg_sources sources;
        double v_half[3] = {0.0, 0.0, 0.0}, v_end[3] = {0.0, 0.0, 0.0};
        for (int x = 0; x < 3; x++) {
            pmsm_leg *leg = &inverter->leg[x];
            find_source(inverter, &sources, x);
            if (!floats(inverter, x))
                continue;
            const double i = pmsm_plant_leg_current(plant, x);
            v_half[x] = float_node(inverter, leg, i, dt, &v_end[x]);
            sources.v_out[x] = sources.v_in[x] = v_half[x];
            if (v_end[x] > -inverter->setup.V_diode && v_end[x] < inverter->U_dc + inverter->setup.V_diode)
                sources.r_out[x] = sources.r_in[x] = inverter->setup.r_leg[x]; /* no diode conducts yet */
        }
        pmsm_leg_interval(inverter, plant, lag, &sources, dt);
        for (int x = 0; x < 3; x++) {
            if (!floats(inverter, x))
                continue;
            pmsm_leg *leg = &inverter->leg[x];
            double v = v_end[x];
            if (v > -inverter->setup.V_diode && v < inverter->U_dc + inverter->setup.V_diode) {
                /* free: second half of the leap with the new current */
                v = v_half[x] - 0.5 * dt * pmsm_plant_leg_current(plant, x) / inverter->setup.capacitance;
                if (v < -inverter->setup.V_diode)
                    v = -inverter->setup.V_diode;
                if (v > inverter->U_dc + inverter->setup.V_diode)
                    v = inverter->U_dc + inverter->setup.V_diode;
            }
            leg->v_node = v;
        }
    }
}

static void run_circuit(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h)
{
    if (floats(inverter, 0) || floats(inverter, 1) || floats(inverter, 2)) {
        run_commutation(inverter, plant, lag, h);
        return;
    }
    pmsm_leg_sources sources;
    for (int x = 0; x < 3; x++)
        find_source(inverter, &sources, x);
    pmsm_leg_interval(inverter, plant, lag, &sources, h);
}

/* ---- gates ----------------------------------------------------------------------------------------------- */

/* Edges of a centre-aligned pulse of ratio d, and the level the last period left. */
static void set_edges(const pmsm_inverter *inverter, pmsm_leg *leg, double d)
{
    const double T_s = inverter->T_s, on = d * T_s;
    uint32_t level = leg->target;
    const int low = on <= 0.0 || on < inverter->setup.minimum_pulse;
    const int high = T_s - on <= 0.0 || T_s - on < inverter->setup.minimum_pulse;
    leg->edges = leg->next_edge = 0;
    if (low || high) {
        if (level != (uint32_t)(low ? 0 : 1))
            leg->edge[leg->edges++] = 0.0;
        return;
    }
    if (level)
        leg->edge[leg->edges++] = 0.0;
    leg->edge[leg->edges++] = 0.5 * (T_s - on);
    leg->edge[leg->edges++] = 0.5 * (T_s + on);
}

static void begin_switched(pmsm_inverter *inverter, const double duty[3], uint32_t gates_before)
{
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        if (!gates_before) { /* released: the bottom transistor closes after a dead time */
            leg->target = 0;
            leg->close_at = inverter->setup.dead_time[x];
            leg->v_node = 0.0;
        } else if (leg->close_at < NEVER) {
            leg->close_at -= inverter->T_s;
        }
        set_edges(inverter, leg, duty[x]);
    }
}

/* Apply what is due at time t; returns the time of the next change. */
static double gate_events(pmsm_inverter *inverter, double t)
{
    double next = NEVER;
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        while (leg->next_edge < leg->edges && leg->edge[leg->next_edge] <= t) {
            if (leg->gate != PMSM_GATE_NONE)
                leg->v_node = leg->gate == PMSM_GATE_TOP ? inverter->U_dc : 0.0;
            leg->gate = PMSM_GATE_NONE;
            leg->target ^= 1u;
            leg->close_at = leg->edge[leg->next_edge] + inverter->setup.dead_time[x];
            leg->next_edge++;
        }
        if (leg->close_at <= t) {
            leg->gate = leg->target ? PMSM_GATE_TOP : PMSM_GATE_BOTTOM;
            leg->close_at = NEVER;
        }
        if (leg->close_at < next)
            next = leg->close_at;
        if (leg->next_edge < leg->edges && leg->edge[leg->next_edge] < next)
            next = leg->edge[leg->next_edge];
    }
    return next;
}

/* ---- the period --------------------------------------------------------------------------------------------- */

void pmsm_inverter_start(pmsm_inverter *inverter, const pmsm_plant *plant)
{
    const pmsm_leg idle = {PMSM_GATE_NONE, 0, NEVER, {0.0, 0.0, 0.0}, 0, 0, 0.0, 0};
    for (int x = 0; x < 3; x++)
        inverter->leg[x] = idle;
    const pmsm_inverter_setup *setup = &inverter->setup;
    const double r = setup->r_switch > setup->r_diode ? setup->r_switch : setup->r_diode;
    inverter->brief_rate = (plant->R + r + largest(setup->r_leg)) / (BRIEF * pmsm_plant_smallest_inductance(plant));
    const int dead = setup->shape != PMSM_DEADTIME_NONE && largest(setup->dead_time) > 0.0;
    inverter->exact = !dead && setup->V_switch == 0.0 && setup->r_switch == 0.0 && setup->r_leg[0] == 0.0
                      && setup->r_leg[1] == 0.0 && setup->r_leg[2] == 0.0;
    inverter->averaged = (pmsm_supply){{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, NULL, -1, 0, 0, 0.0, 0.0, 0.0};
    inverter->gates = 0;
    inverter->circuit = 1;
    inverter->substeps = DIODE_SUBSTEPS;
    inverter->L_min = pmsm_plant_smallest_inductance(plant);
    inverter->error_rate = 0.0;
    inverter->volt_seconds_alpha = inverter->volt_seconds_beta = 0.0;
    inverter->elapsed = 0.0;
    inverter->metered = 0;
    inverter->energy = 0.0;
    inverter->event_overruns = 0;
}

void pmsm_inverter_begin(pmsm_inverter *inverter, const double duty[3], uint32_t gates, double U_dc, double T_s)
{
    const uint32_t *open = inverter->setup.open, before = inverter->gates;
    inverter->gates = gates;
    inverter->U_dc = U_dc;
    inverter->T_s = T_s;
    inverter->volt_seconds_alpha = inverter->volt_seconds_beta = 0.0;
    inverter->elapsed = 0.0;
    inverter->energy = 0.0;
    inverter->circuit = inverter->setup.model == PMSM_INVERTER_SWITCHED || !gates || open[0] || open[1] || open[2];
    if (!gates) {
        inverter->substeps = DIODE_SUBSTEPS;
        for (int x = 0; x < 3; x++) {
            inverter->leg[x].gate = PMSM_GATE_NONE;
            inverter->leg[x].close_at = NEVER;
            inverter->leg[x].edges = inverter->leg[x].next_edge = 0;
        }
    } else if (inverter->setup.model == PMSM_INVERTER_SWITCHED) {
        begin_switched(inverter, duty, before);
    } else {
        inverter->substeps = 1;
        begin_averaged(inverter, duty);
    }
}

/* Gates off, no current, and a back-EMF far from the DC link: nothing will happen within a period. */
static int is_at_rest(const pmsm_inverter *inverter, const pmsm_plant *plant)
{
    double emf[3];
    if (inverter->gates || plant->state.i_alpha != 0.0 || plant->state.i_beta != 0.0)
        return 0;
    pmsm_plant_emf(plant, emf);
    const double low[3] = {-emf[0], -emf[1], -emf[2]};
    return largest(emf) + largest(low) < REST_SHARE * inverter->U_dc;
}

/* Equal substeps of the averaged model and of gates off. */
static void run_equal(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h, uint32_t n)
{
    const double dt = h / (double)n;
    inverter->averaged.brief = dt * inverter->brief_rate < 1.0 && dt * inverter->error_rate < BRIEF_ERROR;
    for (uint32_t k = 0; k < n; k++) {
        if (inverter->circuit)
            run_circuit(inverter, plant, lag, dt);
        else
            pmsm_leg_advance(inverter, plant, lag, &inverter->averaged, dt);
    }
}

static void run_substeps(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double h)
{
    const uint32_t n = is_at_rest(inverter, plant) ? 1u : inverter->substeps;
    const double tail = lag ? LAG_MEMORY * lag->tau : 0.0;
    if (lag && n < LAG_SUBSTEPS && 2.0 * tail < h) {
        /* a filter that follows a straight line forgets within the tail what curvature the rest had */
        run_equal(inverter, plant, lag, h - tail, n);
        run_equal(inverter, plant, lag, tail, 1u);
    } else {
        run_equal(inverter, plant, lag, h, lag && n < LAG_SUBSTEPS ? LAG_SUBSTEPS : n);
    }
}

/* The resistor across the flux voltage: of this instant in the averaged model, of the last whole period with ripple,
 * which it would show in every sample of a zero vector; none with a leg open, or with the gates off. It moved there
 * over the period, not at its end: else a sensor with any lag showed it a period late. */
static void find_iron_current(const pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag)
{
    const uint32_t *open = inverter->setup.open;
    const double alpha = plant->iron_alpha, beta = plant->iron_beta;
    if (!inverter->gates || open[0] || open[1] || open[2])
        plant->iron_alpha = plant->iron_beta = 0.0;
    else if (inverter->setup.model == PMSM_INVERTER_AVERAGED)
        pmsm_plant_set_iron_current(plant, plant->u_alpha, plant->u_beta);
    else if (inverter->elapsed >= inverter->T_s)
        pmsm_plant_set_iron_current(plant, inverter->volt_seconds_alpha / inverter->elapsed,
                                    inverter->volt_seconds_beta / inverter->elapsed);
    if (lag) {
        const double behind = lag->tau / inverter->T_s, seen = 1.0 - behind * (1.0 - pmsm_real64_exp(-1.0 / behind));
        for (int x = 0; x < 3; x++)
            lag->value[x] += seen * (pmsm_leg_alpha[x] * (plant->iron_alpha - alpha)
                                     + pmsm_leg_beta[x] * (plant->iron_beta - beta));
    }
}

void pmsm_inverter_run(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, double t_from, double t_to)
{
    pmsm_current_lag *active = lag && lag->tau > 0.0 ? lag : NULL;
    if (!inverter->circuit && !active && inverter->substeps == 1u) { /* averaged, nothing to resolve: one step */
        if (t_to > t_from)
            pmsm_leg_advance(inverter, plant, NULL, &inverter->averaged, t_to - t_from);
    } else if (!inverter->gates || inverter->setup.model == PMSM_INVERTER_AVERAGED) {
        if (t_to > t_from)
            run_substeps(inverter, plant, active, t_to - t_from);
    } else {
        double t = t_from;
        while (t < t_to) {
            const double next = gate_events(inverter, t);
            const double until = next < t_to ? next : t_to;
            run_circuit(inverter, plant, active, until - t);
            t = until;
        }
    }
    inverter->elapsed = t_to;
    if (plant->machine.R_iron > 0.0)
        find_iron_current(inverter, plant, active);
}

double pmsm_inverter_smallest_capacitance(double dead_time, double L_min)
{
    const double root = dead_time / (COMMUTATION_STEP * (double)COMMUTATION_STEPS_MAX);
    return root * root / L_min;
}
