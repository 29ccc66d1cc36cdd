/* SPDX-License-Identifier: MIT */
/* Flux and inductances of a saturated machine at a current, from the nodes behind the look-up words.
 *
 * A node holds psi_d, psi_q/i_q, dpsi_d/di_d and dpsi_q/di_q; between the nodes each is bilinear, so all are continuous
 * and the inductances stay between those of the nodes. psi_d is even and psi_q odd in i_q: one half plane is enough.
 * Beyond the table the flux goes on with the inductances of its edge.
 */
#include "pmsm_period.h"

#define VALUES PMSM_SATURATION_VALUES
#define FLUX_MOST (PMSM_C(2.0) * (pmsm_real)PMSM_FLUX_MOST) /* Wb, between or beyond nodes */

typedef union {
    uint32_t u;
    float f;
} word_bits;

static pmsm_real value_at(const uint32_t *words, uint32_t k)
{
    word_bits bits;
    bits.u = words[k];
    return (pmsm_real)bits.f;
}

/* Left node and what is left of x, in nodes. */
static uint32_t left_node(pmsm_real x, uint32_t count, pmsm_real *rest)
{
    uint32_t k = (x >= PMSM_C(0.0)) ? (uint32_t)x : 0u; /* NaN from a destroyed memory stays on the table */
    k = (k > count - 2u) ? count - 2u : k;
    *rest = x - (pmsm_real)k;
    return k;
}

typedef struct {          /* where a current lies in the table */
    pmsm_dq edge;         /* A, the nearest on it, i_q without its sign */
    pmsm_real size_q;     /* A */
    const uint32_t *low;  /* left node, and the one a step of i_d on */
    const uint32_t *high;
    pmsm_dq right;        /* share of the nodes to the right */
} table_place;

static table_place find_place(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_params *p = period->params;
    const pmsm_derived *derived = &period->state->derived;
    const pmsm_real i_d_min = (pmsm_real)p->saturation_i_d_min_a;
    const pmsm_real i_q_max = (pmsm_real)p->saturation_i_q_max_a;
    table_place at;
    at.size_q = pmsm_abs(i.q);
    at.edge.d = pmsm_clamp(i.d, i_d_min, (pmsm_real)p->saturation_i_d_max_a);
    at.edge.q = pmsm_min(at.size_q, i_q_max);
    const uint32_t row =
        left_node((at.edge.d - i_d_min) * derived->nodes_per_ampere.d, p->saturation_n_d, &at.right.d);
    const uint32_t column = left_node(at.edge.q * derived->nodes_per_ampere.q, p->saturation_n_q, &at.right.q);
    at.low = period->lut + derived->saturation_word + VALUES * (row * p->saturation_n_q + column);
    at.high = at.low + VALUES * p->saturation_n_q;
    return at;
}

static inline pmsm_real interpolate(const table_place *at, uint32_t k)
{
    const pmsm_real a = value_at(at->low, k);
    const pmsm_real b = value_at(at->high, k);
    const pmsm_real at_low = a + at->right.q * (value_at(at->low, VALUES + k) - a);
    const pmsm_real at_high = b + at->right.q * (value_at(at->high, VALUES + k) - b);
    return at_low + at->right.d * (at_high - at_low);
}

/* psi_q / i_q at any i_q. */
static pmsm_real apparent_q(const table_place *at)
{
    const pmsm_real at_edge = interpolate(at, 1u);
    if (at->size_q <= at->edge.q) {
        return at_edge;
    }
    const pmsm_real L_q = interpolate(at, 3u);
    return L_q + (at_edge - L_q) * at->edge.q / at->size_q;
}

static uint32_t is_inductance(pmsm_real L)
{
    return (L >= PMSM_C(0.99) * (pmsm_real)PMSM_INDUCTANCE_LEAST && L <= (pmsm_real)PMSM_INDUCTANCE_MOST) ? 1u : 0u;
}

/* Nodes are checked when a set is loaded; what a destroyed memory holds in one of them leaves all as it was. */
void pmsm_saturate(pmsm_period *period, pmsm_dq i)
{
    const pmsm_derived *derived = &period->state->derived;
    pmsm_magnetics *local = &period->state->local;
    const table_place at = find_place(period, i);
    pmsm_magnetics m;
    m.L_d = interpolate(&at, 2u);
    m.L_q = interpolate(&at, 3u);
    m.L_d_app = m.L_d; /* along the tangent: psi_f takes what is left, so that psi_d is the table's */
    m.psi_f = interpolate(&at, 0u) - m.L_d * at.edge.d;
    m.L_q_app = apparent_q(&at);
    m.K_p.d = m.L_d * derived->gain_per_L.d;
    m.K_p.q = m.L_q * derived->gain_per_L.q;
    const uint32_t usable = is_inductance(m.L_d) & is_inductance(m.L_q) & is_inductance(m.L_q_app) &
                            ((pmsm_abs(m.psi_f) <= FLUX_MOST) ? 1u : 0u);
    if (usable != 0u) {
        *local = m;
    } else if (local->L_d == PMSM_C(0.0)) { /* there has been none */
        *local = derived->nominal;
    }
    period->magnetics = local;
}

pmsm_dq pmsm_flux(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_magnetics *m = period->magnetics;
    if (m != &period->state->local) {
        return pmsm_flux_here(m, i);
    }
    const table_place at = find_place(period, i);
    pmsm_dq psi = {interpolate(&at, 0u), apparent_q(&at) * i.q};
    if (i.d != at.edge.d) {
        psi.d += interpolate(&at, 2u) * (i.d - at.edge.d);
    }
    return (pmsm_abs(psi.d) + pmsm_abs(psi.q) <= FLUX_MOST) ? psi : pmsm_flux_here(m, i);
}
