/* SPDX-License-Identifier: MIT */
/* Homing: the position gets its zero from a limit switch, the encoder's index, a mechanical stop, or where it is. */
#include "application_parts.h"

#define FAR 0x40000000u      /* increments: way of a search, half of what a position can tell */
#define PUSHED_S 0.02F       /* a stop is one when the torque has stayed so long; an acceleration is over before */

static uint32_t by_switch(int32_t method)
{
    const uint32_t either = (method == (int32_t)PMSM_HOMING_SWITCH_NEGATIVE) ? 1u : 0u;
    return (method == (int32_t)PMSM_HOMING_SWITCH_POSITIVE) ? 1u : either;
}

static uint32_t by_index(int32_t method)
{
    const uint32_t either = (method == (int32_t)PMSM_HOMING_INDEX_NEGATIVE) ? 1u : 0u;
    return (method == (int32_t)PMSM_HOMING_INDEX_POSITIVE) ? 1u : either;
}

static uint32_t by_stop(int32_t method)
{
    const uint32_t either = (method == (int32_t)PMSM_HOMING_STOP_NEGATIVE) ? 1u : 0u;
    return (method == (int32_t)PMSM_HOMING_STOP_POSITIVE) ? 1u : either;
}

/* 1: the method moves in positive direction */
static uint32_t goes_up(int32_t method)
{
    return (method == (int32_t)PMSM_HOMING_SWITCH_POSITIVE || method == (int32_t)PMSM_HOMING_INDEX_POSITIVE ||
            method == (int32_t)PMSM_HOMING_STOP_POSITIVE)
               ? 1u
               : 0u;
}

static uint32_t is_searching(const pmsm_position *p)
{
    return (p->homing == (uint32_t)PMSM_HOMING_SEARCH || p->homing == (uint32_t)PMSM_HOMING_AWAY) ? 1u : 0u;
}

static void search(pmsm_position *p, uint32_t up)
{
    p->target = (int32_t)((up != 0u) ? (uint32_t)p->actual + FAR : (uint32_t)p->actual - FAR);
}

/* The count of the encoder that is home: what moves goes on in the new positions. */
static void found(pmsm_position *p, uint32_t count)
{
    const uint32_t offset = 0u - count - (uint32_t)p->asked.homing.home_offset;
    const uint32_t shift = offset - (uint32_t)p->asked.offset;
    p->asked.offset = (int32_t)offset;
    p->actual = (int32_t)((uint32_t)p->actual + shift);
    p->reference = (int32_t)((uint32_t)p->reference + shift);
    p->target = (int32_t)((uint32_t)p->target + shift);
    p->trajectory.planned = (int32_t)((uint32_t)p->trajectory.planned + shift);
    p->homing = (uint32_t)PMSM_HOMING_REST;
}

static void start(const pmsm_application *app, pmsm_position *p, uint32_t count)
{
    const int32_t method = p->asked.homing.method;
    p->homing_turns = app->sensors.turns;
    p->pushed = 0.0F;
    p->indexed = 0u;
    if (method == (int32_t)PMSM_HOMING_HERE) {
        found(p, count);
    } else if ((by_switch(method) | by_index(method) | by_stop(method)) != 0u) {
        p->homing = (uint32_t)PMSM_HOMING_SEARCH;
        search(p, goes_up(method));
    } else {
        p->homing = (uint32_t)PMSM_HOMING_FAILED;
    }
}

/* Whichever way the index was passed, it is where the higher of the two turns begins. The first one is where the
 * encoder's count has its zero from then on. */
static void look_for_index(const pmsm_application *app, pmsm_position *p)
{
    const uint32_t turns = (uint32_t)app->sensors.turns;
    const uint32_t before = (uint32_t)p->homing_turns;
    if (app->sensors.encoder_unreferenced != 0u) {
        p->indexed = 0u;
    } else if (p->indexed != 0u) {
        found(p, p->asked.increments * pmsm_nearest_turn(&app->sensors));
    } else if (turns != before) {
        found(p, p->asked.increments * ((turns - before < 0x80000000u) ? turns : before));
    } else {
        /* on the way */
    }
}

static void look_for_stop(const pmsm_application *app, pmsm_position *p, uint32_t count, float T)
{
    p->pushed = (pmsm_abs(app->control.live.tau) >= p->asked.homing.torque) ? p->pushed + T : 0.0F;
    if (p->pushed >= PUSHED_S) {
        found(p, count);
        pmsm_begin_position(p); /* no way on into the stop */
    }
}

static void look(const pmsm_application *app, pmsm_position *p, uint32_t count, float T)
{
    const int32_t method = p->asked.homing.method;
    const uint32_t up = goes_up(method);
    const uint32_t barred = pmsm_is_barred(app->sensors.limits, (up != 0u) ? 1.0F : -1.0F);
    if (p->homing == (uint32_t)PMSM_HOMING_AWAY) {
        if (barred == 0u) {
            found(p, count);
        }
    } else if (by_switch(method) != 0u && barred != 0u) {
        p->homing = (uint32_t)PMSM_HOMING_AWAY;
        search(p, 1u - up);
    } else if (barred != 0u) {
        p->homing = (uint32_t)PMSM_HOMING_FAILED;
    } else if (by_index(method) != 0u) {
        look_for_index(app, p);
    } else if (by_stop(method) != 0u) {
        look_for_stop(app, p, count, T);
    } else {
        /* the switch is still ahead */
    }
    if (is_searching(p) != 0u && p->trajectory.planned == p->target) {
        p->homing = (uint32_t)PMSM_HOMING_FAILED;
    }
}

float pmsm_home(pmsm_application *app, float T)
{
    pmsm_position *p = &app->position;
    const pmsm_homing_request *asked = &p->asked.homing;
    const uint32_t count = (uint32_t)p->actual - (uint32_t)p->asked.offset;
    if (asked->start != p->homing_started) {
        p->homing_started = asked->start;
        if (asked->start != 0u) {
            start(app, p, count);
        } else if (is_searching(p) != 0u) {
            p->homing = (uint32_t)PMSM_HOMING_INTERRUPTED;
        } else {
            /* it has ended */
        }
    }
    if (is_searching(p) != 0u) {
        look(app, p, count, T);
    }
    p->homing_turns = app->sensors.turns;
    if (is_searching(p) != 0u) {
        const uint32_t slow = (p->homing == (uint32_t)PMSM_HOMING_AWAY) ? 1u : by_index(asked->method);
        return (slow != 0u) ? asked->slow : p->asked.velocity;
    }
    if (p->trajectory.resting >= p->trajectory.length && p->trajectory.planned_velocity == 0.0F) {
        p->target = p->trajectory.planned;
        p->homing = (p->homing == (uint32_t)PMSM_HOMING_REST) ? (uint32_t)PMSM_HOMING_DONE : p->homing;
    }
    return 0.0F;
}

void pmsm_leave_homing(pmsm_position *p)
{
    p->homing_started = p->asked.homing.start;
    if (p->asked.homing.active == 0u) {
        p->homing = (uint32_t)PMSM_HOMING_IDLE;
    } else if (is_searching(p) != 0u || p->homing == (uint32_t)PMSM_HOMING_REST) {
        p->homing = (uint32_t)PMSM_HOMING_INTERRUPTED;
    } else {
        /* it has ended */
    }
}
