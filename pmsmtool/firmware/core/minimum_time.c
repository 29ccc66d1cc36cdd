/* SPDX-License-Identifier: MIT */
/* Minimum-time direction: steer the stator flux straight to where the target will be.
 *
 * With the flux a now and b at the target (rotor frame), the stator sees the way m(T) = e^(j w T) b - a + D T, D the
 * mean of the voltage that does not go into flux: the resistance drop and what the rows know beside the model. The
 * inverter covers V T of it in time T, so the transfer takes the smallest T with
 * |m(T)| = V T, and the voltage points along m(T). Exact for R = 0.
 */
#include "pmsm_period.h"

#define SHORTEST_PERIODS PMSM_C(3.0) /* a shorter transfer is left to the projection */
#define NEAR_SHARE PMSM_C(0.2)       /* of V_max T_s: a shorter way may be noise, and is left to the projection */
#define TRIALS 2u /* then the search goes on in the next period; 2.8 in the mean to start, 1 to follow */
#define TRIAL_STEPS 2u /* a trial takes as long as so many Newton steps of a row */
#define DIRECT_SHARE PMSM_C(0.7)     /* first guess, of the time at standstill */
#define GROWTH PMSM_C(1.0)           /* of T, where the gap does not close yet */
#define LONGEST_STEP PMSM_C(1.0)     /* rad */
#define LONGEST_ANGLE PMSM_C(100.0)  /* rad */
#define HOLD_SHARE PMSM_C(0.99)      /* of V_max: a current that needs more is not held at its limit */
#define CLOSE_SHARE PMSM_C(0.95)     /* of the transient current limit */
#define SHRINK PMSM_C(0.85)          /* of the square of a current little beyond the limit, in a period */
#define FASTER PMSM_C(1.4)           /* than the model a machine may be: 30 % less inductance than designed for */
#define FORCED PMSM_C(1.2)           /* of the square of the limit: the EMF has driven a current that far beyond */
#define ACCURACY PMSM_C(1e-2)        /* of V T, before the last step of Newton's method */

typedef struct {
    pmsm_dq a, b;             /* Wb, now and at the target */
    pmsm_dq drop_a, drop_b;   /* V, half of the lost voltage at either, turning with the rotor */
    pmsm_real omega, V;
} transfer;

typedef struct {
    pmsm_dq m;
    pmsm_dq rate;    /* dm / dT */
    pmsm_real gap;   /* |m| - V T */
    pmsm_real slope; /* d gap / dT times |m| */
    pmsm_real size;  /* |m| */
} transfer_point;

static transfer_point at_time(const transfer *t, pmsm_real T)
{
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(t->omega * T, &sine, &cosine);
    const pmsm_dq turned = {cosine * t->b.d - sine * t->b.q, sine * t->b.d + cosine * t->b.q};
    const pmsm_dq drop = {t->drop_a.d + cosine * t->drop_b.d - sine * t->drop_b.q,
                          t->drop_a.q + sine * t->drop_b.d + cosine * t->drop_b.q};
    transfer_point point;
    point.m.d = turned.d - t->a.d + drop.d * T;
    point.m.q = turned.q - t->a.q + drop.q * T;
    point.rate.d = drop.d - t->omega * turned.q;
    point.rate.q = drop.q + t->omega * turned.d;
    point.size = PMSM_SQRT(pmsm_square(point.m));
    point.gap = point.size - t->V * T;
    point.slope = (point.m.d * point.rate.d + point.m.q * point.rate.q) - t->V * point.size;
    return point;
}

/* The next time to look at. Newton's method comes to the first root from the left, where the gap is hardly ever
 * concave; a step is bounded in angle, and where the gap does not close the search goes on by a share of T. Left and
 * right of the root once known (high > 0), the next time stays between them. */
static pmsm_real next_time(const transfer *t, const transfer_point *point, pmsm_real T, pmsm_real low, pmsm_real high)
{
    pmsm_real step = GROWTH * T;
    if (point->slope < PMSM_C(0.0)) {
        step = -point->gap * point->size / point->slope;
        step = (step * pmsm_abs(t->omega) > LONGEST_STEP) ? LONGEST_STEP / pmsm_abs(t->omega) : step;
    }
    const pmsm_real next = T + step;
    const uint32_t outside = (next <= low || (high > PMSM_C(0.0) && next >= high)) ? 1u : 0u;
    return (outside != 0u) ? PMSM_C(0.5) * (low + high) : next;
}

/* The time T of the transfer and the way m, from a first guess. Not when it is shorter than least. */
static enum pmsm_transfer find_time(const transfer *t, pmsm_real least, pmsm_real *T, pmsm_dq *m, uint32_t *steps)
{
    pmsm_real low = PMSM_C(0.0);
    pmsm_real high = PMSM_C(0.0);
    const uint32_t most = *steps + TRIALS * TRIAL_STEPS;
    const uint32_t end = (most < PMSM_PROJECTION_STEPS) ? most : PMSM_PROJECTION_STEPS;
    while (*steps + TRIAL_STEPS <= end && *T * pmsm_abs(t->omega) <= LONGEST_ANGLE) {
        const transfer_point point = at_time(t, *T);
        *steps += TRIAL_STEPS;
        if (point.slope < PMSM_C(0.0) && pmsm_abs(point.gap) <= ACCURACY * t->V * *T) {
            const pmsm_real last = -point.gap * point.size / point.slope;
            m->d = point.m.d + last * point.rate.d;
            m->q = point.m.q + last * point.rate.q;
            *T += last;
            return (*T > least) ? PMSM_TRANSFER_FOUND : PMSM_TRANSFER_NONE;
        }
        if (point.gap > PMSM_C(0.0)) {
            low = *T;
        } else {
            high = *T;
            if (high <= least) {
                return PMSM_TRANSFER_NONE;
            }
        }
        *T = next_time(t, &point, *T, low, high);
    }
    return (*T * pmsm_abs(t->omega) <= LONGEST_ANGLE) ? PMSM_TRANSFER_SOUGHT : PMSM_TRANSFER_NONE;
}

/* Does the Euler step under w keep the transient current limit, also where the current moves FASTER than the model's,
 * from the sampled one on? A current little beyond it (an inductance that is off has led it there) is led back, one far
 * beyond it must not grow. If not, turn w, keeping its size, just so far that it does: the path slides along the limit
 * with the full voltage, on the side nearer to w. Not while the voltage cannot hold the present current: getting out of
 * there goes first. 0: w would break the limit. */
static uint32_t keep_current(const pmsm_period *period, pmsm_dq offset, pmsm_dq *w)
{
    const pmsm_params *params = period->params;
    const pmsm_dq i = {period->i.d + FASTER * (period->i_model.d - period->i.d),
                       period->i.q + FASTER * (period->i_model.q - period->i.q)};
    const pmsm_dq model = pmsm_model_voltage(period, i);
    const pmsm_real per_d = FASTER * period->state->derived.T_s / period->magnetics->L_d;
    const pmsm_real per_q = FASTER * period->state->derived.T_s / period->magnetics->L_q;
    const pmsm_dq hold = {model.d + offset.d, model.q + offset.q};
    const pmsm_dq free = {i.d - per_d * hold.d, i.q - per_q * hold.q}; /* at zero voltage */
    const pmsm_real limit = (pmsm_real)params->governor_I_transient_apk;
    const pmsm_real most = limit * limit;
    const pmsm_real now = pmsm_square(i);
    const pmsm_real square = (now <= FORCED * most) ? pmsm_max(SHRINK * now, most) : now;
    pmsm_dq step = {per_d * w->d, per_q * w->q};
    const pmsm_dq next = {free.d + step.d, free.q + step.q};
    if (pmsm_square(next) <= square) {
        return 1u;
    }
    if (pmsm_square(hold) > HOLD_SHARE * HOLD_SHARE * period->V_max * period->V_max) {
        return 0u;
    }
    /* |free + step|^2 = limit^2 is a line g w = h once |step|^2 is known; it hardly depends on the direction */
    const pmsm_dq g = {PMSM_C(2.0) * per_d * free.d, PMSM_C(2.0) * per_q * free.q};
    const pmsm_real gg = pmsm_square(g);
    const pmsm_real V_square = pmsm_square(*w);
    const pmsm_real side = (g.d * w->q - g.q * w->d < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    for (uint32_t k = 0u; k < 2u; k++) {
        const pmsm_real along = (square - pmsm_square(free) - pmsm_square(step)) / gg;
        const pmsm_real across = V_square / gg - along * along;
        if (!(across >= PMSM_C(0.0))) {
            return 0u;
        }
        const pmsm_real root = side * PMSM_SQRT(across);
        w->d = along * g.d - root * g.q;
        w->q = along * g.q + root * g.d;
        step.d = per_d * w->d;
        step.q = per_q * w->q;
    }
    return 1u;
}

/* At the transient current limit, where the voltage only just holds the current: a transfer from here is barred at
 * once, or as soon as it slides along the limit, and would start again from where that leads. */
static uint32_t is_cornered(const pmsm_period *period, pmsm_dq offset)
{
    const pmsm_dq model = pmsm_model_voltage(period, period->i_model);
    const pmsm_dq hold = {model.d + offset.d, model.q + offset.q};
    const pmsm_real limit = CLOSE_SHARE * (pmsm_real)period->params->governor_I_transient_apk;
    const pmsm_real V_square = period->V_max * period->V_max;
    const pmsm_real hold_square = pmsm_square(hold);
    return (pmsm_square(period->i_model) > limit * limit && hold_square > HOLD_SHARE * HOLD_SHARE * V_square &&
            hold_square <= V_square)
               ? 1u
               : 0u;
}

/* offset: voltage beside the model's, which turns with the rotor as the resistance drop does. may_start: 0 only follows
 * a transfer that is under way, which takes little time. */
enum pmsm_transfer pmsm_minimum_time(pmsm_period *period, const pmsm_row *row, pmsm_dq offset, pmsm_dq from,
                                     pmsm_dq target, uint32_t may_start, pmsm_dq *v, uint32_t *steps)
{
    pmsm_state *state = period->state;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_dq i = period->i_model;
    const pmsm_real half = PMSM_C(0.5);
    const pmsm_real R = period->R_s;
    const transfer t = {from, pmsm_flux(period, target),
                        {half * (R * i.d + offset.d), half * (R * i.q + offset.q)},
                        {half * (R * target.d + offset.d), half * (R * target.q + offset.q)},
                        period->omega_e, period->V_max};
    const pmsm_real least = SHORTEST_PERIODS * T_s;
    pmsm_real T = state->time_to_go - T_s;
    const pmsm_dq way = {t.b.d - t.a.d, t.b.q - t.a.q};
    const pmsm_real near = NEAR_SHARE * t.V * T_s;
    if (pmsm_is_within(way, near) != 0u) {
        state->time_to_go = PMSM_C(0.0);
        return PMSM_TRANSFER_NONE;
    }
    pmsm_dq m;
    enum pmsm_transfer found = PMSM_TRANSFER_NONE;
    if (T > PMSM_C(0.0)) {
        found = find_time(&t, least, &T, &m, steps);
    } else if (may_start != 0u && is_cornered(period, offset) == 0u) {
        T = DIRECT_SHARE * PMSM_SQRT(pmsm_square(way)) / t.V;
        T = pmsm_max(T, least);
        found = find_time(&t, least, &T, &m, steps);
    }
    state->time_to_go = (found == PMSM_TRANSFER_SOUGHT) ? T : PMSM_C(0.0);
    if (found != PMSM_TRANSFER_FOUND) {
        return found;
    }
    const pmsm_ab along = {m.d, m.q};
    pmsm_turn_half(period);
    pmsm_dq w = pmsm_park(along, period->sine_half, period->cosine_half); /* from the rotor in mid-period */
    const pmsm_real scale = pmsm_voltage_radius(period, w) / PMSM_SQRT(pmsm_square(m));
    w.d *= scale;
    w.q *= scale;
    if (keep_current(period, offset, &w) == 0u) {
        return PMSM_TRANSFER_BARRED;
    }
    state->time_to_go = T;
    v->d = (w.d - row->c_d) / row->m_dd;
    v->q = (w.q - row->c_q) / row->m_qq;
    return PMSM_TRANSFER_FOUND;
}
