/* SPDX-License-Identifier: MIT */
/* The parts of the application, one file each. Internal. */
#ifndef PMSM_APPLICATION_PARTS_H
#define PMSM_APPLICATION_PARTS_H

#include "pmsm_application.h"
#include "pmsm_math.h"

#define PMSM_NAN __builtin_nanf("")
#define PMSM_TURN_PART (6.28318530717958647692F / 4294967296.0F) /* rad of 2^-32 turns */

static inline uint32_t pmsm_is_nan(float x)
{
    return (x == x) ? 0u : 1u;
}

/* An angle of 2^-32 turns as radians in [-pi, pi). */
static inline float pmsm_signed_angle(uint32_t angle)
{
    return PMSM_TURN_PART * ((angle < 0x80000000u) ? (float)angle : -(float)(0u - angle));
}

/* speed_estimate.c */
void pmsm_speed_prepare(pmsm_speed_estimate *speed, const pmsm_params *params);
void pmsm_speed_update(pmsm_speed_estimate *speed, const pmsm_sensors *sensors);
/* Electrical angle of the rotor by the encoder (rad, within one turn); NaN when it failed. */
float pmsm_rotor_angle(const pmsm_application *app);

/* protection.c: the trip that the sensors of this period demand, enum pmsm_trip */
uint32_t pmsm_find_trip(const pmsm_application *app);

/* quick_stop.c: what is left of the reference while a quick stop lasts */
void pmsm_apply_quick_stop(pmsm_application *app, pmsm_reference *reference, float *angle);

/* excitation.c: obey the command, and put the excitation's share into reference and frame angle */
void pmsm_excitation_init(pmsm_excitation *excitation);
void pmsm_excite(pmsm_application *app, pmsm_reference *reference, float *angle);

/* recorder.c: trace and window averages, after the control step of the period */
void pmsm_record(pmsm_application *app);
void pmsm_take_average(pmsm_application *app);

#endif
