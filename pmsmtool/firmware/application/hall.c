/* SPDX-License-Identifier: MIT */
/* Electrical angle by three Hall sensors. The wires show a sector. Between its edges the rotor is where the encoder has
 * counted to since the last edge, or, without an encoder, where it would be at the speed of the last sector. */
#include "application_parts.h"

#define HALF_TURN 0x80000000u
#define QUARTER_TURN 0x40000000u
#define QUARTER_PARTS 1073741824.0F /* the same */
#define SECTOR_MOST_S 0.05F  /* a rotor that took longer for a sector is taken to be in the middle of the next */

void pmsm_hall_prepare(pmsm_hall *hall, const pmsm_params *params)
{
    hall->axis[0] = pmsm_turn_part(params->hall_axis_1_rad);
    hall->axis[1] = pmsm_turn_part(params->hall_axis_2_rad);
    hall->axis[2] = pmsm_turn_part(params->hall_axis_3_rad);
}

/* The sector of a pattern: within a quarter turn of every wire's middle, be it high or low there. Its width is 0 where
 * no angle shows the pattern. */
static void find_sector(const pmsm_hall *hall, uint32_t pattern, uint32_t *low, uint32_t *width)
{
    const uint32_t first = hall->axis[0] + (((pattern & 1u) != 0u) ? 0u : HALF_TURN);
    int32_t least = 0;
    int32_t most = 0;
    for (uint32_t k = 1u; k < 3u; k++) {
        const uint32_t middle = hall->axis[k] + (((pattern >> k & 1u) != 0u) ? 0u : HALF_TURN);
        const int32_t apart = (int32_t)(middle - first);
        least = (apart < least) ? apart : least;
        most = (apart > most) ? apart : most;
    }
    const uint32_t spread = (uint32_t)most - (uint32_t)least;
    *low = first + (uint32_t)most - QUARTER_TURN;
    *width = (spread < HALF_TURN) ? HALF_TURN - spread : 0u;
}

/* Another sector: over the edge to a neighbour, else somewhere in it. */
static void enter(pmsm_hall *hall, uint32_t low, uint32_t width)
{
    const int32_t way = (int32_t)((low + width / 2u) - (hall->low + hall->width / 2u));
    const uint32_t up = (way > 0) ? 1u : 0u;
    const uint32_t neighbour = (hall->width != 0u && pmsm_abs((float)way) < QUARTER_PARTS) ? 1u : 0u;
    const float took = (float)hall->since + 1.0F;
    const uint32_t crossed = (neighbour != 0u && hall->entered != 0u && hall->up == up) ? 1u : 0u;
    hall->expected = (crossed != 0u) ? took * (float)width / (float)hall->width : 0.0F;
    hall->edge = (neighbour == 0u) ? low + width / 2u : ((up != 0u) ? low : low + width);
    hall->entered = neighbour;
    hall->up = up;
    hall->low = low;
    hall->width = width;
    hall->since = 0u;
}

/* In the sector by time: a rotor that is overdue at the far edge is rather in the middle, the longer the more. */
static uint32_t by_time(const pmsm_hall *hall, float T_s)
{
    const float since = (float)hall->since;
    float share = 0.5F;
    if (hall->expected > 0.0F && hall->expected * T_s <= SECTOR_MOST_S) {
        share = (since < hall->expected) ? since / hall->expected : 0.5F + 0.5F * hall->expected / since;
    }
    const uint32_t gone = (uint32_t)(share * (float)hall->width);
    return hall->low + ((hall->up != 0u) ? gone : hall->width - gone);
}

/* In the sector by the encoder, which has counted since the edge. */
static uint32_t by_encoder(const pmsm_hall *hall, uint32_t counted)
{
    const float within = (float)(hall->edge - hall->low) + (float)(int32_t)counted;
    return hall->low + (uint32_t)pmsm_clamp(within, 0.0F, (float)hall->width);
}

float pmsm_hall_speed(const pmsm_hall *hall)
{
    const float since = (float)hall->since;
    const float periods = (since < hall->expected) ? hall->expected : since;
    const float speed = (hall->expected > 0.0F) ? PMSM_TURN_PART * (float)hall->width / periods : 0.0F;
    return (hall->up != 0u) ? speed : -speed;
}

/* What an encoder would show whose electrical angle is that of the sensors. */
static void count(pmsm_hall *hall, uint32_t pole_pairs, pmsm_sensors *sensors)
{
    const int32_t moved = (int32_t)(hall->angle - hall->counted);
    if (moved > 0 && hall->angle < hall->counted) {
        hall->period = (hall->period + 1u < pole_pairs) ? hall->period + 1u : 0u;
        hall->turns += (hall->period == 0u) ? 1u : 0u;
    } else if (moved < 0 && hall->angle > hall->counted) {
        hall->turns -= (hall->period == 0u) ? 1u : 0u;
        hall->period = (hall->period == 0u) ? pole_pairs - 1u : hall->period - 1u;
    } else {
        /* within an electrical turn */
    }
    hall->counted = hall->angle;
    sensors->turns = (int32_t)hall->turns;
    sensors->angle = hall->period * ((0u - pole_pairs) / pole_pairs + 1u) + hall->angle / pole_pairs;
    sensors->encoder_failed = hall->failed;
    sensors->encoder_unreferenced = 0u;
}

void pmsm_hall_update(pmsm_application *app)
{
    pmsm_hall *hall = &app->hall;
    pmsm_sensors *s = &app->sensors;
    const uint32_t kind = app->params->hall_commutation;
    uint32_t low = 0u;
    uint32_t width = 0u;
    if (kind == (uint32_t)PMSM_HALL_NONE) {
        return;
    }
    const uint32_t along = app->params->motor_pole_pairs * s->angle;
    const uint32_t encoder = (app->params->encoder_reversed != 0u) ? 0u - along : along;
    find_sector(hall, s->hall, &low, &width);
    hall->failed = (width == 0u) ? 1u : 0u;
    if (hall->failed == 0u && (low != hall->low || width != hall->width)) {
        enter(hall, low, width);
        hall->encoder = encoder;
    } else {
        hall->since += (hall->since < HALF_TURN) ? 1u : 0u;
    }
    if (kind == (uint32_t)PMSM_HALL_START) {
        hall->angle = by_encoder(hall, encoder - hall->encoder);
    } else {
        hall->angle = by_time(hall, app->speed.T_s);
        count(hall, app->params->motor_pole_pairs, s);
    }
}
