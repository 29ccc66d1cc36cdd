/* SPDX-License-Identifier: MIT */
/* Flux and inductances of a saturated machine at a current, from the nodes behind the look-up words.
 *
 * A node holds psi_d, psi_q/i_q, dpsi_d/di_d and dpsi_q/di_q; between the nodes each is bilinear, so all are continuous
 * and the inductances stay between those of the nodes. psi_d is even and psi_q odd in i_q: one half plane is enough.
 * Beyond the table the flux goes on with the inductances of its edge.
 */
#include "pmsm_period.h"

#define VALUES PMSM_SATURATION_VALUES

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

static void read_table(const pmsm_period *period, pmsm_dq i, pmsm_magnetics *m)
{
    const pmsm_params *p = period->params;
    const pmsm_derived *derived = &period->state->derived;
    const pmsm_real i_d_min = (pmsm_real)p->saturation_i_d_min_a;
    const pmsm_real i_q_max = (pmsm_real)p->saturation_i_q_max_a;
    const pmsm_real size_q = pmsm_abs(i.q);
    const pmsm_dq edge = {pmsm_clamp(i.d, i_d_min, (pmsm_real)p->saturation_i_d_max_a),
                          (size_q < i_q_max) ? size_q : i_q_max};
    pmsm_real right_d;
    pmsm_real right_q;
    const uint32_t row = left_node((edge.d - i_d_min) * derived->nodes_per_ampere.d, p->saturation_n_d, &right_d);
    const uint32_t column = left_node(edge.q * derived->nodes_per_ampere.q, p->saturation_n_q, &right_q);
    const uint32_t *low = period->lut + derived->saturation_word + VALUES * (row * p->saturation_n_q + column);
    const uint32_t *high = low + VALUES * p->saturation_n_q;
    pmsm_real found[VALUES];
    for (uint32_t k = 0u; k < VALUES; k++) {
        const pmsm_real a = value_at(low, k);
        const pmsm_real b = value_at(high, k);
        const pmsm_real at_low = a + right_q * (value_at(low, VALUES + k) - a);
        const pmsm_real at_high = b + right_q * (value_at(high, VALUES + k) - b);
        found[k] = at_low + right_d * (at_high - at_low);
    }
    m->L_d = found[2];
    m->L_q = found[3];
    m->L_d_app = m->L_d; /* along the tangent: psi_f takes what is left, so that psi_d is the table's */
    m->psi_f = found[0] - m->L_d * edge.d;
    m->L_q_app = (size_q > edge.q) ? m->L_q + (found[1] - m->L_q) * edge.q / size_q : found[1];
    m->K_p.d = m->L_d * derived->gain_per_L.d;
    m->K_p.q = m->L_q * derived->gain_per_L.q;
}

void pmsm_saturate(pmsm_period *period, pmsm_dq i)
{
    read_table(period, i, &period->state->local);
    period->magnetics = &period->state->local;
}

pmsm_dq pmsm_flux(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_magnetics *m = period->magnetics;
    pmsm_magnetics there;
    if (m == &period->state->local) {
        read_table(period, i, &there);
        m = &there;
    }
    const pmsm_dq psi = {m->psi_f + m->L_d_app * i.d, m->L_q_app * i.q};
    return psi;
}
