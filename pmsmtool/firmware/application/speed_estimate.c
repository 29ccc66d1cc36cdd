/* SPDX-License-Identifier: MIT */
/* Mechanical speed from the encoder's angle: critically damped, both poles at exp(-w T). */
#include "application_parts.h"

uint32_t pmsm_turn_part(float angle_rad)
{
    const float turns = pmsm_abs(angle_rad) / (2.0F * PMSM_PI);
    const float part = (turns >= 1.0F) ? turns - 1.0F : turns;
    const uint32_t size = (uint32_t)(part * 4294967296.0F);
    return (angle_rad < 0.0F) ? 0u - size : size;
}

/* exp(-w T) by a series that stays positive. */
void pmsm_speed_prepare(pmsm_speed_estimate *speed, const pmsm_params *params)
{
    speed->T_s = 1e-9F * (float)params->inverter_T_s_ns;
    const float x = params->encoder_pll_bandwidth_rad_s * speed->T_s;
    const float growth = x * (1.0F + x * (0.5F + x / 6.0F));
    const float lost = growth / (1.0F + growth);
    speed->keep = 1.0F / ((1.0F + growth) * (1.0F + growth));
    speed->lost = lost;
    speed->beta = lost * lost / speed->T_s;
    speed->offset = pmsm_turn_part(params->encoder_offset_rad);
    if (params->encoder_reversed != speed->reversed) { /* the same rotation, counted the other way */
        speed->omega = -speed->omega;
        speed->lag = -speed->lag;
        speed->reversed = params->encoder_reversed;
    }
}

/* Only differences of readings enter, so no digits are lost over many turns. The step's own slope enters through the
 * predicted angle: a constant speed leaves no error. */
void pmsm_speed_update(pmsm_application *app)
{
    pmsm_speed_estimate *speed = &app->speed;
    const pmsm_sensors *sensors = &app->sensors;
    if (sensors->encoder_failed != 0u) {
        speed->follows = 0u; /* trips; the speed estimate must survive it, the rotor turns on unseen */
        return;
    }
    if (app->params->hall_commutation >= (uint32_t)PMSM_HALL_ALONE) { /* by its edges: the angle between has steps */
        const float along = pmsm_hall_speed(&app->hall) / ((float)app->params->motor_pole_pairs * speed->T_s);
        speed->omega += speed->lost * (((speed->reversed != 0u) ? -along : along) - speed->omega);
        return;
    }
    if (speed->follows == 0u || speed->unreferenced != sensors->encoder_unreferenced) { /* another zero is no motion */
        speed->follows = 1u;
        speed->unreferenced = sensors->encoder_unreferenced;
        speed->lag = 0.0F;
    } else {
        const float raw = pmsm_signed_angle(sensors->angle - speed->angle);
        const float turned = (speed->reversed != 0u) ? -raw : raw;
        const float error = (turned - speed->omega * speed->T_s) + speed->lag;
        speed->lag = speed->keep * error;
        speed->omega += speed->beta * error;
    }
    speed->angle = sensors->angle;
}

float pmsm_rotor_angle(const pmsm_application *app)
{
    const uint32_t kind = app->params->hall_commutation;
    const pmsm_hall *hall = &app->hall;
    if (kind == (uint32_t)PMSM_HALL_START && app->sensors.encoder_unreferenced != 0u) {
        return (hall->failed != 0u) ? PMSM_NAN : pmsm_signed_angle(hall->angle);
    }
    const uint32_t counted = app->params->motor_pole_pairs * app->sensors.angle;
    const uint32_t shown = (kind == (uint32_t)PMSM_HALL_STEPS) ? hall->low + hall->width / 2u : counted;
    const uint32_t along = (app->speed.reversed != 0u) ? 0u - shown : shown;
    return (app->sensors.encoder_failed != 0u) ? PMSM_NAN : pmsm_signed_angle(along - app->speed.offset);
}
