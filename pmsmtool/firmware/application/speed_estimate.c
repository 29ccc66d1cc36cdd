/* SPDX-License-Identifier: MIT */
/* Mechanical speed from the encoder's angle: critically damped, both poles at exp(-w T). */
#include "application_parts.h"

/* The encoder's zero as 2^-32 electrical turns; the parameter is at most a turn. */
static uint32_t offset_of(float offset_rad)
{
    const float turns = pmsm_abs(offset_rad) / (2.0F * PMSM_PI);
    const float part = (turns >= 1.0F) ? turns - 1.0F : turns;
    const uint32_t size = (uint32_t)(part * 4294967296.0F);
    return (offset_rad < 0.0F) ? 0u - size : size;
}

/* exp(-w T) by a series that stays positive. */
void pmsm_speed_prepare(pmsm_speed_estimate *speed, const pmsm_params *params)
{
    speed->T_s = 1e-9F * (float)params->inverter_T_s_ns;
    const float x = params->encoder_pll_bandwidth_rad_s * speed->T_s;
    const float growth = x * (1.0F + x * (0.5F + x / 6.0F));
    const float lost = growth / (1.0F + growth);
    speed->keep = 1.0F / ((1.0F + growth) * (1.0F + growth));
    speed->beta = lost * lost / speed->T_s;
    speed->offset = offset_of(params->encoder_offset_rad);
    if (params->encoder_reversed != speed->reversed) { /* the same rotation, counted the other way */
        speed->omega = -speed->omega;
        speed->lag = -speed->lag;
        speed->reversed = params->encoder_reversed;
    }
}

/* Only differences of readings enter, so no digits are lost over many turns. The step's own slope enters through the
 * predicted angle: a constant speed leaves no error. */
void pmsm_speed_update(pmsm_speed_estimate *speed, const pmsm_sensors *sensors)
{
    if (sensors->encoder_failed != 0u) {
        speed->follows = 0u; /* trips; the speed estimate must survive it, the rotor turns on unseen */
        return;
    }
    if (speed->follows == 0u) {
        speed->follows = 1u;
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
    const uint32_t counted = app->params->motor_pole_pairs * app->sensors.angle;
    const uint32_t along = (app->speed.reversed != 0u) ? 0u - counted : counted;
    return (app->sensors.encoder_failed != 0u) ? PMSM_NAN : pmsm_signed_angle(along - app->speed.offset);
}
