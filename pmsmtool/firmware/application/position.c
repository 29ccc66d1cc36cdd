/* SPDX-License-Identifier: MIT */
/* Position control: a proportional controller above the speed controller, once per period of that one.
 *
 *     omega_ref = K_p (theta_ref - theta) + velocity_ff * omega of the reference
 *     torque    = inertia_ff * acceleration of the reference, added to the speed controller's
 *
 * There is nothing to wind up here: the integrator is the speed controller's, which knows its limits. A reference that
 * the machine cannot follow shows as a following error.
 */
#include "application_parts.h"

#define STEP_LEAST 1e-6F     /* increments per step^2: a move ends, whatever deceleration is asked for */
#define STEP_MOST 1e9F       /* increments per step^2 */
#define ROUND_UP 0.999F      /* steps of jerk: a whole number that was rounded stays one */
#define PERIODS_MOST 1e6F    /* of an interval */

static int32_t position_of(const pmsm_sensors *sensors, const pmsm_position_request *asked)
{
    const uint64_t within = ((uint64_t)sensors->angle * asked->increments + 0x80000000u) >> 32;
    return (int32_t)((uint32_t)sensors->turns * asked->increments + (uint32_t)within + (uint32_t)asked->offset);
}

/* A position goes on where the encoder's count gets another zero, from its index. */
static void read_position(pmsm_position *p, const pmsm_sensors *sensors)
{
    const int32_t before = p->actual;
    p->actual = position_of(sensors, &p->asked);
    if (p->unreferenced != sensors->encoder_unreferenced) {
        p->asked.offset = (int32_t)((uint32_t)p->asked.offset + (uint32_t)before - (uint32_t)p->actual);
        p->actual = before;
        p->unreferenced = sensors->encoder_unreferenced;
        p->indexed = 1u;
    }
}

/* What is asked for, per step of T seconds. The acceleration asks for no more steps of jerk than there is memory. */
static pmsm_profile profile_of(const pmsm_position_request *asked, float T, float deceleration)
{
    pmsm_profile profile;
    const float jerk = asked->jerk * T * T * T;
    const float most = (jerk > 0.0F) ? jerk * (float)PMSM_JERK_STEPS : STEP_MOST;
    profile.velocity = 0.0F; /* the caller's */
    profile.acceleration = pmsm_clamp(asked->acceleration * T * T, STEP_LEAST, most);
    profile.deceleration = pmsm_clamp(deceleration * T * T, STEP_LEAST, most);
    const float larger =
        (profile.acceleration > profile.deceleration) ? profile.acceleration : profile.deceleration;
    const float steps = (jerk > 0.0F) ? larger / jerk + ROUND_UP : 1.0F;
    profile.jerk_steps = (steps < (float)PMSM_JERK_STEPS) ? (uint32_t)steps : PMSM_JERK_STEPS;
    return profile;
}

/* A new target, cut to minimum and maximum unless those are off. */
static uint32_t take_target(pmsm_position *p)
{
    const pmsm_position_request *asked = &p->asked;
    if (asked->set_point == p->seen) {
        return 0u;
    }
    p->seen = asked->set_point;
    p->target = asked->target;
    p->flags &= ~(uint32_t)PMSM_POSITION_SOFTWARE_LIMIT;
    if (asked->minimum < asked->maximum && (asked->target < asked->minimum || asked->target > asked->maximum)) {
        p->target = (asked->target < asked->minimum) ? asked->minimum : asked->maximum;
        p->flags |= (uint32_t)PMSM_POSITION_SOFTWARE_LIMIT;
    }
    return 1u;
}

void pmsm_begin_position(pmsm_position *p)
{
    p->running = 1u;
    p->reference = p->actual;
    p->reference_part = 0.0F;
    p->velocity = 0.0F;
    p->acceleration = 0.0F;
    p->target = p->actual;
    p->step = 0.0F;
    p->left = 0u;
    p->stopped = 0u;
    p->followed = 0u;
    p->outside = 0.0F;
    p->flags = 0u;
    pmsm_trajectory_rest(&p->trajectory, p->actual);
}

/* Every step of the speed controller: the profile, or the ramp down at a limit switch. */
static void step_profile(pmsm_application *app, float T)
{
    pmsm_position *p = &app->position;
    const uint32_t limits = app->sensors.limits;
    const float moving = (p->asked.halt != 0u) ? 0.0F : p->asked.velocity;
    const float velocity = (p->asked.homing.active != 0u) ? pmsm_home(app, T) : moving;
    const uint32_t barred = pmsm_is_barred(limits, pmsm_way(p->target, p->trajectory.planned)) | p->stopped;
    pmsm_profile profile =
        profile_of(&p->asked, T, (barred != 0u) ? p->asked.stop_deceleration : p->asked.deceleration);
    profile.velocity = (barred != 0u) ? 0.0F : velocity * T;
    p->flags &= ~((uint32_t)PMSM_POSITION_SWITCH | (uint32_t)PMSM_POSITION_MOVING);
    p->flags |= (barred != 0u) ? (uint32_t)PMSM_POSITION_SWITCH : 0u;
    p->velocity *= T; /* the trajectory counts in steps */
    pmsm_trajectory_step(&p->trajectory, &profile, p->target, limits, p);
    p->velocity /= T;
    p->acceleration /= T * T;
    if (p->trajectory.resting < p->trajectory.length || p->trajectory.planned != p->target) {
        p->flags |= (uint32_t)PMSM_POSITION_MOVING;
    }
}

/* The profile goes on from where the following of targets is. */
static void take_over(pmsm_position *p, float T)
{
    pmsm_trajectory_rest(&p->trajectory, p->reference);
    p->trajectory.planned_part = p->reference_part;
    p->trajectory.planned_velocity = p->velocity * T;
    p->trajectory.resting = 0u;
    p->followed = 0u;
}

/* Every PWM period: on the straight line to the target, which it reaches at the end of the interval. */
static void follow(pmsm_application *app, float T)
{
    pmsm_position *p = &app->position;
    const float T_s = app->speed.T_s;
    if (take_target(p) != 0u) {
        const float way = pmsm_way(p->target, p->reference) - p->reference_part;
        const float periods = p->asked.interval / T_s + 0.5F;
        p->left = (periods < 1.0F) ? 1u : (uint32_t)pmsm_clamp(periods, 1.0F, PERIODS_MOST);
        p->step = way / (float)p->left;
        p->acceleration = (p->step / T_s - p->velocity) / ((float)p->left * T_s);
        p->velocity = p->step / T_s;
        p->stopped = 0u;
        if (pmsm_is_barred(app->sensors.limits, way) != 0u) {
            p->step = 0.0F;
            p->left = 0u;
        }
    }
    if (p->left > 0u && pmsm_is_barred(app->sensors.limits, p->step) != 0u) {
        take_over(p, T);
        p->stopped = 1u;
        p->left = 0u;
    }
    p->flags &= ~((uint32_t)PMSM_POSITION_SWITCH | (uint32_t)PMSM_POSITION_MOVING);
    if (p->left > 0u) {
        const float part = p->reference_part + p->step;
        const int32_t whole = pmsm_nearest(part);
        p->left--;
        p->reference = (p->left > 0u) ? (int32_t)((uint32_t)p->reference + (uint32_t)whole) : p->target;
        p->reference_part = (p->left > 0u) ? part - (float)whole : 0.0F;
        p->flags |= (uint32_t)PMSM_POSITION_MOVING;
    } else if (p->stopped == 0u) { /* no new target in time */
        p->velocity = 0.0F;
        p->acceleration = 0.0F;
    } else {
        p->flags |= (uint32_t)PMSM_POSITION_SWITCH;
    }
    p->followed = 1u - p->stopped;
}

static void check_error(pmsm_position *p, float T)
{
    const float window = p->asked.window;
    p->error = pmsm_way(p->reference, p->actual) + p->reference_part;
    if (window > 0.0F && pmsm_abs(p->error) > window) {
        p->outside += T;
        p->flags |= (p->outside > p->asked.window_time) ? (uint32_t)PMSM_POSITION_ERROR : 0u;
    } else {
        p->outside = 0.0F;
    }
}

/* The cascade's outer controller, at a step of the inner one. */
static void control(pmsm_application *app)
{
    pmsm_position *p = &app->position;
    const pmsm_params *params = app->params;
    const float increment = (params->encoder_reversed != 0u) ? -pmsm_increment(app) : pmsm_increment(app);
    const float most = params->motor_n_max_rpm / PMSM_RPM;
    const float omega =
        increment * (params->position_K_p_per_s * p->error + params->position_velocity_ff * p->velocity);
    p->omega_ref = pmsm_clamp(omega, -most, most);
    p->torque = increment * params->position_inertia_ff_kgm2 * p->acceleration;
    p->flags &= ~(uint32_t)PMSM_POSITION_SATURATED;
    p->flags |= (p->omega_ref != omega) ? (uint32_t)PMSM_POSITION_SATURATED : 0u;
}

void pmsm_control_position(pmsm_application *app, pmsm_reference *reference)
{
    pmsm_position *p = &app->position;
    const float T = app->speed.T_s * (float)app->params->speed_decimation;
    if (app->sensors.encoder_failed == 0u) {
        read_position(p, &app->sensors);
    }
    p->limits = app->sensors.limits;
    if (app->enabled == 0u || app->trip != (uint32_t)PMSM_TRIP_NONE || app->quick_stop != 0u ||
        reference->mode != (uint32_t)PMSM_MODE_POSITION) {
        p->running = 0u;
        p->error = 0.0F;
        p->reference = p->actual;
        pmsm_leave_homing(p);
        return;
    }
    if (p->running == 0u) {
        pmsm_begin_position(p);
    }
    if (p->asked.homing.active != 0u) {
        p->seen = p->asked.set_point; /* no target of a homing */
    } else {
        pmsm_leave_homing(p);
    }
    const uint32_t profiled = p->asked.profile | p->asked.homing.active;
    if (profiled != 0u && p->followed != 0u) {
        take_over(p, T);
    }
    if (profiled == 0u) {
        follow(app, T);
    } else if (take_target(p) != 0u) {
        p->stopped = 0u;
    } else {
        /* the same target */
    }
    if (app->control.speed_count == 0u) { /* the speed controller steps in this period */
        if (profiled != 0u || p->stopped != 0u) {
            step_profile(app, T);
        }
        check_error(p, T);
        control(app);
    }
    reference->omega_M_ref = p->omega_ref;
    reference->tau_ref = p->torque;
}
