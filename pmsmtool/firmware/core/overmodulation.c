/* SPDX-License-Identifier: MIT */
/* Beyond the linear range: demands made longer, so that the fundamental of what the legs make of them is what was asked
 * for, and the harmonics taken out of the sampled current.
 */
#include "pmsm_period.h"

#define LINEAR_MARGIN PMSM_C(1.00002) /* on the square, for rounding */
#define SIX_STEPS_FLAT PMSM_C(0.9549297) /* 3/pi: fundamental of six steps over the linear limit, of edges' middles */
#define SIX_STEPS_SIDE PMSM_C(0.0738641) /* (sqrt(3) - 1.5)/pi: and of each half of an edge; 1.10266 in all */
#define UTILISATION_LINEAR PMSM_C(0.57736) /* 1/sqrt(3), and what rounding of a parameter may add */
#define DUTY_LEAST PMSM_C(0.5) /* of what is left: a set may hold any times */
#define SECOND_LEAST PMSM_C(0.6)
#define APART_MOST PMSM_C(0.4)
/* Of V_max: a demand above belongs to a step, and what the legs cut off is no harmonic. A governor puts steps on V_max,
 * and what is held 1.5 % below; without one a step demands more. */
#define HELD_GOVERNED PMSM_C(0.99)
#define HELD_FREE PMSM_C(1.005)

/* What minimum low-side time and shunts leave of the duties, and of the hexagon's edges. */
void pmsm_prepare_duties(pmsm_derived *derived, const pmsm_params *params)
{
    const pmsm_real per_ns = PMSM_C(1.0) / (pmsm_real)params->inverter_T_s_ns;
    const pmsm_real window = (pmsm_real)params->inverter_sample_window_ns * per_ns;
    derived->shunts = (window > PMSM_C(0.0)) ? params->inverter_shunts : 0u;
    const pmsm_real off = (pmsm_real)params->inverter_min_off_time_ns * per_ns;
    derived->duty_most = PMSM_C(1.0) - pmsm_clamp(off, PMSM_C(0.0), DUTY_LEAST);
    derived->utilisation_linear = derived->duty_most * UTILISATION_LINEAR;
    derived->second_duty_most = derived->duty_most;
    derived->duties_apart = PMSM_C(0.0);
    pmsm_real low = PMSM_C(1.0); /* shares of the edge's halves that the second leg may use */
    pmsm_real high = PMSM_C(1.0);
    if (derived->shunts == 3u && PMSM_C(1.0) - window < derived->duty_most) {
        derived->second_duty_most =
            pmsm_clamp(PMSM_C(1.0) - window, SECOND_LEAST * derived->duty_most, derived->duty_most);
        high = PMSM_C(2.0) * derived->second_duty_most / derived->duty_most - PMSM_C(1.0);
    } else if (derived->shunts == 1u) {
        const pmsm_real apart = PMSM_C(2.0) * window; /* centred pulses: half of a difference on either side */
        derived->duties_apart = pmsm_clamp(apart, PMSM_C(0.0), APART_MOST * derived->duty_most);
        low = PMSM_C(1.0) - PMSM_C(2.0) * derived->duties_apart / derived->duty_most;
        high = low;
    }
    const uint32_t mode = params->governor_mode;
    derived->held_share = (mode != PMSM_GOVERNOR_OFF && mode != PMSM_GOVERNOR_OBSERVE) ? HELD_GOVERNED : HELD_FREE;
    derived->side_low = low / PMSM_SQRT3;
    derived->side_high = high / PMSM_SQRT3;
    derived->over_most = SIX_STEPS_FLAT + SIX_STEPS_SIDE * (low + high);
    derived->over_rate = PMSM_C(6.0) * PMSM_PI * PMSM_SQRT3 / (low * low * low + high * high * high);
}

/* The legs cut a demand beyond the linear range to the hexagon's nearest point. A longer one has the fundamental that
 * is asked for (docs/control.md, 8). Lengths over the radius h of the inscribed circle: y = h/length, side = half of an
 * edge as far as the second leg may use it. */
#define COS_30 PMSM_C(0.8660254)
#define CORNER_FIRST PMSM_C(0.976) /* start of the search below the circle through the corners */
#define CORNER_SECOND PMSM_C(22.1)
#define RATIO_LEAST PMSM_C(0.02)   /* six steps, practically */

/* What demands on one side of an edge's middle contribute along the edge, times y, and what stays of the side's end. */
static pmsm_real along(pmsm_real side, pmsm_real y, pmsm_real *end)
{
    const pmsm_real sine = pmsm_min(side * y, PMSM_C(0.5)); /* the corner */
    const pmsm_real cosine = PMSM_SQRT(PMSM_C(1.0) - sine * sine);
    *end = side * (cosine - COS_30);
    return PMSM_C(0.5) * (pmsm_arctan(sine, cosine) - sine * cosine);
}

/* One step of Newton's method towards the y whose fundamental, over the linear limit, is asked for. */
static pmsm_real improved(const pmsm_derived *derived, pmsm_real y, pmsm_real fundamental)
{
    const pmsm_real cosine = pmsm_max(y, COS_30); /* of half of what lies beyond the edge */
    const pmsm_real sine = PMSM_SQRT(PMSM_C(1.0) - cosine * cosine);
    const pmsm_real angle = pmsm_arctan(sine, cosine);
    pmsm_real end_low;
    pmsm_real end_high;
    const pmsm_real inside = (PMSM_PI / PMSM_C(6.0) - angle) + PMSM_C(0.5) * COS_30 - sine * cosine; /* times y */
    const pmsm_real scaled =
        inside + along(derived->side_low, y, &end_low) + along(derived->side_high, y, &end_high);
    const pmsm_real found = (PMSM_C(3.0) / PMSM_PI) * (PMSM_C(2.0) * sine + end_low + end_high + scaled / y);
    const pmsm_real slope = (PMSM_C(3.0) / PMSM_PI) * scaled / (y * y);
    return y + (found - fundamental) / slope;
}

pmsm_dq pmsm_lengthen(const pmsm_period *period, pmsm_dq u, uint32_t *beyond)
{
    const pmsm_derived *derived = &period->state->derived;
    const pmsm_real radius = derived->utilisation_linear * period->U_dc;
    const pmsm_real square = pmsm_square(u);
    const pmsm_real held = derived->held_share * period->V_max;
    if (square <= LINEAR_MARGIN * radius * radius || radius <= PMSM_C(0.0)) {
        return u;
    }
    *beyond = (pmsm_square(period->u) > held * held) ? PMSM_BEYOND_IN_STEP : PMSM_BEYOND_HELD;
    const pmsm_real fundamental = PMSM_SQRT(square) / radius;
    const pmsm_real excess = fundamental - PMSM_C(1.0);
    const pmsm_real left = derived->over_most - fundamental;
    const pmsm_real corner = PMSM_C(1.0) - excess * (CORNER_FIRST + CORNER_SECOND * excess);
    const pmsm_real far = PMSM_SQRT(derived->over_rate * pmsm_max(left, PMSM_C(0.0)));
    pmsm_real ratio = pmsm_clamp(pmsm_min(corner, far), RATIO_LEAST, PMSM_C(1.0));
    ratio = pmsm_clamp(improved(derived, ratio, fundamental), RATIO_LEAST, PMSM_C(1.0));
    const pmsm_real scale = PMSM_C(1.0) / (ratio * fundamental);
    const pmsm_dq longer = {u.d * scale, u.q * scale};
    return longer;
}

typedef struct {
    pmsm_real wanted;
    pmsm_real *made;
} leg;

static void put_in_order(leg *lower, leg *upper)
{
    if (lower->wanted > upper->wanted) {
        const leg swapped = *lower;
        *lower = *upper;
        *upper = swapped;
    }
}

/* What shunts need: all legs lower until two of three can be read, and only then the second leg by itself; beyond the
 * linear range, for one shunt, the second leg apart from both others. In the order of what was wanted: the limits make
 * some of them equal. */
uint32_t pmsm_make_readable(const pmsm_derived *derived, uint32_t beyond, pmsm_abc wanted, pmsm_output *output)
{
    leg low = {wanted.a, &output->duty_a};
    leg second = {wanted.b, &output->duty_b};
    leg high = {wanted.c, &output->duty_c};
    put_in_order(&low, &second);
    put_in_order(&second, &high);
    put_in_order(&low, &second);
    const pmsm_real shift = pmsm_clamp(*second.made - derived->second_duty_most, PMSM_C(0.0), *low.made);
    *low.made -= shift;
    *second.made -= shift;
    *high.made -= shift;
    const pmsm_real apart = (beyond != 0u) ? derived->duties_apart : PMSM_C(0.0);
    const pmsm_real most = pmsm_min(*high.made - apart, derived->second_duty_most);
    const pmsm_real possible = pmsm_clamp(*second.made, *low.made + apart, most);
    const uint32_t clipped = (possible != *second.made) ? 1u : 0u;
    *second.made = possible;
    return clipped;
}

pmsm_ab pmsm_part_harmonics(pmsm_period *period, pmsm_dq asked, pmsm_ab applied)
{
    const pmsm_ab fundamental = pmsm_park_inverse(asked, period->sine_out, period->cosine_out);
    period->u_harmonic.d = applied.alpha - fundamental.alpha;
    period->u_harmonic.q = applied.beta - fundamental.beta;
    return fundamental;
}

#define HARMONIC_MEAN_WEIGHT PMSM_C(0.02) /* of a period: the mean of what pmsm_lengthen() lacks is the integrators' */

/* Its current, as far as the model knows it, is taken out of the sampled one: a controller that answered to it would
 * turn it into more harmonics, and a mean. */
void pmsm_remove_harmonics(pmsm_period *period)
{
    pmsm_state *state = period->state;
    const pmsm_magnetics *magnetics = period->magnetics;
    const pmsm_dq acted =
        (period->params->inverter_delay_periods >= 1.0F) ? state->harmonic_before : state->harmonic_committed;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_real kept = PMSM_C(1.0) / (PMSM_C(1.0) + T_s * period->R_s / magnetics->L_d);
    state->harmonic_flux.d = kept * (state->harmonic_flux.d + T_s * acted.d);
    state->harmonic_flux.q = kept * (state->harmonic_flux.q + T_s * acted.q);
    const pmsm_ab flux = {state->harmonic_flux.d, state->harmonic_flux.q};
    const pmsm_dq seen = pmsm_park(flux, period->sine, period->cosine);
    const pmsm_dq i = {seen.d / magnetics->L_d, seen.q / magnetics->L_q};
    state->harmonic_mean.d += HARMONIC_MEAN_WEIGHT * (i.d - state->harmonic_mean.d);
    state->harmonic_mean.q += HARMONIC_MEAN_WEIGHT * (i.q - state->harmonic_mean.q);
    period->i_harmonic.d = i.d - state->harmonic_mean.d;
    period->i_harmonic.q = i.q - state->harmonic_mean.q;
    period->i.d -= period->i_harmonic.d;
    period->i.q -= period->i_harmonic.q;
    period->i_model = period->i;
    period->u_harmonic.d = PMSM_C(0.0);
    period->u_harmonic.q = PMSM_C(0.0);
}
