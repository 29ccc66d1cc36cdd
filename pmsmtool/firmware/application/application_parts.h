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

/* The whole turn of the encoder that is nearest: what is left then has a sign, and the rounding of a small number. */
static inline uint32_t pmsm_nearest_turn(const pmsm_sensors *sensors)
{
    return (uint32_t)sensors->turns + ((sensors->angle >= 0x80000000u) ? 1u : 0u);
}

/* speed_estimate.c */
void pmsm_speed_prepare(pmsm_speed_estimate *speed, const pmsm_params *params);
void pmsm_speed_update(pmsm_application *app);
/* Electrical angle of the rotor (rad, within one turn); NaN when the sensor failed. */
float pmsm_rotor_angle(const pmsm_application *app);
/* An angle of at most a turn as 2^-32 turns. */
uint32_t pmsm_turn_part(float angle_rad);

/* hall.c: the rotor by the Hall wires, before anything reads the sensors; alone they take the encoder's place there */
void pmsm_hall_prepare(pmsm_hall *hall, const pmsm_params *params);
void pmsm_hall_update(pmsm_application *app);
/* Electrical speed of the last sector, rad per period; less where the next edge is overdue, 0 after a reversal. */
float pmsm_hall_speed(const pmsm_hall *hall);

/* trajectory.c: where the reference of a move is; all quantities per step of the speed controller */
typedef struct {
    float velocity;              /* increments per step */
    float acceleration, deceleration; /* increments per step^2 */
    uint32_t jerk_steps;
} pmsm_profile;
void pmsm_trajectory_rest(pmsm_trajectory *trajectory, int32_t position);
/* One step towards the target, in no direction that the limit switches forbid. Sets the reference. */
void pmsm_trajectory_step(pmsm_trajectory *trajectory, const pmsm_profile *profile, int32_t target, uint32_t limits,
                          pmsm_position *position);
/* 1: a limit switch forbids the direction of a way */
static inline uint32_t pmsm_is_barred(uint32_t limits, float way)
{
    return (((limits & 2u) != 0u && way > 0.0F) || ((limits & 1u) != 0u && way < 0.0F)) ? 1u : 0u;
}

/* position.c: the speed controller's reference and torque of this period, from the position; before the core's step */
void pmsm_control_position(pmsm_application *app, pmsm_reference *reference);

/* Begin at rest where the shaft is. */
void pmsm_begin_position(pmsm_position *p);

/* homing.c: at a step of the speed controller, before the profile's. Returns the profile's velocity, increments/s. */
float pmsm_home(pmsm_application *app, float T);
/* Nothing homes: a search that was under way is interrupted. */
void pmsm_leave_homing(pmsm_position *p);

/* rad of an increment of the position */
static inline float pmsm_increment(const pmsm_application *app)
{
    const uint32_t increments = app->position.asked.increments;
    return (increments > 0u) ? 2.0F * PMSM_PI / (float)increments : 0.0F;
}

/* Difference of two positions, which wrap. */
static inline float pmsm_way(int32_t to, int32_t from)
{
    const uint32_t way = (uint32_t)to - (uint32_t)from;
    return (way < 0x80000000u) ? (float)way : -(float)(0u - way);
}

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
