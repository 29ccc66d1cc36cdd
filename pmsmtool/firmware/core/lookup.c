/* SPDX-License-Identifier: MIT */
/* Currents of a torque from the tables behind the parameters: linear in each axis, clamped at the ends.
 *
 * The table holds currents of the whole machine. Where they exceed the limit in force (0x6073, I2t) the torque is cut,
 * so that the field-weakening current becomes the one of the torque that is left: cutting i_q alone would give all
 * current to i_d. At a speed the currents of the torques are straight between the nodes, so the torque is that of the
 * place where they leave the circle of the limit. It is looked for where it was in the last period; else by bisection
 * over the nodes. Those count as steps of the period, which leaves the governor less to do.
 */
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

typedef struct {
    uint32_t index;   /* left node of the cell */
    pmsm_real weight; /* of the right node */
} axis_place;

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
    place.weight = (weight >= PMSM_C(0.0) && weight <= PMSM_C(1.0)) ? weight : PMSM_C(0.0);
    return place;
}

/* A 16-bit entry in units of lsb; NaN where the cell holds no operating point. */
static pmsm_real short_entry(uint32_t word, uint32_t shift, pmsm_real lsb)
{
    const uint32_t half = (word >> shift) & 0xFFFFu;
    return (half == 0x8000u) ? (pmsm_real)__builtin_nanf("")
                             : (pmsm_real)((int32_t)(half ^ 0x8000u) - 32768) * lsb;
}

typedef struct {
    const pmsm_params *params;
    const uint32_t *axis;   /* of the torque */
    const uint32_t *tables;
    uint32_t stride;        /* words from i_d to i_q */
    uint32_t first;         /* cell of speed and link at the first torque */
    axis_place y, z;
    pmsm_real sign;         /* of torque and i_q, where the table is mirrored */
    pmsm_real x;            /* N m, on the axis */
    pmsm_real square;       /* A^2, of the limit */
    uint32_t looked;        /* nodes */
} table_row;

typedef struct {    /* a node of the torque axis */
    pmsm_dq i;        /* A, weighted mean of its corners that hold a point */
    pmsm_real weight; /* of these; 0: there is none */
    uint32_t hole;    /* 1: a corner that counts holds no point */
} row_node;

static pmsm_dq entry(const table_row *row, uint32_t cell)
{
    const pmsm_params *params = row->params;
    const uint32_t *table = row->tables;
    const uint32_t stride = row->stride;
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

static void add_corner(row_node *node, const table_row *row, uint32_t cell, pmsm_real weight)
{
    if (weight == PMSM_C(0.0)) {
        return;
    }
    const pmsm_dq i = entry(row, cell);
    if (!(pmsm_abs(i.d) + pmsm_abs(i.q) <= CURRENT_MOST)) { /* nor a number, nor one of a current */
        node->hole = 1u;
        return;
    }
    node->i.d += weight * i.d;
    node->i.q += weight * i.q;
    node->weight += weight;
}

/* Corners without a point are left out and the rest is scaled up. */
static row_node node_of(const table_row *row, uint32_t k)
{
    const uint32_t n_z = row->params->lut_n_z;
    const uint32_t cell = row->first + k * (row->params->lut_n_y * n_z);
    const pmsm_real y_left = PMSM_C(1.0) - row->y.weight;
    const pmsm_real z_left = PMSM_C(1.0) - row->z.weight;
    row_node node = {{PMSM_C(0.0), PMSM_C(0.0)}, PMSM_C(0.0), 0u};
    add_corner(&node, row, cell, y_left * z_left);
    add_corner(&node, row, cell + n_z, row->y.weight * z_left);
    if (row->z.weight > PMSM_C(0.0)) {
        add_corner(&node, row, cell + 1u, y_left * row->z.weight);
        add_corner(&node, row, cell + n_z + 1u, row->y.weight * row->z.weight);
    }
    if (node.hole != 0u && node.weight > PMSM_C(0.0)) {
        node.i.d = node.i.d / node.weight;
        node.i.q = node.i.q / node.weight;
    }
    return node;
}

#define LINK_RATIO_MOST PMSM_C(1e3) /* nominal over present link voltage */

/* Speed at which the voltage of the table leaves the same flux as the present one does now. The resistance takes the
 * same voltage from both, and gives it to both where the machine brakes: what is left, exact without resistance, turns
 * the flux. By the current of the last reference, which does not shake. */
static pmsm_real equivalent_rpm(const pmsm_period *period, pmsm_real U_table)
{
    const pmsm_real rpm = period->omega_M * PMSM_RPM;
    if (period->U_ahead == U_table) {
        return rpm;
    }
    const pmsm_real i_q = period->state->reference_held.q;
    const pmsm_real drop = period->R_s * ((rpm < PMSM_C(0.0)) ? -i_q : i_q) /
                           (pmsm_real)period->params->inverter_voltage_utilisation;
    const pmsm_real left = period->U_ahead - drop;
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
    const pmsm_real V_m = (PMSM_C(1.0) - (pmsm_real)params->field_weakening_margin) *
                          ((pmsm_real)params->inverter_voltage_utilisation * period->U_ahead);
    const pmsm_real omega = pmsm_abs(period->omega_e);
    return (omega * top <= V_m) ? top : V_m / omega;
}

/* A table of one quadrant serves the others: (T, w) -> (-T, -w) with i_q -> -i_q is exact; a torque axis that starts
 * at zero is mirrored as well, which leaves the resistance out of the braking quadrant. */
static table_row place_row(pmsm_period *period, pmsm_real tau, pmsm_real limit)
{
    const pmsm_params *params = period->params;
    const uint32_t n_y = params->lut_n_y;
    const uint32_t n_z = params->lut_n_z;
    const uint32_t cells = params->lut_n_x * n_y * n_z;
    const uint32_t *axis_y = period->lut + params->lut_n_x;
    const uint32_t *axis_z = axis_y + n_y;
    pmsm_real y = second_coordinate(period, axis_y);
    table_row row;
    row.sign = PMSM_C(1.0);
    if (period->omega_M < PMSM_C(0.0) && node_at(axis_y, 0u) >= PMSM_C(0.0)) {
        row.sign = PMSM_C(-1.0);
        y = pmsm_abs(y);
    }
    if (node_at(period->lut, 0u) >= PMSM_C(0.0)) {
        row.sign = (tau < PMSM_C(0.0)) ? PMSM_C(-1.0) : PMSM_C(1.0);
    }
    row.params = params;
    row.axis = period->lut;
    row.tables = axis_z + n_z;
    row.stride = (params->lut_format == PMSM_LUT_BINARY32) ? cells : (cells + 1u) / 2u;
    row.y = find(axis_y, n_y, y, &period->flags);
    row.z = find(axis_z, n_z, period->U_ahead, &period->flags);
    row.first = row.y.index * n_z + row.z.index;
    row.x = row.sign * tau;
    row.square = limit * limit;
    row.looked = 0u;
    return row;
}

static uint32_t is_within(const table_row *row, const row_node *node)
{
    return (node->weight > PMSM_C(0.0) && pmsm_square(node->i) <= row->square) ? 1u : 0u;
}

static row_node look(table_row *row, uint32_t k)
{
    row->looked++;
    return node_of(row, k);
}

/* Where the way from a point inside the circle to one that is not leaves it. */
static pmsm_dq way_out(const table_row *row, pmsm_dq inside, const row_node *outside)
{
    if (outside->weight <= PMSM_C(0.0)) {
        return inside;
    }
    const pmsm_dq way = {outside->i.d - inside.d, outside->i.q - inside.q};
    const pmsm_real a = pmsm_square(way);
    const pmsm_real b = inside.d * way.d + inside.q * way.q;
    const pmsm_real c = pmsm_square(inside) - row->square;
    const pmsm_real root = PMSM_SQRT(b * b - a * c);
    const pmsm_real back = (a > PMSM_C(0.0)) ? (root - b) / a : PMSM_C(0.0);
    const pmsm_real share = (b > PMSM_C(0.0)) ? -c / (b + root) : back;
    const pmsm_dq i = {inside.d + share * way.d, inside.q + share * way.q};
    return i;
}

/* Is node k on the side of the torque that is asked for, and not beyond it? */
static uint32_t is_on_way(const table_row *row, uint32_t k)
{
    if (k >= row->params->lut_n_x) {
        return 0u;
    }
    const pmsm_real node = node_at(row->axis, k);
    return (node * row->x >= PMSM_C(0.0) && pmsm_abs(node) <= pmsm_abs(row->x)) ? 1u : 0u;
}

/* At the node inside the circle of the last period, or one beside it. 0: not there. */
static uint32_t cut_as_before(table_row *row, uint32_t *inner, pmsm_dq *i)
{
    const uint32_t step = (row->x < PMSM_C(0.0)) ? (uint32_t)-1 : 1u;
    uint32_t low = *inner;
    if (is_on_way(row, low) == 0u || is_on_way(row, low + step) == 0u) {
        return 0u;
    }
    row_node inside = look(row, low);
    row_node outside;
    if (is_within(row, &inside) != 0u) {
        outside = look(row, low + step);
        if (is_within(row, &outside) != 0u) {
            low += step;
            if (is_on_way(row, low + step) == 0u) {
                return 0u;
            }
            inside = outside;
            outside = look(row, low + step);
        }
    } else {
        if (node_at(row->axis, low) == PMSM_C(0.0) && inside.weight > PMSM_C(0.0)) { /* even no torque is outside */
            *i = inside.i;
            return 1u;
        }
        low -= step;
        if (is_on_way(row, low) == 0u) {
            return 0u;
        }
        outside = inside;
        inside = look(row, low);
    }
    if (is_within(row, &inside) == 0u || is_within(row, &outside) != 0u) {
        return 0u;
    }
    *inner = low;
    *i = way_out(row, inside.i, &outside);
    return 1u;
}

/* From the torque of a cell towards none; near is its node on that side, k. Where even no torque takes more than the
 * limit, its current is what the voltage needs. */
static pmsm_dq cut(table_row *row, uint32_t k, row_node near, row_node far, uint32_t *inner)
{
    const uint32_t backwards = (row->x < PMSM_C(0.0)) ? 1u : 0u;
    uint32_t low = k;
    uint32_t high = (backwards != 0u) ? k - 1u : k + 1u;
    row_node inside = near;
    row_node outside = far;
    if (is_within(row, &near) == 0u) {
        uint32_t known = 0u;
        outside = near;
        high = k;
        low = (backwards != 0u) ? row->params->lut_n_x - 1u : 0u;
        while (high > low + 1u || low > high + 1u) {
            const uint32_t middle = (low + high) / 2u;
            if (node_at(row->axis, middle) * row->x <= PMSM_C(0.0)) {
                low = middle;
                continue;
            }
            const row_node node = look(row, middle);
            if (is_within(row, &node) != 0u) {
                low = middle;
                inside = node;
                known = 1u;
            } else {
                high = middle;
                outside = node;
            }
        }
        inside = (known == 0u && low != high) ? look(row, low) : inside;
    }
    const pmsm_real x_low = node_at(row->axis, low);
    if (x_low * row->x < PMSM_C(0.0)) { /* no torque lies between, or a node is destroyed */
        const pmsm_real place = x_low / (x_low - node_at(row->axis, high));
        const pmsm_real share = (place >= PMSM_C(0.0) && place <= PMSM_C(1.0)) ? place : PMSM_C(0.0);
        inside.i.d += share * (outside.i.d - inside.i.d);
        inside.i.q += share * (outside.i.q - inside.i.q);
    }
    if (inside.weight <= PMSM_C(0.0)) {
        inside.i.d = (pmsm_real)row->params->field_weakening_i_d_min_a;
    }
    *inner = low;
    return (is_within(row, &inside) != 0u) ? way_out(row, inside.i, &outside) : inside.i;
}

/* Between two nodes, at the weight of the right one. */
static pmsm_dq between(pmsm_period *period, const row_node *left, const row_node *right, pmsm_real weight)
{
    pmsm_real a = PMSM_C(1.0) - weight;
    pmsm_real b = weight;
    if ((left->hole != 0u && a > PMSM_C(0.0)) || (right->hole != 0u && b > PMSM_C(0.0))) {
        period->flags |= (uint32_t)PMSM_FLAG_LUT_NO_POINT;
        a *= left->weight;
        b *= right->weight;
        if (a + b <= PMSM_C(0.0)) {
            const pmsm_dq none = {(pmsm_real)period->params->field_weakening_i_d_min_a, PMSM_C(0.0)};
            return none;
        }
        const pmsm_real scale = PMSM_C(1.0) / (a + b);
        a *= scale;
        b *= scale;
    }
    const pmsm_dq i = {a * left->i.d + b * right->i.d, a * left->i.q + b * right->i.q};
    return i;
}

pmsm_dq pmsm_lookup(pmsm_period *period, pmsm_real tau, pmsm_real limit)
{
    pmsm_state *state = period->state;
    table_row row = place_row(period, tau, limit);
    const uint32_t n = period->params->lut_n_x;
    uint32_t inner = state->lut_cut - 1u;
    pmsm_dq i;
    if (state->lut_cut != 0u && cut_as_before(&row, &inner, &i) != 0u) {
        state->lut_cut = inner + 1u;
        period->flags |= (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
        if (row.x < node_at(row.axis, 0u) || row.x > node_at(row.axis, n - 1u)) {
            period->flags |= (uint32_t)PMSM_FLAG_LUT_EDGE;
        }
    } else {
        const axis_place at = find(row.axis, n, row.x, &period->flags);
        const row_node left = look(&row, at.index);
        const row_node right = look(&row, at.index + 1u);
        const uint32_t flags = period->flags | (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
        i = between(period, &left, &right, at.weight);
        state->lut_cut = 0u;
        if (pmsm_square(i) > row.square) {
            const uint32_t backwards = (row.x < PMSM_C(0.0)) ? 1u : 0u;
            i = (backwards != 0u) ? cut(&row, at.index + 1u, right, left, &inner)
                                  : cut(&row, at.index, left, right, &inner);
            state->lut_cut = inner + 1u;
            period->flags = flags;
        }
    }
    const uint32_t more = (row.looked > PMSM_LUT_NODES) ? row.looked - PMSM_LUT_NODES : 0u;
    period->looked = row.looked;
    period->steps += more;
    state->live.iterations += more;
    i.q = row.sign * i.q;
    return i;
}
