/* SPDX-License-Identifier: MIT */
/* One period of the application: what the control core is asked to do, and what is told of it. */
#include "application_parts.h"

void pmsm_application_init(pmsm_application *app, const pmsm_params *params, const uint32_t *lut)
{
    const pmsm_application zero = {0};
    *app = zero;
    app->params = params;
    app->lut = lut;
    pmsm_init(&app->control);
    pmsm_excitation_init(&app->excitation);
    app->fixed_angle = PMSM_NAN;
    app->applied_angle = PMSM_NAN;
    app->recorder.command = PMSM_COMMAND_TAKEN;
    app->recorder.decimation = 1u;
    app->average.command = PMSM_COMMAND_TAKEN;
    pmsm_speed_prepare(&app->speed, params);
    pmsm_hall_prepare(&app->hall, params);
}

void pmsm_application_parameters_changed(pmsm_application *app)
{
    pmsm_parameters_changed(&app->control);
    pmsm_speed_prepare(&app->speed, app->params);
    pmsm_hall_prepare(&app->hall, app->params);
}

void pmsm_application_reset_fault(pmsm_application *app)
{
    app->trip = (uint32_t)PMSM_TRIP_NONE;
    pmsm_reset_fault(&app->control);
}

static void measure(const pmsm_application *app, float angle, pmsm_measurement *m)
{
    const pmsm_sensors *s = &app->sensors;
    m->i_a = s->i_a;
    m->i_b = s->i_b;
    m->i_c = s->i_c;
    m->U_dc = s->U_dc;
    m->T_winding = s->T_winding;
    if (pmsm_is_nan(angle) != 0u) {
        m->theta_e = pmsm_rotor_angle(app);
        m->omega_e = (float)app->params->motor_pole_pairs * app->speed.omega;
    } else {
        m->theta_e = angle;
        m->omega_e = 0.0F;
    }
}

void pmsm_application_period(pmsm_application *app, const pmsm_sensors *sensors, pmsm_output *output)
{
    pmsm_measurement measurement;
    pmsm_reference reference = app->reference;
    float angle = app->fixed_angle;
    app->sensors = *sensors;
    pmsm_hall_update(app);
    pmsm_speed_update(app);
    app->recording.trip_last = app->trip;
    if (app->trip == (uint32_t)PMSM_TRIP_NONE) {
        app->trip = pmsm_find_trip(app);
    }
    pmsm_excite(app, &reference, &angle);
    pmsm_control_position(app, &reference);
    pmsm_apply_quick_stop(app, &reference, &angle);
    if (app->trip != (uint32_t)PMSM_TRIP_NONE) {
        reference.mode = (uint32_t)PMSM_MODE_FAULT;
    } else if (app->enabled == 0u) {
        reference.mode = (uint32_t)PMSM_MODE_OFF;
    } else {
        /* as asked for */
    }
    app->applied = reference;
    app->applied_angle = angle;
    measure(app, angle, &measurement);
    pmsm_step(&app->control, app->params, app->lut, &measurement, &reference, output);
    if (app->trip == (uint32_t)PMSM_TRIP_NONE && app->control.fault != (uint32_t)PMSM_FAULT_NONE) {
        const uint32_t seen = (pmsm_is_nan(measurement.theta_e) != 0u) ? 0u : 1u;
        app->trip = (seen != 0u) ? (uint32_t)PMSM_TRIP_INTERNAL : (uint32_t)PMSM_TRIP_ENCODER;
    }
    app->control.live.flags |= (sensors->adc_clipped != 0u) ? (uint32_t)PMSM_FLAG_ADC_CLIPPED : 0u;
    app->control.live.flags |= (app->wave.active != 0u) ? (uint32_t)PMSM_FLAG_EXCITATION : 0u;
    pmsm_record(app);
    pmsm_take_average(app);
}

/* Unwrapped angle since the turn that was taken off; the turns' large part is exact (Cody-Waite). */
static float mechanical_angle(const pmsm_application *app)
{
    const uint32_t turns = pmsm_nearest_turn(&app->sensors) - app->recording.turns;
    const float n = (turns < 0x80000000u) ? (float)turns : -(float)(0u - turns);
    const float part = pmsm_signed_angle(app->sensors.angle);
    return 4.0F * n * PMSM_PIO2_A + (4.0F * n * PMSM_PIO2_B + (4.0F * n * PMSM_PIO2_C + part));
}

float pmsm_application_signal(const pmsm_application *app, uint32_t signal)
{
    const pmsm_live *live = &app->control.live;
    const pmsm_sensors *s = &app->sensors;
    switch (signal) {
    case PMSM_SIGNAL_I_D: return live->i_d;
    case PMSM_SIGNAL_I_Q: return live->i_q;
    case PMSM_SIGNAL_I_D_REQ: return live->i_d_req;
    case PMSM_SIGNAL_I_Q_REQ: return live->i_q_req;
    case PMSM_SIGNAL_I_D_REF: return live->i_d_ref;
    case PMSM_SIGNAL_I_Q_REF: return live->i_q_ref;
    case PMSM_SIGNAL_U_D: return live->u_d;
    case PMSM_SIGNAL_U_Q: return live->u_q;
    case PMSM_SIGNAL_U_D_LIM: return live->u_d_lim;
    case PMSM_SIGNAL_U_Q_LIM: return live->u_q_lim;
    case PMSM_SIGNAL_THETA_E: return live->theta_e;
    case PMSM_SIGNAL_OMEGA_E: return live->omega_e;
    case PMSM_SIGNAL_TAU: return live->tau;
    case PMSM_SIGNAL_KAPPA: return live->kappa;
    case PMSM_SIGNAL_BINDING: return (float)live->binding;
    case PMSM_SIGNAL_ITERATIONS: return (float)live->iterations;
    case PMSM_SIGNAL_FLAGS: return (float)live->flags;
    case PMSM_SIGNAL_I_A: return s->i_a;
    case PMSM_SIGNAL_I_B: return s->i_b;
    case PMSM_SIGNAL_I_C: return s->i_c;
    case PMSM_SIGNAL_U_DC: return s->U_dc;
    case PMSM_SIGNAL_T_WINDING: return s->T_winding;
    case PMSM_SIGNAL_T_MAGNET: return s->T_magnet;
    case PMSM_SIGNAL_THETA_M: return mechanical_angle(app);
    case PMSM_SIGNAL_FOLLOWING_ERROR: return app->position.error * pmsm_increment(app);
    case PMSM_SIGNAL_HALL: return (float)s->hall;
    default: return 0.0F;
    }
}
