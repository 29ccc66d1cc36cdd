/* SPDX-License-Identifier: MIT */
/* Reference of a move. The speed is a trapezoid (or triangle) that can change its target at any time; its average over
 * the last steps is a second integration with an end: the acceleration changes by a ramp instead of a step, and the
 * reference comes to rest exactly where the trapezoid does. */
#include "application_parts.h"

void pmsm_trajectory_rest(pmsm_trajectory *trajectory, int32_t position)
{
    const pmsm_trajectory rest = {0};
    *trajectory = rest;
    trajectory->planned = position;
    trajectory->length = 1u;
    trajectory->resting = 1u;
}

/* Largest speed (per step) from which whole steps of the deceleration still end within a distance. */
static float stoppable(float distance, float deceleration)
{
    return deceleration * (PMSM_SQRT(0.25F + 2.0F * distance / deceleration) - 0.5F);
}

/* Speed of the trapezoid in this step: towards the target as far as it can still stop there. */
static float next_velocity(const pmsm_trajectory *t, const pmsm_profile *profile, float left, uint32_t limits)
{
    float wanted = stoppable(pmsm_abs(left), profile->deceleration);
    wanted = (wanted < profile->velocity) ? wanted : profile->velocity;
    wanted = (left < 0.0F) ? -wanted : wanted;
    wanted = (pmsm_is_barred(limits, wanted) != 0u) ? 0.0F : wanted;
    const float v = t->planned_velocity;
    const float up = (v < 0.0F) ? profile->deceleration : profile->acceleration;
    const float down = (v > 0.0F) ? profile->deceleration : profile->acceleration;
    return pmsm_clamp(wanted, v - down, v + up);
}

/* The trapezoid moves; its position keeps whole increments and a part, so that it loses nothing far from zero. */
static float move(pmsm_trajectory *t, const pmsm_profile *profile, int32_t target, uint32_t limits)
{
    const float left = pmsm_way(target, t->planned) - t->planned_part;
    const float v = next_velocity(t, profile, left, limits);
    const float bounded = profile->deceleration * 1.0001F; /* rounding must not cost a last step */
    if (pmsm_abs(left) <= pmsm_abs(v) && pmsm_abs(v) <= bounded && left * v >= 0.0F) {
        t->planned = target;
        t->planned_part = 0.0F;
        t->planned_velocity = 0.0F;
        return left;
    }
    const float part = t->planned_part + v;
    const int32_t whole = pmsm_nearest(part);
    t->planned = (int32_t)((uint32_t)t->planned + (uint32_t)whole);
    t->planned_part = part - (float)whole;
    t->planned_velocity = v;
    return v;
}

void pmsm_trajectory_step(pmsm_trajectory *trajectory, const pmsm_profile *profile, int32_t target, uint32_t limits,
                          pmsm_position *position)
{
    pmsm_trajectory *t = trajectory;
    if (t->resting >= t->length && t->length != profile->jerk_steps) { /* at rest alone: nothing to average */
        t->length = profile->jerk_steps;
        t->resting = t->length;
        t->next = 0u;
        for (uint32_t k = 0u; k < PMSM_JERK_STEPS; k++) {
            t->moved[k] = 0.0F;
        }
    }
    const float moved = move(t, profile, target, limits);
    if (moved == 0.0F) {
        t->resting += (t->resting < t->length) ? 1u : 0u;
    } else {
        t->resting = 0u;
    }
    t->moved[t->next] = moved;
    t->next = (t->next + 1u < t->length) ? t->next + 1u : 0u;
    float sum = 0.0F;
    float behind = 0.0F; /* what the average has not done yet: of the oldest step nothing is left */
    for (uint32_t k = 0u; k < t->length; k++) {
        const uint32_t at = (t->next + k < t->length) ? t->next + k : t->next + k - t->length;
        sum += t->moved[at];
        behind += t->moved[at] * (float)k;
    }
    const float share = 1.0F / (float)t->length;
    const float velocity = sum * share;
    const float part = t->planned_part - behind * share;
    const int32_t whole = pmsm_nearest(part);
    position->reference = (int32_t)((uint32_t)t->planned + (uint32_t)whole);
    position->reference_part = part - (float)whole;
    position->acceleration = velocity - position->velocity;
    position->velocity = velocity;
}
