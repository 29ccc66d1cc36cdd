/* SPDX-License-Identifier: MIT */
/* Reference governor in Q4.27, see the header. A product of two Q27 numbers is Q54; squares are compared as Q54. */
#include "pmsm_governor_q.h"

#define LIMIT (((int32_t)1 << 30) - 1) /* 8 base values: differences fit, two squares add up to less than 2^62 */
#define SEARCH_BITS 20u           /* the share of the way is found to 2^-20 */
#define ROOT_BITS 31u

/* Arithmetic shift of negative numbers is left to the compiler by C99; the core asks for it. */
typedef char pmsm_q27_shift_check[(((int32_t)-1 >> 1) == -1) ? 1 : -1];

typedef struct {
    pmsm_q27 m_dd, m_dq, m_qd, m_qq;
    pmsm_q27_dq c;
    int64_t square; /* Q54, V^2 */
} row;

static pmsm_q27 saturate(int64_t x)
{
    if (x > LIMIT) {
        return LIMIT;
    }
    return (x < -LIMIT) ? -LIMIT : (pmsm_q27)x;
}

static pmsm_q27_dq saturate_dq(pmsm_q27_dq x)
{
    const pmsm_q27_dq y = {saturate(x.d), saturate(x.q)};
    return y;
}

static int64_t product(pmsm_q27 a, pmsm_q27 b)
{
    return ((int64_t)a * b) >> PMSM_Q27_BITS;
}

static int64_t square_of(pmsm_q27_dq x)
{
    return (int64_t)x.d * x.d + (int64_t)x.q * x.q;
}

/* M v */
static pmsm_q27_dq apply(const row *r, pmsm_q27_dq v)
{
    const pmsm_q27_dq w = {saturate(product(r->m_dd, v.d) + product(r->m_dq, v.q)),
                           saturate(product(r->m_qd, v.d) + product(r->m_qq, v.q))};
    return w;
}

static pmsm_q27_dq plus(pmsm_q27_dq x, pmsm_q27_dq y)
{
    const pmsm_q27_dq z = {saturate((int64_t)x.d + y.d), saturate((int64_t)x.q + y.q)};
    return z;
}

static pmsm_q27_dq minus(pmsm_q27_dq x, pmsm_q27_dq y)
{
    const pmsm_q27_dq z = {saturate((int64_t)x.d - y.d), saturate((int64_t)x.q - y.q)};
    return z;
}

static pmsm_q27_dq times(pmsm_q27 share, pmsm_q27_dq x)
{
    const pmsm_q27_dq y = {saturate(product(share, x.d)), saturate(product(share, x.q))};
    return y;
}

/* Square root of Q54 in Q27, rounded up so that what is divided by it is not too large. */
static pmsm_q27 size_of(int64_t square)
{
    int64_t root = 0;
    for (uint32_t k = 0u; k < ROOT_BITS; k++) {
        const int64_t trial = root | ((int64_t)1 << (ROOT_BITS - 1u - k));
        if (trial * trial <= square) {
            root = trial;
        }
    }
    return saturate(root + 1);
}

/* 1 - V/|w| for |w| > V. */
static pmsm_q27 excess_share(pmsm_q27 V, int64_t square)
{
    return PMSM_Q27_ONE - (pmsm_q27)(((int64_t)V * PMSM_Q27_ONE) / size_of(square));
}

/* Q54 by Q27, saturated. */
static pmsm_q27 quotient(int64_t numerator, int64_t denominator)
{
    if (denominator == 0) {
        return 0;
    }
    return saturate(numerator / denominator);
}

static row present_row(const pmsm_governor_q_constants *motor, const pmsm_governor_q_input *in, pmsm_q27_dq rotation)
{
    row r;
    r.m_dd = motor->K_p_d;
    r.m_dq = 0;
    r.m_qd = 0;
    r.m_qq = motor->K_p_q;
    r.c.d = saturate((int64_t)in->integrator.d - product(motor->K_p_d, in->i.d) + rotation.d);
    r.c.q = saturate((int64_t)in->integrator.q - product(motor->K_p_q, in->i.q) + rotation.q);
    r.square = (int64_t)in->V_max * in->V_max;
    return r;
}

/* The steady state under a reference, with the voltage that the integrators hold beside R_s i. */
static row steady_row(const pmsm_governor_q_constants *motor, const pmsm_governor_q_input *in, pmsm_q27 emf,
                      pmsm_q27 V)
{
    row r;
    r.m_dd = motor->R_s;
    r.m_dq = saturate(-product(in->omega_e, motor->L_q));
    r.m_qd = saturate(product(in->omega_e, motor->L_d));
    r.m_qq = motor->R_s;
    r.c.d = saturate((int64_t)in->integrator.d - product(motor->R_s, in->i.d));
    r.c.q = saturate((int64_t)in->integrator.q - product(motor->R_s, in->i.q) + emf);
    r.square = (int64_t)V * V;
    return r;
}

/* The reference whose steady-state voltage has the direction of that of p, and the size V. */
static pmsm_q27_dq scale_voltage(const row *r, pmsm_q27 V, pmsm_q27_dq p)
{
    const pmsm_q27_dq w = plus(apply(r, p), r->c);
    const int64_t square = square_of(w);
    if (square <= r->square) {
        return p;
    }
    const pmsm_q27_dq cut = times(excess_share(V, square), w);
    const int64_t det = product(r->m_dd, r->m_qq) - product(r->m_dq, r->m_qd);
    const int64_t d = (int64_t)r->m_qq * cut.d - (int64_t)r->m_dq * cut.q;
    const int64_t q = (int64_t)r->m_dd * cut.q - (int64_t)r->m_qd * cut.d;
    const pmsm_q27_dq step = {quotient(d, det), quotient(q, det)};
    return minus(p, step);
}

/* Largest share of the way from p to r whose voltages stay inside both rows; a row within its slack counts as met. Both
 * ends of a voltage's way are saturated, so all between them are in range as well. */
static pmsm_q27 largest_share(const row rows[2], pmsm_q27_dq p, pmsm_q27_dq r, pmsm_governor_q_state *state)
{
    pmsm_q27_dq from[2];
    pmsm_q27_dq way[2];
    int64_t limit[2];
    uint32_t inside = 1u;
    for (uint32_t k = 0u; k < 2u; k++) {
        const pmsm_q27_dq to = plus(apply(&rows[k], r), rows[k].c);
        from[k] = plus(apply(&rows[k], p), rows[k].c);
        way[k].d = to.d - from[k].d;
        way[k].q = to.q - from[k].q;
        const int64_t now = square_of(from[k]);
        limit[k] = (now > rows[k].square) ? now : rows[k].square;
        if (square_of(to) > limit[k]) {
            inside = 0u;
        }
    }
    if (inside != 0u) {
        return PMSM_Q27_ONE;
    }
    pmsm_q27 share = 0;
    for (uint32_t n = 1u; n <= SEARCH_BITS; n++) {
        const pmsm_q27 trial = share | (PMSM_Q27_ONE >> n);
        uint32_t met = 0u;
        for (; met < 2u; met++) {
            const pmsm_q27_dq w = {from[met].d + (pmsm_q27)product(trial, way[met].d),
                                   from[met].q + (pmsm_q27)product(trial, way[met].q)};
            if (square_of(w) > limit[met]) {
                break;
            }
        }
        if (met == 2u) {
            share = trial;
        } else {
            state->binding = (met == 0u) ? (uint32_t)PMSM_Q_BINDING_ROW_0 : (uint32_t)PMSM_Q_BINDING_STEADY_STATE;
        }
    }
    return share;
}

static uint32_t is_within_slack(const row *r, pmsm_q27 slack, pmsm_q27_dq p)
{
    const pmsm_q27 part = (slack < 0) ? 0 : ((slack < PMSM_Q27_ONE) ? slack : PMSM_Q27_ONE);
    const int64_t more = ((r->square >> 30) * part) * 8; /* at most 2^30 * 2^27 * 2^3 */
    return (square_of(plus(apply(r, p), r->c)) <= r->square + more) ? 1u : 0u;
}

/* Row 0 in the direction of its voltage: the demand ends inside V. */
static pmsm_q27_dq meet_row_0(const pmsm_governor_q_constants *motor, const row *now, pmsm_q27 V, pmsm_q27_dq v)
{
    const pmsm_q27_dq w = plus(apply(now, v), now->c);
    const int64_t square = square_of(w);
    if (square <= now->square) {
        return v;
    }
    const pmsm_q27_dq cut = times(excess_share(V, square), w);
    const pmsm_q27_dq step = {saturate(product(motor->inverse_K_p_d, cut.d)),
                              saturate(product(motor->inverse_K_p_q, cut.q))};
    return minus(v, step);
}

pmsm_q27_dq pmsm_governor_q(const pmsm_governor_q_constants *motor, pmsm_governor_q_state *state,
                            const pmsm_governor_q_input *input)
{
    pmsm_governor_q_input in;
    in.request = saturate_dq(input->request);
    in.i = saturate_dq(input->i);
    in.integrator = saturate_dq(input->integrator);
    in.omega_e = saturate(input->omega_e);
    in.V_max = saturate((input->V_max > 0) ? input->V_max : 0);
    const pmsm_q27_dq p = saturate_dq(state->held);
    const pmsm_q27 emf = saturate(product(in.omega_e, motor->psi_f));
    const pmsm_q27 reactance_d = saturate(product(in.omega_e, motor->L_d));
    const pmsm_q27 reactance_q = saturate(product(in.omega_e, motor->L_q));
    const pmsm_q27_dq rotation = {saturate(-product(reactance_q, in.i.q)),
                                  saturate(product(reactance_d, in.i.d) + emf)};
    const pmsm_q27 V_steady = saturate(product(motor->steady_share, in.V_max));
    const row rows[2] = {present_row(motor, &in, rotation), steady_row(motor, &in, emf, V_steady)};
    pmsm_q27_dq v;
    state->binding = PMSM_Q_BINDING_NONE;
    if (is_within_slack(&rows[0], motor->slack, p) != 0u &&
        is_within_slack(&rows[1], motor->slack, p) != 0u) {
        const pmsm_q27 share = largest_share(rows, p, in.request, state);
        v = (share >= PMSM_Q27_ONE) ? in.request : plus(p, times(share, minus(in.request, p)));
    } else {
        state->binding = PMSM_Q_BINDING_STEADY_STATE;
        v = scale_voltage(&rows[1], V_steady, p);
    }
    v = meet_row_0(motor, &rows[0], in.V_max, v);
    state->held = v;
    return v;
}
