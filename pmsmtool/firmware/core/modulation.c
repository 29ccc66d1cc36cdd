/* SPDX-License-Identifier: MIT */
/* From a voltage demand to duty ratios: limit, delay-compensating angle, zero sequence, legs, and what came of it. */
#include "pmsm_period.h"

#define LIMIT_FLAG_MARGIN PMSM_C(1.00002) /* on the square: float rounding of a demand at the limit is no event */

/* Circle of radius V_max, keeping the direction. */
static pmsm_dq limit_to_circle(pmsm_period *period, pmsm_dq u)
{
    const pmsm_real square = pmsm_square(u);
    const pmsm_real limit = period->V_max * period->V_max;
    if (square <= limit) {
        return u;
    }
    period->flags |= (square > LIMIT_FLAG_MARGIN * limit) ? (uint32_t)PMSM_FLAG_VOLTAGE_LIMITED : 0u;
    const pmsm_real scale = period->V_max / PMSM_SQRT(square);
    u.d *= scale;
    u.q *= scale;
    return u;
}

/* Circle, or in the hexagon U_dc over the largest line voltage of the unit vector. */
pmsm_real pmsm_voltage_radius(const pmsm_period *period, pmsm_dq u)
{
    if (period->state->derived.hexagon == 0u) {
        return period->V_max;
    }
    const pmsm_abc legs = pmsm_clarke_inverse(pmsm_park_inverse(u, period->sine_out, period->cosine_out));
    const pmsm_real ab = pmsm_abs(legs.a - legs.b);
    const pmsm_real bc = pmsm_abs(legs.b - legs.c);
    const pmsm_real ca = pmsm_abs(legs.c - legs.a);
    const pmsm_real most = pmsm_max(pmsm_max(ab, bc), ca);
    const pmsm_real line = period->state->derived.duty_most * period->U_dc;
    return (most > PMSM_C(0.0)) ? line * PMSM_SQRT(pmsm_square(u)) / most : period->V_max;
}

static pmsm_real error_shape(pmsm_real i, pmsm_real i_knee)
{
    return pmsm_clamp(i / i_knee, PMSM_C(-1.0), PMSM_C(1.0));
}

/* Leg voltages that cancel the inverter's error, from the current as it will flow when they act. */
static pmsm_abc dead_time_voltage(const pmsm_period *period)
{
    const pmsm_params *params = period->params;
    pmsm_abc error = {PMSM_C(0.0), PMSM_C(0.0), PMSM_C(0.0)};
    if (params->inverter_deadtime_compensation == 0u) {
        return error;
    }
    const pmsm_abc i = pmsm_clarke_inverse(pmsm_park_inverse(period->i, period->sine_out, period->cosine_out));
    const pmsm_real V_dead = (pmsm_real)params->inverter_V_dead_v;
    const pmsm_real i_knee = (pmsm_real)params->inverter_i_knee_apk;
    error.a = V_dead * error_shape(i.a, i_knee);
    error.b = V_dead * error_shape(i.b, i_knee);
    error.c = V_dead * error_shape(i.c, i_knee);
    return error;
}

static pmsm_real duty(pmsm_real d, pmsm_real most, uint32_t *clipped)
{
    if (d > most) {
        *clipped = 1u;
        return most;
    }
    if (d < PMSM_C(0.0)) {
        *clipped = 1u;
        return PMSM_C(0.0);
    }
    return d;
}

/* Min-max zero sequence: the extreme legs stand symmetrically, V_max reaches U_dc/sqrt(3) of the duties in use. */
static uint32_t set_duties(const pmsm_derived *derived, pmsm_abc u, pmsm_real U_dc, uint32_t beyond,
                           pmsm_output *output)
{
    const pmsm_real high = pmsm_max(pmsm_max(u.a, u.b), u.c);
    const pmsm_real low = pmsm_min(pmsm_min(u.a, u.b), u.c);
    const pmsm_real middle = PMSM_C(0.5) * (high + low);
    const pmsm_real inverse = (U_dc > PMSM_C(0.0)) ? PMSM_C(1.0) / U_dc : PMSM_C(0.0);
    const pmsm_real centre = PMSM_C(0.5) * derived->duty_most;
    uint32_t clipped = 0u;
    output->duty_a = duty(centre + (u.a - middle) * inverse, derived->duty_most, &clipped);
    output->duty_b = duty(centre + (u.b - middle) * inverse, derived->duty_most, &clipped);
    output->duty_c = duty(centre + (u.c - middle) * inverse, derived->duty_most, &clipped);
    if (derived->shunts != 0u) {
        clipped |= pmsm_make_readable(derived, beyond, u, output);
    }
    return clipped;
}

void pmsm_modulate(pmsm_period *period, pmsm_output *output)
{
    const uint32_t options = period->params->current_options;
    const pmsm_derived *derived = &period->state->derived;
    const pmsm_dq limited = (derived->hexagon != 0u) ? period->u : limit_to_circle(period, period->u);
    uint32_t beyond = PMSM_BEYOND_NOT; /* the linear range */
    const pmsm_dq made = (derived->overmodulates != 0u) ? pmsm_lengthen(period, limited, &beyond) : limited;
    pmsm_ab stator = pmsm_park_inverse(made, period->sine_out, period->cosine_out);
    const pmsm_abc wanted = pmsm_clarke_inverse(stator);
    const pmsm_abc error = dead_time_voltage(period);
    const pmsm_abc legs = {wanted.a + error.a, wanted.b + error.b, wanted.c + error.c};
    period->u_realised = limited;
    if ((options & PMSM_CURRENT_RECORD_COMPENSATION) != 0u) {
        period->u_compensation = pmsm_park(pmsm_clarke(error), period->sine_out, period->cosine_out);
    }
    if (set_duties(derived, legs, period->U_dc, beyond, output) != 0u) {
        const pmsm_abc applied = {period->U_dc * output->duty_a - error.a, period->U_dc * output->duty_b - error.b,
                                  period->U_dc * output->duty_c - error.c};
        stator = pmsm_clarke(applied);
        period->flags |= (uint32_t)PMSM_FLAG_DUTY_CLIPPED;
        if (beyond == PMSM_BEYOND_HELD) { /* the fundamental is what was asked for: the controllers see that */
            stator = pmsm_part_harmonics(period, limited, stator);
        } else {
            period->u_realised = pmsm_park(stator, period->sine_out, period->cosine_out);
        }
        period->flags |= (derived->hexagon != 0u) ? (uint32_t)PMSM_FLAG_VOLTAGE_LIMITED : 0u;
    }
    output->u_alpha = stator.alpha;
    output->u_beta = stator.beta;
    output->gates = 1u;
}

/* The rotor turns on under a held voltage. */
void pmsm_hold_output(const pmsm_state *state, pmsm_output *output)
{
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(state->derived.T_s * state->live.omega_e, &sine, &cosine);
    const pmsm_ab held = pmsm_park_inverse(state->voltage_committed, sine, cosine);
    (void)set_duties(&state->derived, pmsm_clarke_inverse(held), state->U_dc_before, 0u, output);
    output->u_alpha = held.alpha;
    output->u_beta = held.beta;
    output->gates = state->gates_before;
}
