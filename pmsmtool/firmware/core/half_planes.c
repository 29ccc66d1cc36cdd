/* SPDX-License-Identifier: MIT */
/* Exact projection on intersections of half planes in the plane, by the same exchange as for ellipses. */
#include "active_set.h"

#define NONE PMSM_PROJECTION_NONE

typedef struct {
    const pmsm_dq *a;
    const pmsm_real *b;
    pmsm_dq r;
    uint32_t basis[2];
} half_planes;

/* a v - b, relative to the size of the terms. */
static pmsm_real beyond(const half_planes *h, uint32_t k, pmsm_dq v)
{
    const pmsm_real size = pmsm_abs(h->a[k].d * v.d) + pmsm_abs(h->a[k].q * v.q) + pmsm_abs(h->b[k]);
    return (pmsm_dot(h->a[k], v) - h->b[k]) / (size + PMSM_C(1e-30));
}

/* Corner of two lines, if r sees it from inside the cone of their normals. */
static uint32_t corner(const half_planes *h, uint32_t k, uint32_t other, pmsm_dq *v)
{
    const pmsm_dq n1 = h->a[k];
    const pmsm_dq n2 = h->a[other];
    const pmsm_real det = n1.d * n2.q - n1.q * n2.d;
    if (pmsm_abs(det) <= PMSM_PROJECTION_SINGULAR * PMSM_SQRT(pmsm_square(n1) * pmsm_square(n2))) {
        return 0u;
    }
    v->d = (h->b[k] * n2.q - h->b[other] * n1.q) / det;
    v->q = (h->b[other] * n1.d - h->b[k] * n2.d) / det;
    const pmsm_dq pull = {h->r.d - v->d, h->r.q - v->q};
    const pmsm_real l1 = (pull.d * n2.q - pull.q * n2.d) / det;
    const pmsm_real l2 = (pull.q * n1.d - pull.d * n1.q) / det;
    return (l1 >= PMSM_C(0.0) && l2 >= PMSM_C(0.0)) ? 1u : 0u;
}

static uint32_t respects(const half_planes *h, uint32_t skip, pmsm_dq v)
{
    for (uint32_t k = 0u; k < 2u; k++) {
        if (h->basis[k] != NONE && h->basis[k] != skip && beyond(h, h->basis[k], v) > PMSM_PROJECTION_VIOLATION) {
            return 0u;
        }
    }
    return 1u;
}

static uint32_t exchange_line(half_planes *h, uint32_t k, pmsm_dq *v)
{
    const pmsm_dq n = h->a[k];
    const pmsm_real lambda = (pmsm_dot(n, h->r) - h->b[k]) / pmsm_square(n);
    pmsm_dq x = {h->r.d - lambda * n.d, h->r.q - lambda * n.q};
    if (respects(h, NONE, x) != 0u) {
        h->basis[0] = k;
        h->basis[1] = NONE;
        *v = x;
        return 1u;
    }
    for (uint32_t j = 0u; j < 2u; j++) {
        const uint32_t other = h->basis[j];
        if (other != NONE && corner(h, k, other, &x) != 0u && respects(h, other, x) != 0u) {
            h->basis[0] = k;
            h->basis[1] = other;
            *v = x;
            return 1u;
        }
    }
    return 0u;
}

uint32_t pmsm_project_half_planes(const pmsm_dq *a, const pmsm_real *b, uint32_t count, pmsm_dq r, pmsm_dq *v,
                                  uint32_t *active, uint32_t *steps)
{
    half_planes h = {a, b, r, {NONE, NONE}};
    pmsm_dq x = r;
    for (uint32_t round = 0u; round < 2u * PMSM_PROJECTION_ROUNDS; round++) {
        uint32_t k = 0u;
        pmsm_real worst = beyond(&h, 0u, x);
        for (uint32_t j = 1u; j < count; j++) {
            const pmsm_real g = beyond(&h, j, x);
            k = (g > worst) ? j : k;
            worst = pmsm_max(g, worst);
        }
        const uint32_t again = (k == h.basis[0] || k == h.basis[1]) ? 1u : 0u;
        if (worst <= PMSM_PROJECTION_VIOLATION || (again != 0u && worst <= PMSM_PROJECTION_STALL)) {
            *v = x;
            *active = h.basis[0];
            return ((h.basis[0] != NONE) ? 1u : 0u) + ((h.basis[1] != NONE) ? 1u : 0u);
        }
        if (again != 0u || exchange_line(&h, k, &x) == 0u) {
            return PMSM_PROJECTION_EMPTY;
        }
        (*steps)++;
    }
    return PMSM_PROJECTION_EMPTY;
}
