/* SPDX-License-Identifier: MIT */
/* Legs whose voltage depends on the sign of their current: diodes, thresholds, open phases; see leg_circuit.h.
 *
 * A leg with v_out < v_in has a dead band. While its current flows the source is the one of its direction; when the
 * current reaches zero the leg blocks, and stays without current as long as the voltage that would hold it there lies
 * inside the band. With two legs blocked all three are, and the pair with the largest excess of back-EMF conducts first.
 */
#include "leg_circuit.h"

#include <stddef.h>

#include "elementary.h"

#define EVENTS_MAX 24             /* zero crossings resolved inside one interval */
#define CROSSING_STEPS 3          /* secant steps to a zero crossing */
#define CROSSING_TOLERANCE 1.0e-5 /* share of the starting current that is then taken out of the flux */
#define I_ZERO 1.0e-9             /* A: below this a sign is rounding */
#define V_SAME 1.0e-12            /* V: thresholds closer than this make no dead band */
#define FAR 1.0e300               /* V */

/* ---- one step ----------------------------------------------------------------------------------------------- */

static void leg_currents(const pmsm_plant *plant, double i[3])
{
    for (int x = 0; x < 3; x++)
        i[x] = pmsm_plant_leg_current(plant, x);
}

/* Exact for a current that is straight over the interval. */
static void follow_lag(pmsm_current_lag *lag, const double i_start[3], const double i_end[3], double h)
{
    if (lag->decay_h != h) {
        lag->decay = pmsm_real64_exp(-h / lag->tau);
        lag->decay_h = h;
    }
    for (int x = 0; x < 3; x++) {
        const double behind = (i_end[x] - i_start[x]) / h * lag->tau;
        lag->value[x] = i_end[x] - behind + (lag->value[x] - i_start[x] + behind) * lag->decay;
    }
}

/* Mean power (W) that the legs take from the link: their currents at the voltage of the rail they are connected to, the
 * devices' drops and slopes left out. Dead time is a connection to the other rail. */
static double taken_from_link(const pmsm_inverter *inverter, const pmsm_supply *supply, const double i_start[3],
                              const double i_end[3])
{
    const double U_dc = inverter->U_dc, drop = inverter->setup.V_switch + inverter->setup.V_diode + V_SAME;
    double power = 0.0;
    for (int x = 0; x < 3; x++) {
        const double i = 0.5 * (i_start[x] + i_end[x]);
        double v = supply->v[x];
        if (inverter->circuit)
            v = v < drop ? 0.0 : (v > U_dc - drop ? U_dc : v);
        else if (supply->error)
            v -= pmsm_leg_dead_voltage(supply->error, x, i);
        power += v * i;
    }
    return power;
}

void pmsm_leg_advance(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag, const pmsm_supply *supply,
                      double h)
{
    double i_start[3], i_end[3];
    if (lag || inverter->metered)
        leg_currents(plant, i_start);
    pmsm_plant_advance(plant, supply, h);
    if (supply->blocked >= 0 && supply->blocked < 3)
        pmsm_plant_clear_current(plant, supply->blocked); /* its slope was held at zero: take out what the step left */
    if (lag || inverter->metered)
        leg_currents(plant, i_end);
    if (lag)
        follow_lag(lag, i_start, i_end, h);
    if (inverter->metered)
        inverter->energy += taken_from_link(inverter, supply, i_start, i_end) * h;
    inverter->volt_seconds_alpha += plant->u_alpha * h;
    inverter->volt_seconds_beta += plant->u_beta * h;
}

/* ---- who conducts ------------------------------------------------------------------------------------------- */

/* Legs with a dead band, as bits. */
static uint32_t dead_bands(const pmsm_leg_sources *sources)
{
    uint32_t legs = 0;
    for (int x = 0; x < 3; x++)
        if (sources->open[x] || sources->v_in[x] - sources->v_out[x] > V_SAME)
            legs |= 1u << x;
    return legs;
}

static void set_supply(pmsm_supply *supply, const pmsm_inverter *inverter, const pmsm_leg_sources *sources,
                       uint32_t banded)
{
    int32_t blocked = -1;
    for (int x = 0; x < 3; x++) {
        const int32_t sign = inverter->leg[x].sign;
        if (sign == 0 && (banded >> x & 1u))
            blocked = blocked < 0 ? x : 3;
        supply->v[x] = sign < 0 ? sources->v_in[x] : sources->v_out[x];
        supply->r[x] = sign < 0 ? sources->r_in[x] : sources->r_out[x];
        if (sources->open[x])
            supply->v[x] = supply->r[x] = 0.0;
    }
    const int equal = supply->r[0] == supply->r[1] && supply->r[1] == supply->r[2];
    supply->blocked = blocked;
    supply->general = !equal || supply->error || blocked >= 0;
    supply->series = supply->general ? 0.0 : supply->r[0];
    pmsm_leg_vector(supply->v, &supply->alpha, &supply->beta);
}

/* All currents zero: do the bands hold them there? If not, the pair with the largest excess conducts. */
static int release_pair(pmsm_inverter *inverter, const pmsm_plant *plant, const pmsm_leg_sources *sources,
                        uint32_t held)
{
    double emf[3], low = -FAR, high = FAR;
    int out = 0, in = 0;
    pmsm_plant_emf(plant, emf);
    for (int x = 0; x < 3; x++) {
        inverter->leg[x].sign = 0;
        if (sources->open[x])
            continue;
        if (sources->v_out[x] - emf[x] > low) {
            low = sources->v_out[x] - emf[x];
            out = x;
        }
        if (sources->v_in[x] - emf[x] < high) {
            high = sources->v_in[x] - emf[x];
            in = x;
        }
    }
    if (low - high <= V_SAME || out == in || (held >> out & 1u) || (held >> in & 1u))
        return 0;
    inverter->leg[out].sign = 1;
    inverter->leg[in].sign = -1;
    return 1;
}

/* A blocked leg stays so if the voltage it needs lies inside its band. */
static void release_leg(pmsm_inverter *inverter, const pmsm_plant *plant, const pmsm_leg_sources *sources,
                        const pmsm_supply *supply, int x)
{
    const double needed = pmsm_plant_hold_voltage(plant, supply, x, NULL);
    if (needed < sources->v_out[x])
        inverter->leg[x].sign = 1;
    else if (needed > sources->v_in[x])
        inverter->leg[x].sign = -1;
}

/* Signs at the start of an interval, and the supply they make; a leg of the mask `held` is not released again. */
static void settle(pmsm_inverter *inverter, const pmsm_plant *plant, const pmsm_leg_sources *sources, uint32_t banded,
                   uint32_t held, const double i[3], pmsm_supply *supply)
{
    int without = 0;
    for (int x = 0; x < 3; x++) {
        pmsm_leg *leg = &inverter->leg[x];
        if (sources->open[x])
            leg->sign = 0;
        else if (pmsm_real64_abs(i[x]) > I_ZERO)
            leg->sign = i[x] > 0.0 ? 1 : -1;
        without += leg->sign == 0;
    }
    const int at_rest = without >= 2 && !release_pair(inverter, plant, sources, held);
    set_supply(supply, inverter, sources, banded);
    if (at_rest || without == 0)
        return;
    for (int x = 0; x < 3; x++) {
        if (inverter->leg[x].sign == 0 && !sources->open[x] && (banded & ~held) >> x & 1u) {
            release_leg(inverter, plant, sources, supply, x);
            set_supply(supply, inverter, sources, banded);
        }
    }
}

/* ---- zero crossings ------------------------------------------------------------------------------------------- */

/* The leg whose current left its sign first between i_start and i_end; -1 none. */
static int first_crossing(const pmsm_inverter *inverter, uint32_t banded, const double i_start[3],
                          const double i_end[3])
{
    int crossed = -1;
    double first = 2.0;
    for (int x = 0; x < 3; x++) {
        const double s = (double)inverter->leg[x].sign;
        if (s == 0.0 || !(banded >> x & 1u) || i_end[x] * s >= -I_ZERO)
            continue;
        const double start = i_start[x] * s > 0.0 ? i_start[x] : 0.0;
        const double share = start / (start - i_end[x]);
        if (share < first) {
            first = share;
            crossed = x;
        }
    }
    return crossed;
}

typedef struct {
    pmsm_plant_state plant;
    pmsm_current_lag lag;
    double volt_seconds_alpha, volt_seconds_beta;
} snapshot;

static void take(snapshot *at, const pmsm_inverter *inverter, const pmsm_plant *plant, const pmsm_current_lag *lag)
{
    at->plant = plant->state;
    if (lag)
        at->lag = *lag;
    at->volt_seconds_alpha = inverter->volt_seconds_alpha;
    at->volt_seconds_beta = inverter->volt_seconds_beta;
}

static void restore(const snapshot *at, pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag)
{
    plant->state = at->plant;
    if (lag)
        *lag = at->lag;
    inverter->volt_seconds_alpha = at->volt_seconds_alpha;
    inverter->volt_seconds_beta = at->volt_seconds_beta;
}

/* Go back to `before` and advance to where the current of leg x is zero; returns the time that took, 0 when the leg
 * had been released on the edge of its band and came back within the interval. */
static double stop_at_crossing(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag,
                               const pmsm_supply *supply, const snapshot *before, int x, double i_start, double h)
{
    const double enough = I_ZERO + CROSSING_TOLERANCE * pmsm_real64_abs(i_start);
    double tau = h;
    for (int trial = 0; trial < CROSSING_STEPS; trial++) {
        const double i_end = pmsm_plant_leg_current(plant, x);
        if (pmsm_real64_abs(i_end) <= enough)
            break;
        tau *= i_start / (i_start - i_end);
        restore(before, inverter, plant, lag);
        if (!(tau > 0.0)) {
            tau = 0.0;
            break;
        }
        pmsm_leg_advance(inverter, plant, lag, supply, tau);
    }
    inverter->leg[x].sign = 0;
    pmsm_plant_clear_current(plant, x);
    return tau;
}

void pmsm_leg_interval(pmsm_inverter *inverter, pmsm_plant *plant, pmsm_current_lag *lag,
                       const pmsm_leg_sources *sources, double h)
{
    const int averaged = inverter->gates && inverter->setup.model == PMSM_INVERTER_AVERAGED;
    const uint32_t banded = dead_bands(sources);
    pmsm_supply supply = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, NULL, -1, 0, 0, 0.0, 0.0, 0.0};
    uint32_t held = 0;
    double i[3];
    supply.error = averaged ? inverter->averaged.error : NULL;
    supply.brief = !averaged && h * inverter->brief_rate < 1.0;
    leg_currents(plant, i);
    if (banded == 0) {
        for (int x = 0; x < 3; x++)
            inverter->leg[x].sign = i[x] < 0.0 ? -1 : 1;
        set_supply(&supply, inverter, sources, banded);
        pmsm_leg_advance(inverter, plant, lag, &supply, h);
        return;
    }
    for (int event = 0; h > 0.0; event++) {
        double i_end[3];
        snapshot before;
        settle(inverter, plant, sources, banded, held, i, &supply);
        take(&before, inverter, plant, lag);
        pmsm_leg_advance(inverter, plant, lag, &supply, h);
        leg_currents(plant, i_end);
        const int x = first_crossing(inverter, banded, i, i_end);
        if (x < 0)
            return;
        if (event >= EVENTS_MAX) {
            inverter->event_overruns++;
            return;
        }
        const double tau = stop_at_crossing(inverter, plant, lag, &supply, &before, x, i[x], h);
        if (tau == 0.0)
            held |= 1u << x;
        h -= tau;
        leg_currents(plant, i);
    }
}
