/* Minimum-time direction: steer the stator flux straight to where the target will be.
 *
 * With the flux a now and b at the target (rotor frame), the stator sees the way m(T) = e^(j w T) b - a + R_m T, R_m the
 * mean resistance drop. The inverter covers V T of it in time T, so the transfer takes the smallest T with
 * |m(T)| = V T, and the voltage points along m(T). Exact for R = 0.
 */
#include "pmsm_period.h"

#define SHORTEST_PERIODS PMSM_C(3.0) /* a shorter transfer is left to the projection */
#define MARCH_STEPS 24u
#define MARCH_GROWTH PMSM_C(1.25)
#define NEWTON_STEPS 4u
#define ACCURACY PMSM_C(1e-3)        /* of V T */

typedef struct {
    pmsm_dq a, b;             /* Wb, now and at the target */
    pmsm_dq drop_a, drop_b;   /* V, half the resistance drop of either, turning with the rotor */
    pmsm_real omega, V;
} transfer;

typedef struct {
    pmsm_dq m;
    pmsm_real size;  /* |m| */
    pmsm_real gap;   /* |m| - V T */
    pmsm_real slope; /* d gap / d T */
} transfer_point;

static transfer_point at_time(const transfer *t, pmsm_real T)
{
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(t->omega * T, &sine, &cosine);
    const pmsm_dq turned = {cosine * t->b.d - sine * t->b.q, sine * t->b.d + cosine * t->b.q};
    transfer_point point;
    const pmsm_dq drop = {t->drop_a.d + cosine * t->drop_b.d - sine * t->drop_b.q,
                          t->drop_a.q + sine * t->drop_b.d + cosine * t->drop_b.q};
    point.m.d = turned.d - t->a.d + drop.d * T;
    point.m.q = turned.q - t->a.q + drop.q * T;
    point.size = PMSM_SQRT(pmsm_square(point.m));
    point.gap = point.size - t->V * T;
    const pmsm_real rate_d = drop.d - t->omega * turned.q;
    const pmsm_real rate_q = drop.q + t->omega * turned.d;
    const pmsm_real along = (point.m.d * rate_d + point.m.q * rate_q) / (point.size + PMSM_C(1e-12));
    point.slope = along - t->V;
    return point;
}

/* Newton from T; 1 when it settled on a root where the gap closes. */
static uint32_t refine(const transfer *t, pmsm_real *T, transfer_point *point)
{
    for (uint32_t k = 0u; k < NEWTON_STEPS; k++) {
        *point = at_time(t, *T);
        if (pmsm_abs(point->gap) <= ACCURACY * t->V * *T) {
            return (point->slope < PMSM_C(0.0)) ? 1u : 0u;
        }
        if (point->slope >= PMSM_C(0.0)) {
            return 0u;
        }
        *T -= point->gap / point->slope;
        if (*T <= PMSM_C(0.0) || *T * pmsm_abs(t->omega) > PMSM_C(100.0)) {
            return 0u;
        }
    }
    *point = at_time(t, *T);
    return (pmsm_abs(point->gap) <= PMSM_C(10.0) * ACCURACY * t->V * *T) ? 1u : 0u;
}

/* Upwards from below the first root: the gap cannot close faster than its Lipschitz bound; the growth factor keeps the
 * number of steps bounded. */
static uint32_t march(const transfer *t, pmsm_real *T, transfer_point *point)
{
    const pmsm_real bound = pmsm_abs(t->omega) * PMSM_SQRT(pmsm_square(t->b)) + PMSM_SQRT(pmsm_square(t->drop_a)) +
                            PMSM_SQRT(pmsm_square(t->drop_b)) + t->V;
    pmsm_real low = PMSM_C(0.0);
    *point = at_time(t, low);
    *T = point->gap / bound;
    for (uint32_t k = 0u; k < MARCH_STEPS; k++) {
        if (*T * pmsm_abs(t->omega) > PMSM_C(100.0)) {
            return 0u;
        }
        *point = at_time(t, *T);
        if (point->gap <= PMSM_C(0.0)) {
            pmsm_real high = *T;
            for (uint32_t n = 0u; n < 2u * NEWTON_STEPS; n++) { /* bisection, then Newton */
                *T = PMSM_C(0.5) * (low + high);
                *point = at_time(t, *T);
                if (point->gap > PMSM_C(0.0)) {
                    low = *T;
                } else {
                    high = *T;
                }
            }
            return refine(t, T, point);
        }
        low = *T;
        const pmsm_real safe = *T + point->gap / bound;
        *T = (safe > MARCH_GROWTH * *T) ? safe : MARCH_GROWTH * *T;
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
 * nearer to w. Not while the admissible set is empty: then getting below the voltage limit goes before the current.
 * 0: w would break the limit. */
static uint32_t keep_current(const pmsm_period *period, pmsm_dq *w)
{
    const pmsm_params *params = period->params;
    const pmsm_dq i = period->i_model;
    const pmsm_dq model = pmsm_model_voltage(period, i);
    const pmsm_real per_d = period->state->derived.T_s / (pmsm_real)params->motor_L_d_h;
    const pmsm_real per_q = period->state->derived.T_s / (pmsm_real)params->motor_L_q_h;
    const pmsm_dq free = {i.d - per_d * model.d, i.q - per_q * model.q}; /* next current at zero voltage */
    const pmsm_real limit = (pmsm_real)params->governor_I_transient_apk;
    const pmsm_real now = pmsm_square(i);
    const pmsm_real square = (now > limit * limit) ? now : limit * limit;
    pmsm_dq step = {per_d * w->d, per_q * w->q};
    const pmsm_dq next = {free.d + step.d, free.q + step.q};
    if (pmsm_square(next) <= square) {
        return 1u;
    }
    if ((period->flags & PMSM_FLAG_GOVERNOR_FALLBACK) != 0u) {
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

uint32_t pmsm_minimum_time(pmsm_period *period, const pmsm_row *row, pmsm_dq target, pmsm_dq *v)
{
    pmsm_state *state = period->state;
    const pmsm_real T_s = state->derived.T_s;
    const pmsm_dq i = period->i_model;
    const pmsm_real half_R = PMSM_C(0.5) * period->R_s;
    const transfer t = {flux(period->params, i), flux(period->params, target), {half_R * i.d, half_R * i.q},
                        {half_R * target.d, half_R * target.q}, period->omega_e, period->V_max};
    pmsm_real T = state->time_to_go - T_s;
    transfer_point point;
    if (T <= PMSM_C(0.0) || refine(&t, &T, &point) == 0u) {
        if (march(&t, &T, &point) == 0u) {
            return 0u;
        }
    }
    if (T <= SHORTEST_PERIODS * T_s) {
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
    if (keep_current(period, &w) == 0u) {
        return 0u;
    }
    state->time_to_go = T;
    v->d = (w.d - row->c_d) / row->m_dd;
    v->q = (w.q - row->c_q) / row->m_qq;
    return 1u;
}
