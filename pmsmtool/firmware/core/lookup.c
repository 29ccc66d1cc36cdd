/* SPDX-License-Identifier: MIT */
/* Currents of a torque from the tables behind the parameters: linear in each axis, clamped at the ends. */
#include "pmsm_period.h"

#define CURRENT_MOST PMSM_C(1e6) /* A, in a cell; NaN marks one without an operating point */

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
static pmsm_axis_place find(const uint32_t *axis, uint32_t count, pmsm_real x, uint32_t *flags)
{
    pmsm_axis_place place = {0u, PMSM_C(0.0)};
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

/* A 16-bit entry in units of lsb; NaN where the cell holds no operating point. */
static pmsm_real short_entry(uint32_t word, uint32_t shift, pmsm_real lsb)
{
    const uint32_t half = (word >> shift) & 0xFFFFu;
    return (half == 0x8000u) ? (pmsm_real)__builtin_nanf("")
                             : (pmsm_real)((int32_t)(half ^ 0x8000u) - 32768) * lsb;
}

static pmsm_dq entry(const uint32_t *table, uint32_t stride, uint32_t cell, const pmsm_params *params)
{
    pmsm_dq i;
    if (params->lut_format == PMSM_LUT_BINARY32) {
        i.d = node_at(table, cell);
        i.q = node_at(table, stride + cell);
    } else {
        const pmsm_real lsb = (pmsm_real)params->lut_lsb_a;
        const uint32_t shift = 16u * (cell & 1u);
        i.d = short_entry(table[cell >> 1], shift, lsb);
        i.q = short_entry(table[stride + (cell >> 1)], shift, lsb);
    }
    return i;
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
    const pmsm_dq i = entry(tables, stride, cell, params);
    if (!(pmsm_abs(i.d) + pmsm_abs(i.q) <= CURRENT_MOST)) { /* nor a number, nor one of a current */
        sum->hole = 1u;
        return;
    }
    sum->sum.d += weight * i.d;
    sum->sum.q += weight * i.q;
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
static corner_sum interpolate(const pmsm_params *params, const pmsm_lookup_row *row, pmsm_axis_place x)
{
    const uint32_t n_y = params->lut_n_y;
    const uint32_t n_z = params->lut_n_z;
    const uint32_t cells = params->lut_n_x * n_y * n_z;
    const uint32_t stride = (params->lut_format == PMSM_LUT_BINARY32) ? cells : (cells + 1u) / 2u;
    const pmsm_real z_left = PMSM_C(1.0) - row->z.weight;
    const uint32_t right = n_y * n_z; /* cells from a node of x to the next */
    uint32_t cell = (x.index * n_y + row->y.index) * n_z + row->z.index;
    pmsm_real w_x = PMSM_C(1.0) - x.weight;
    corner_sum sum = {{PMSM_C(0.0), PMSM_C(0.0)}, PMSM_C(0.0), 0u};
    for (uint32_t k = 0u; k < 2u; k++) {
        const pmsm_real low = w_x * (PMSM_C(1.0) - row->y.weight);
        const pmsm_real high = w_x * row->y.weight;
        add_corner(&sum, row->tables, stride, cell, low * z_left, params);
        if (n_z > 1u) {
            add_corner(&sum, row->tables, stride, cell + 1u, low * row->z.weight, params);
        }
        add_corner(&sum, row->tables, stride, cell + n_z, high * z_left, params);
        if (n_z > 1u) {
            add_corner(&sum, row->tables, stride, cell + n_z + 1u, high * row->z.weight, params);
        }
        cell += right;
        w_x = x.weight;
    }
    return sum;
}

pmsm_lookup_row pmsm_lookup_at_speed(pmsm_period *period)
{
    const pmsm_params *params = period->params;
    const uint32_t *axis_y = period->lut + params->lut_n_x;
    const uint32_t *axis_z = axis_y + params->lut_n_y;
    pmsm_real y = second_coordinate(period, axis_y);
    pmsm_lookup_row row;
    row.sign = PMSM_C(1.0);
    if (period->omega_M < PMSM_C(0.0) && node_at(axis_y, 0u) >= PMSM_C(0.0)) {
        row.sign = PMSM_C(-1.0);
        y = pmsm_abs(y);
    }
    row.tables = axis_z + params->lut_n_z;
    row.y = find(axis_y, params->lut_n_y, y, &period->flags);
    row.z = find(axis_z, params->lut_n_z, period->U_dc, &period->flags);
    return row;
}

/* A table of one quadrant serves the others: (T, w) -> (-T, -w) with i_q -> -i_q is exact; a torque axis that starts
 * at zero is mirrored as well, which leaves the resistance out of the braking quadrant. */
pmsm_dq pmsm_lookup(pmsm_period *period, const pmsm_lookup_row *row, pmsm_real tau)
{
    const pmsm_params *params = period->params;
    const uint32_t *axis_x = period->lut;
    pmsm_real sign = row->sign;
    if (node_at(axis_x, 0u) >= PMSM_C(0.0)) {
        sign = (tau < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    }
    const corner_sum sum = interpolate(params, row, find(axis_x, params->lut_n_x, sign * tau, &period->flags));
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
