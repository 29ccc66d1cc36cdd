/* SPDX-License-Identifier: MIT */
/* Quick stop: the current goes to zero, and in the speed modes the shaft is braked before. */
#include "application_parts.h"

#define QUICK_STOP_RAMP_S 0.01F      /* a current or torque reference goes to zero in this time */
#define QUICK_STOP_TIMEOUT_S 0.1F    /* after the ramp: gates off, whatever the current does */
#define BRAKE_KNEE_SHARE 0.25F       /* of n_max: below it the brake torque falls with the speed */
#define BRAKE_DAMPING 6.0F           /* mechanical brake pole stays this far below the speed estimate's */
#define STANDSTILL_SHARE 0.01F       /* of n_max */

enum { QUICK_STOP_INACTIVE = 0, QUICK_STOP_STOPPING = 1, QUICK_STOP_STOPPED = 2 };

/* Torque against the rotation: rated current, near standstill a viscous brake. Its gain is the speed controller's
 * where that is tuned, else from the inertia so that its pole stays below the speed estimate's, else a share of what
 * the full speed range allows. */
static float brake_torque(const pmsm_application *app)
{
    const pmsm_params *p = app->params;
    const float rated = 1.5F * (float)p->motor_pole_pairs * p->motor_psi_f_wb * p->motor_I_nom_apk;
    const float tau = (rated < p->speed_tau_max_nm) ? rated : p->speed_tau_max_nm;
    float gain = p->speed_K_p_nms_per_rad;
    if (gain <= 0.0F && p->motor_J_kgm2 > 0.0F) {
        gain = p->motor_J_kgm2 * p->encoder_pll_bandwidth_rad_s / BRAKE_DAMPING;
    } else if (gain <= 0.0F) {
        gain = tau / (BRAKE_KNEE_SHARE * p->motor_n_max_rpm / PMSM_RPM);
    } else {
        /* the speed controller's */
    }
    return -pmsm_clamp(gain * app->speed.omega, -tau, tau);
}

static uint32_t at_standstill(const pmsm_application *app)
{
    return (pmsm_abs(app->speed.omega) * PMSM_RPM < STANDSTILL_SHARE * app->params->motor_n_max_rpm) ? 1u : 0u;
}

static void stop_reference(pmsm_application *app, pmsm_reference *reference)
{
    pmsm_quick_stop *stop = &app->stopping;
    const float share = (stop->share > 0.0F) ? stop->share : 0.0F;
    *reference = stop->start;
    reference->u_d_inject = 0.0F;
    reference->u_q_inject = 0.0F;
    reference->i_d_ref = stop->start.i_d_ref * share;
    reference->i_q_ref = stop->start.i_q_ref * share;
    reference->tau_ref = stop->start.tau_ref * share;
    stop->share -= app->speed.T_s / QUICK_STOP_RAMP_S;
    uint32_t stopped = (stop->share < -QUICK_STOP_TIMEOUT_S / QUICK_STOP_RAMP_S) ? 1u : 0u;
    if (stop->start.mode == (uint32_t)PMSM_MODE_SPEED || stop->start.mode == (uint32_t)PMSM_MODE_POSITION) {
        reference->mode = (uint32_t)PMSM_MODE_TORQUE;
        reference->tau_ref = brake_torque(app);
        stopped = at_standstill(app);
    } else if (stop->start.mode == (uint32_t)PMSM_MODE_VOLTAGE) {
        stopped = 1u; /* no current loop is known to be good: let the current decay through the diodes */
    } else {
        /* the time says it */
    }
    if (stopped != 0u) {
        stop->state = (uint32_t)QUICK_STOP_STOPPED;
    }
}

/* A quick stop lasts until it is taken back; once stopped the gates stay off. */
void pmsm_apply_quick_stop(pmsm_application *app, pmsm_reference *reference, float *angle)
{
    pmsm_quick_stop *stop = &app->stopping;
    if (app->quick_stop == 0u) {
        stop->state = (uint32_t)QUICK_STOP_INACTIVE;
        return;
    }
    if (stop->state == (uint32_t)QUICK_STOP_INACTIVE) {
        stop->state = (uint32_t)QUICK_STOP_STOPPING;
        stop->start = app->applied;
        stop->share = 1.0F;
    }
    *angle = app->applied_angle;
    if (stop->state == (uint32_t)QUICK_STOP_STOPPING) {
        stop_reference(app, reference);
    }
    if (stop->state == (uint32_t)QUICK_STOP_STOPPED) {
        reference->mode = (uint32_t)PMSM_MODE_OFF;
    }
}
