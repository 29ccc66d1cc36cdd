/* Minimum-time direction: steer the stator flux straight to where the target will be.
 *
 * With the flux a now and b at the target (rotor frame), the stator sees the way m(T) = e^(j w T) b - a + D T, D the
 * mean of the voltage that does not go into flux: the resistance drop and what the rows know beside the model. The
 * inverter covers V T of it in time T, so the transfer takes the smallest T with
 * |m(T)| = V T, and the voltage points along m(T). Exact for R = 0.
 */
#include "pmsm_period.h"

#define SHORTEST_PERIODS PMSM_C(3.0) /* a shorter transfer is left to the projection */
#define MARCH_STEPS 14u
#define MARCH_GROWTH PMSM_C(1.4)
#define NEWTON_STEPS 4u
#define HOLD_SHARE PMSM_C(0.99)      /* of V_max: a current that needs more is not held at its limit */
#define ACCURACY PMSM_C(1e-3)        /* of V T */

typedef struct {
    pmsm_dq a, b;             /* Wb, now and at the target */
    pmsm_dq drop_a, drop_b;   /* V, half of the lost voltage at either, turning with the rotor */
    pmsm_real omega, V;
} transfer;

typedef struct {
    pmsm_dq m;
    pmsm_real size;  /* |m| */
    pmsm_real gap;   /* |m| - V T */
    pmsm_dq turned, drop; /* flux of the target and lost voltage, seen from the stator */
} transfer_point;

static transfer_point at_time(const transfer *t, pmsm_real T)
{
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(t->omega * T, &sine, &cosine);
    transfer_point point;
    point.turned.d = cosine * t->b.d - sine * t->b.q;
    point.turned.q = sine * t->b.d + cosine * t->b.q;
    const pmsm_dq drop = {t->drop_a.d + cosine * t->drop_b.d - sine * t->drop_b.q,
                          t->drop_a.q + sine * t->drop_b.d + cosine * t->drop_b.q};
    point.drop = drop;
    point.m.d = point.turned.d - t->a.d + drop.d * T;
    point.m.q = point.turned.q - t->a.q + drop.q * T;
    point.size = PMSM_SQRT(pmsm_square(point.m));
    point.gap = point.size - t->V * T;
    return point;
}

/* d gap / d T */
static pmsm_real slope_at(const transfer *t, const transfer_point *point)
{
    const pmsm_real rate_d = point->drop.d - t->omega * point->turned.q;
    const pmsm_real rate_q = point->drop.q + t->omega * point->turned.d;
    return (point->m.d * rate_d + point->m.q * rate_q) / (point->size + PMSM_C(1e-12)) - t->V;
}

/* Newton from T; 1 when it settled on a root where the gap closes. */
static uint32_t refine(const transfer *t, pmsm_real *T, transfer_point *point)
{
    for (uint32_t k = 0u; k < NEWTON_STEPS; k++) {
        *point = at_time(t, *T);
        const pmsm_real slope = slope_at(t, point);
        if (slope >= PMSM_C(0.0)) {
            return 0u;
        }
        if (pmsm_abs(point->gap) <= ACCURACY * t->V * *T) {
            return 1u;
        }
        *T -= point->gap / slope;
        if (*T <= PMSM_C(0.0) || *T * pmsm_abs(t->omega) > PMSM_C(100.0)) {
            return 0u;
        }
    }
    *point = at_time(t, *T);
    return (pmsm_abs(point->gap) <= PMSM_C(10.0) * ACCURACY * t->V * *T) ? 1u : 0u;
}

/* Upwards from below the first root: the gap cannot close faster than its Lipschitz bound; the growth factor keeps the
 * number of steps bounded. A transfer shorter than least is not looked for. */
static uint32_t march(const transfer *t, pmsm_real least, pmsm_real *T, transfer_point *point)
{
    const pmsm_dq way = {t->b.d - t->a.d, t->b.q - t->a.q};
    const pmsm_real bound = pmsm_abs(t->omega) * PMSM_SQRT(pmsm_square(t->b)) + PMSM_SQRT(pmsm_square(t->drop_a)) +
                            PMSM_SQRT(pmsm_square(t->drop_b)) + t->V;
    pmsm_real low = PMSM_C(0.0);
    pmsm_real gap_low = PMSM_SQRT(pmsm_square(way));
    for (uint32_t k = 0u; k < MARCH_STEPS; k++) {
        const pmsm_real safe = low + gap_low / bound;
        *T = (safe > MARCH_GROWTH * low) ? safe : MARCH_GROWTH * low;
        if (*T * pmsm_abs(t->omega) > PMSM_C(100.0)) {
            return 0u;
        }
        *point = at_time(t, *T);
        if (point->gap <= PMSM_C(0.0)) {
            if (*T <= least) {
                return 0u;
            }
            *T = low + (*T - low) * gap_low / (gap_low - point->gap); /* secant, then Newton */
            return refine(t, T, point);
        }
        low = *T;
        gap_low = point->gap;
    }
    return 0u;
}

static pmsm_dq flux(const pmsm_params *params, pmsm_dq i)
{
    const pmsm_dq psi = {(pmsm_real)params->motor_psi_f_wb + (pmsm_real)params->motor_L_d_app_h * i.d,
                         (pmsm_real)params->motor_L_q_app_h * i.q};
    return psi;
}

/* Does the Euler step under w keep the transient current limit, or not let a current beyond it grow? If not, turn w,
 * keeping its size, just so far that it does: the path slides along the limit with the full voltage, on the side
 * nearer to w. Not while the voltage cannot hold the present current: getting out of there goes first.
 * 0: w would break the limit. */
static uint32_t keep_current(const pmsm_period *period, pmsm_dq offset, pmsm_dq *w)
{
    const pmsm_params *params = period->params;
    const pmsm_dq i = period->i_model;
    const pmsm_dq model = pmsm_model_voltage(period, i);
    const pmsm_real per_d = period->state->derived.T_s / (pmsm_real)params->motor_L_d_h;
    const pmsm_real per_q = period->state->derived.T_s / (pmsm_real)params->motor_L_q_h;
    const pmsm_dq free = {i.d - per_d * (model.d + offset.d), i.q - per_q * (model.q + offset.q)}; /* at zero voltage */
    const pmsm_real limit = (pmsm_real)params->governor_I_transient_apk;
    const pmsm_real now = pmsm_square(i);
    const pmsm_real square = (now > limit * limit) ? now : limit * limit;
    pmsm_dq step = {per_d * w->d, per_q * w->q};
    const pmsm_dq next = {free.d + step.d, free.q + step.q};
    if (pmsm_square(next) <= square) {
        return 1u;
    }
    const pmsm_dq hold = {model.d + offset.d, model.q + offset.q};
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

/* offset: voltage beside the model's, which turns with the rotor as the resistance drop does. may_start: 0 only follows
 * a transfer that is under way, which takes little time. */
uint32_t pmsm_minimum_time(pmsm_period *period, const pmsm_row *row, pmsm_dq offset, pmsm_dq target,
                           uint32_t may_start, pmsm_dq *v)
{
    pmsm_state *state = period->state;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_dq i = period->i_model;
    const pmsm_real half = PMSM_C(0.5);
    const pmsm_real R = period->R_s;
    const transfer t = {flux(period->params, i), flux(period->params, target),
                        {half * (R * i.d + offset.d), half * (R * i.q + offset.q)},
                        {half * (R * target.d + offset.d), half * (R * target.q + offset.q)},
                        period->omega_e, period->V_max};
    pmsm_real T = state->time_to_go - T_s;
    transfer_point point;
    const pmsm_real least = SHORTEST_PERIODS * T_s;
    if ((T <= PMSM_C(0.0) || refine(&t, &T, &point) == 0u) &&
        (may_start == 0u || march(&t, least, &T, &point) == 0u)) {
        return 0u;
    }
    if (T <= least) {
        return 0u;
    }
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(PMSM_C(0.5) * T_s * period->omega_e, &sine, &cosine);
    const pmsm_ab along = {point.m.d, point.m.q};
    pmsm_dq w = pmsm_park(along, sine, cosine); /* seen from the rotor in the middle of the period */
    const pmsm_real radius = pmsm_voltage_radius(period, w);
    w.d *= radius / point.size;
    w.q *= radius / point.size;
    if (keep_current(period, offset, &w) == 0u) {
        return 0u;
    }
    state->time_to_go = T;
    v->d = (w.d - row->c_d) / row->m_dd;
    v->q = (w.q - row->c_q) / row->m_qq;
    return 1u;
}
