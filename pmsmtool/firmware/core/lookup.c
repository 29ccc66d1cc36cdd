/* SPDX-License-Identifier: MIT */
/* Currents of a torque from the tables behind the parameters: linear in each axis, clamped at the ends. */
#include "pmsm_period.h"

#define CURRENT_MOST PMSM_C(1e6) /* A, in a cell; NaN marks one without an operating point */

typedef struct {
    uint32_t index;    /* left node of the cell */
    pmsm_real weight;  /* of the right node */
} axis_place;

typedef union {
    uint32_t u;
    float f;
} word_bits;

static pmsm_real node_at(const uint32_t *axis, uint32_t k)
{
    word_bits bits;
    bits.u = axis[k];
    return (pmsm_real)bits.f;
}

/* Bisection over at most 255 nodes: eight steps. */
static axis_place find(const uint32_t *axis, uint32_t count, pmsm_real x, uint32_t *flags)
{
    axis_place place = {0u, PMSM_C(0.0)};
    if (count < 2u) {
        return place;
    }
    if (x <= node_at(axis, 0u)) {
        *flags |= (x < node_at(axis, 0u)) ? (uint32_t)PMSM_FLAG_LUT_EDGE : 0u;
        return place;
    }
    uint32_t low = 0u;
    uint32_t high = count - 1u;
    if (x >= node_at(axis, high)) {
        *flags |= (x > node_at(axis, high)) ? (uint32_t)PMSM_FLAG_LUT_EDGE : 0u;
        place.index = high - 1u;
        place.weight = PMSM_C(1.0);
        return place;
    }
    while (high - low > 1u) {
        const uint32_t middle = (low + high) / 2u;
        if (x < node_at(axis, middle)) {
            high = middle;
        } else {
            low = middle;
        }
    }
    const pmsm_real left = node_at(axis, low);
    place.index = low;
    const pmsm_real weight = (x - left) / (node_at(axis, high) - left);
    place.weight = (weight >= PMSM_C(0.0) && weight <= PMSM_C(1.0)) ? weight : PMSM_C(0.0); /* axis destroyed */
    return place;
}

/* One table entry; NaN where the cell holds no operating point. */
static pmsm_real entry(const uint32_t *table, uint32_t cell, const pmsm_params *params)
{
    if (params->lut_format == PMSM_LUT_BINARY32) {
        return node_at(table, cell);
    }
    const uint32_t half = (table[cell / 2u] >> (16u * (cell % 2u))) & 0xFFFFu;
    if (half == 0x8000u) {
        return (pmsm_real)__builtin_nanf("");
    }
    const int32_t value = (half < 0x8000u) ? (int32_t)half : (int32_t)half - 65536;
    return (pmsm_real)value * (pmsm_real)params->lut_lsb_a;
}

typedef struct {
    pmsm_dq sum;
    pmsm_real weight;
    uint32_t hole; /* 1: a corner that counts holds no point */
} corner_sum;

static void add_corner(corner_sum *sum, const uint32_t *tables, uint32_t stride, uint32_t cell, pmsm_real weight,
                       const pmsm_params *params)
{
    if (weight == PMSM_C(0.0)) {
        return;
    }
    const pmsm_real i_d = entry(tables, cell, params);
    const pmsm_real i_q = entry(tables + stride, cell, params);
    if (!(pmsm_abs(i_d) + pmsm_abs(i_q) <= CURRENT_MOST)) { /* nor a number, nor one of a current */
        sum->hole = 1u;
        return;
    }
    sum->sum.d += weight * i_d;
    sum->sum.q += weight * i_q;
    sum->weight += weight;
}

#define LINK_RATIO_MOST PMSM_C(1e3) /* nominal over present link voltage */

/* Speed at which the voltage of the table leaves the same flux as the present one does now. The resistance takes the
 * same voltage from both, and gives it to both where the machine brakes: what is left, exact without resistance, turns
 * the flux. By the current of the last reference, which does not shake. */
static pmsm_real equivalent_rpm(const pmsm_period *period, pmsm_real U_table)
{
    const pmsm_real rpm = period->omega_M * PMSM_RPM;
    if (period->U_dc == U_table) {
        return rpm;
    }
    const pmsm_real i_q = period->state->reference_held.q;
    const pmsm_real drop = period->R_s * ((rpm < PMSM_C(0.0)) ? -i_q : i_q) /
                           (pmsm_real)period->params->inverter_voltage_utilisation;
    const pmsm_real left = period->U_dc - drop;
    const pmsm_real left_table = U_table - drop;
    const pmsm_real ratio = (left * LINK_RATIO_MOST > left_table) ? left_table / left : LINK_RATIO_MOST;
    return (left_table > PMSM_C(0.0)) ? rpm * ratio : rpm;
}

/* Second axis: mechanical speed (rpm), or the flux the voltage leaves, V_m/|omega_e| (Wb). */
static pmsm_real second_coordinate(const pmsm_period *period, const uint32_t *axis)
{
    const pmsm_params *params = period->params;
    if (params->lut_axis_kind == PMSM_LUT_SPEED_RPM) {
        const pmsm_real U_table = node_at(axis, params->lut_n_y);
        return (params->lut_n_z > 1u) ? period->omega_M * PMSM_RPM : equivalent_rpm(period, U_table);
    }
    const pmsm_real top = node_at(axis, params->lut_n_y - 1u);
    const pmsm_real V_m = (PMSM_C(1.0) - (pmsm_real)params->field_weakening_margin) * period->V_max;
    const pmsm_real omega = pmsm_abs(period->omega_e);
    return (omega * top <= V_m) ? top : V_m / omega;
}

/* Weighted corners of one cell. Corners without a point are left out and the rest is scaled up. */
static corner_sum interpolate(const pmsm_params *params, const uint32_t *tables, axis_place x, axis_place y,
                              axis_place z)
{
    const uint32_t n_y = params->lut_n_y;
    const uint32_t n_z = params->lut_n_z;
    const uint32_t cells = params->lut_n_x * n_y * n_z;
    const uint32_t stride = (params->lut_format == PMSM_LUT_BINARY32) ? cells : (cells + 1u) / 2u;
    corner_sum sum = {{PMSM_C(0.0), PMSM_C(0.0)}, PMSM_C(0.0), 0u};
    for (uint32_t k = 0u; k < 8u; k++) {
        const uint32_t right_x = k >> 2;
        const uint32_t right_y = (k >> 1) & 1u;
        const uint32_t right_z = k & 1u;
        if (right_z > 0u && n_z < 2u) {
            continue;
        }
        const pmsm_real w_x = (right_x != 0u) ? x.weight : PMSM_C(1.0) - x.weight;
        const pmsm_real w_y = (right_y != 0u) ? y.weight : PMSM_C(1.0) - y.weight;
        const pmsm_real w_z = (right_z != 0u) ? z.weight : PMSM_C(1.0) - z.weight;
        const uint32_t cell = ((x.index + right_x) * n_y + (y.index + right_y)) * n_z + (z.index + right_z);
        add_corner(&sum, tables, stride, cell, (w_x * w_y) * w_z, params);
    }
    return sum;
}

/* A table of one quadrant serves the others: (T, w) -> (-T, -w) with i_q -> -i_q is exact; a torque axis that starts
 * at zero is mirrored as well, which leaves the resistance out of the braking quadrant. */
pmsm_dq pmsm_lookup(pmsm_period *period, pmsm_real tau)
{
    const pmsm_params *params = period->params;
    const uint32_t *axis_x = period->lut;
    const uint32_t *axis_y = axis_x + params->lut_n_x;
    const uint32_t *axis_z = axis_y + params->lut_n_y;
    const uint32_t *tables = axis_z + params->lut_n_z;
    pmsm_real y = second_coordinate(period, axis_y);
    pmsm_real sign = PMSM_C(1.0);
    if (period->omega_M < PMSM_C(0.0) && node_at(axis_y, 0u) >= PMSM_C(0.0)) {
        sign = PMSM_C(-1.0);
        y = pmsm_abs(y);
    }
    if (node_at(axis_x, 0u) >= PMSM_C(0.0)) {
        sign = (tau < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    }
    const axis_place place_x = find(axis_x, params->lut_n_x, sign * tau, &period->flags);
    const axis_place place_y = find(axis_y, params->lut_n_y, y, &period->flags);
    const axis_place place_z = find(axis_z, params->lut_n_z, period->U_dc, &period->flags);
    const corner_sum sum = interpolate(params, tables, place_x, place_y, place_z);
    pmsm_dq i = {(pmsm_real)params->field_weakening_i_d_min_a, PMSM_C(0.0)};
    period->flags |= (sum.hole != 0u) ? (uint32_t)PMSM_FLAG_LUT_NO_POINT : 0u;
    if (sum.weight > PMSM_C(0.0)) {
        i = sum.sum;
        if (sum.hole != 0u) {
            i.d = i.d / sum.weight;
            i.q = i.q / sum.weight;
        }
        i.q = sign * i.q;
    }
    return i;
}
