/* SPDX-License-Identifier: MIT */
/* The drive's application at PWM rate: sensors, trips, quick stop, what the control core is asked to do. */
#include "drive.h"

#include <math.h>
#include <string.h>

#include "drive_parts.h"
#include "pmsm_image.h"

#define QUICK_STOP_RAMP_S 0.01F      /* a current or torque reference goes to zero in this time */
#define QUICK_STOP_TIMEOUT_S 0.1F    /* after the ramp: gates off, whatever the current does */
#define BRAKE_KNEE_SHARE 0.25        /* of n_max: below it the brake torque falls with the speed */
#define BRAKE_DAMPING 6.0            /* mechanical brake pole stays this far below the speed estimate's */
#define STANDSTILL_SHARE 0.01        /* of n_max */
#define SAMPLE_MOST 1e7F             /* A, V: what is larger is no sample */
#define ANGLE_MOST 1e9               /* rad, mechanical: a year at 300 rpm */
#define RPM 9.54929658551372         /* rpm per rad/s */

enum { QUICK_STOP_INACTIVE = 0, QUICK_STOP_STOPPING = 1, QUICK_STOP_STOPPED = 2 };

uint32_t pmsm_drive_size(void)
{
    return (uint32_t)sizeof(pmsm_drive);
}

void pmsm_drive_init(pmsm_drive *drive)
{
    memset(drive, 0, sizeof *drive);
    pmsm_init(&drive->control);
    pmsm_drive_excitation_init(drive);
    drive->fixed_angle = (float)NAN;
    drive->applied_angle = (float)NAN;
    drive->recorder.command = PMSM_COMMAND_TAKEN;
    drive->recorder.decimation = 1u;
    drive->average.command = PMSM_COMMAND_TAKEN;
}

/* Critically damped alpha-beta estimate: both poles at exp(-w T), here by a series that stays positive. */
static void prepare_speed_estimate(pmsm_drive *drive)
{
    const double T_s = 1e-9 * (double)drive->params.inverter_T_s_ns;
    const double x = (double)drive->params.encoder_pll_bandwidth_rad_s * T_s;
    const double z = 1.0 / (1.0 + x * (1.0 + x * (0.5 + x / 6.0)));
    drive->pll_alpha = 1.0 - z * z;
    drive->pll_beta = (1.0 - z) * (1.0 - z) / T_s;
}

uint32_t pmsm_drive_load(pmsm_drive *drive, const uint8_t *image, uint32_t size)
{
    const uint32_t reversed = drive->params.encoder_reversed;
    const uint32_t status = pmsm_image_load(image, size, &drive->params, drive->lut, PMSM_LUT_WORDS);
    if (status == PMSM_IMAGE_OK) {
        pmsm_parameters_changed(&drive->control);
        if (drive->params.encoder_reversed != reversed) { /* the same rotation, counted the other way */
            drive->pll_theta = -drive->pll_theta;
            drive->pll_omega = -drive->pll_omega;
        }
        prepare_speed_estimate(drive);
    }
    return status;
}

void pmsm_drive_reset_fault(pmsm_drive *drive)
{
    drive->trip = PMSM_TRIP_NONE;
    pmsm_reset_fault(&drive->control);
}

/* Mechanical speed along the phase order. The angle is unwrapped and double, so no digits are lost over many turns;
 * the step's own slope enters through the predicted angle, a constant speed leaves no error. */
static void estimate_speed(pmsm_drive *drive)
{
    const double T_s = 1e-9 * (double)drive->params.inverter_T_s_ns;
    const double theta = (drive->params.encoder_reversed != 0u) ? -drive->sensors.theta_M : drive->sensors.theta_M;
    if (!(fabs(theta) <= ANGLE_MOST)) {
        drive->pll_follows = 0u; /* trips; the speed estimate must survive it, the rotor turns on unseen */
        return;
    }
    if (drive->pll_follows == 0u) {
        drive->pll_theta = theta - drive->pll_omega * T_s;
        drive->pll_follows = 1u;
    }
    const double predicted = drive->pll_theta + drive->pll_omega * T_s;
    const double error = theta - predicted;
    drive->pll_theta = predicted + drive->pll_alpha * error;
    drive->pll_omega += drive->pll_beta * error;
    drive->theta_M_last = drive->sensors.theta_M;
}

static uint32_t find_trip(const pmsm_drive *drive)
{
    const pmsm_sensors *s = &drive->sensors;
    const pmsm_params *p = &drive->params;
    const float limit = p->protection_i_trip_apk;
    const float T = isnan(s->T_winding) ? 0.0F : s->T_winding; /* no sensor */
    const float sum = fabsf(s->i_a) + fabsf(s->i_b) + fabsf(s->i_c) + fabsf(s->U_dc) + fabsf(T);
    if (!(sum <= SAMPLE_MOST)) {
        return PMSM_TRIP_NONE; /* no sample to judge: the core holds its voltage, and trips at the second */
    }
    if (fabsf(s->i_a) > limit || fabsf(s->i_b) > limit || fabsf(s->i_c) > limit) {
        return PMSM_TRIP_OVERCURRENT;
    }
    if (s->U_dc > p->protection_U_dc_max_v) {
        return PMSM_TRIP_OVERVOLTAGE;
    }
    if (drive->enabled != 0u && s->U_dc < p->protection_U_dc_min_v) {
        return PMSM_TRIP_UNDERVOLTAGE;
    }
    if (fabs(drive->pll_omega) * RPM > (double)p->protection_n_trip_rpm) {
        return PMSM_TRIP_OVERSPEED;
    }
    return (s->T_winding > p->protection_T_winding_max_c) ? PMSM_TRIP_OVERTEMPERATURE : PMSM_TRIP_NONE;
}

/* Torque against the rotation: rated current, near standstill a viscous brake. Its gain is the speed controller's
 * where that is tuned, else from the inertia so that its pole stays below the speed estimate's, else a share of what
 * the full speed range allows. */
static float brake_torque(const pmsm_drive *drive)
{
    const pmsm_params *p = &drive->params;
    const double rated =
        1.5 * (double)p->motor_pole_pairs * (double)p->motor_psi_f_wb * (double)p->motor_I_nom_apk;
    const double tau = fmin(rated, (double)p->speed_tau_max_nm);
    double gain = (double)p->speed_K_p_nms_per_rad;
    if (gain <= 0.0 && p->motor_J_kgm2 > 0.0F) {
        gain = (double)p->motor_J_kgm2 * (double)p->encoder_pll_bandwidth_rad_s / BRAKE_DAMPING;
    } else if (gain <= 0.0) {
        gain = tau / (BRAKE_KNEE_SHARE * (double)p->motor_n_max_rpm / RPM);
    }
    return (float)(-fmax(-tau, fmin(tau, gain * drive->pll_omega)));
}

static uint32_t at_standstill(const pmsm_drive *drive)
{
    return (fabs(drive->pll_omega) * RPM < STANDSTILL_SHARE * (double)drive->params.motor_n_max_rpm) ? 1u : 0u;
}

static void quick_stop_reference(pmsm_drive *drive, pmsm_reference *reference)
{
    const float T_s = 1e-9F * (float)drive->params.inverter_T_s_ns;
    const pmsm_reference *start = &drive->quick_stop_start;
    const float share = (drive->quick_stop_share > 0.0F) ? drive->quick_stop_share : 0.0F;
    *reference = *start;
    reference->u_d_inject = 0;
    reference->u_q_inject = 0;
    reference->i_d_ref = start->i_d_ref * (pmsm_real)share;
    reference->i_q_ref = start->i_q_ref * (pmsm_real)share;
    reference->tau_ref = start->tau_ref * (pmsm_real)share;
    drive->quick_stop_share -= T_s / QUICK_STOP_RAMP_S;
    uint32_t stopped = (drive->quick_stop_share < -QUICK_STOP_TIMEOUT_S / QUICK_STOP_RAMP_S) ? 1u : 0u;
    if (start->mode == PMSM_MODE_SPEED) {
        reference->mode = PMSM_MODE_TORQUE;
        reference->tau_ref = (pmsm_real)brake_torque(drive);
        stopped = at_standstill(drive);
    } else if (start->mode == PMSM_MODE_VOLTAGE) {
        stopped = 1u; /* no current loop is known to be good: let the current decay through the diodes */
    }
    if (stopped != 0u) {
        drive->quick_stop_state = QUICK_STOP_STOPPED;
    }
}

/* A quick stop lasts until the node takes it back; once stopped the gates stay off. */
static void apply_quick_stop(pmsm_drive *drive, pmsm_reference *reference, float *angle)
{
    if (drive->quick_stop == 0u) {
        drive->quick_stop_state = QUICK_STOP_INACTIVE;
        return;
    }
    if (drive->quick_stop_state == QUICK_STOP_INACTIVE) {
        drive->quick_stop_state = QUICK_STOP_STOPPING;
        drive->quick_stop_start = drive->applied;
        drive->quick_stop_share = 1.0F;
    }
    *angle = drive->applied_angle;
    if (drive->quick_stop_state == QUICK_STOP_STOPPING) {
        quick_stop_reference(drive, reference);
    }
    if (drive->quick_stop_state == QUICK_STOP_STOPPED) {
        reference->mode = PMSM_MODE_OFF;
    }
}

static void measure(const pmsm_drive *drive, float angle, pmsm_measurement *m)
{
    const pmsm_sensors *s = &drive->sensors;
    m->i_a = (pmsm_real)s->i_a;
    m->i_b = (pmsm_real)s->i_b;
    m->i_c = (pmsm_real)s->i_c;
    m->U_dc = (pmsm_real)s->U_dc;
    m->T_winding = (pmsm_real)s->T_winding;
    if (isnan(angle)) {
        m->theta_e = (pmsm_real)pmsm_drive_rotor_angle(drive);
        m->omega_e = (pmsm_real)((double)drive->params.motor_pole_pairs * drive->pll_omega);
    } else {
        m->theta_e = (pmsm_real)angle;
        m->omega_e = 0;
    }
}

void pmsm_drive_period(pmsm_drive *drive, const pmsm_sensors *sensors, pmsm_output *output)
{
    pmsm_measurement measurement;
    pmsm_reference reference = drive->reference;
    float angle = drive->fixed_angle;
    drive->sensors = *sensors;
    estimate_speed(drive);
    drive->trip_last = drive->trip;
    if (drive->trip == PMSM_TRIP_NONE) {
        drive->trip = find_trip(drive);
    }
    pmsm_drive_excite(drive, &reference, &angle);
    apply_quick_stop(drive, &reference, &angle);
    if (drive->trip != PMSM_TRIP_NONE) {
        reference.mode = PMSM_MODE_FAULT;
    } else if (drive->enabled == 0u) {
        reference.mode = PMSM_MODE_OFF;
    }
    drive->applied = reference;
    drive->applied_angle = angle;
    measure(drive, angle, &measurement);
    pmsm_step(&drive->control, &drive->params, drive->lut, &measurement, &reference, output);
    if (drive->trip == PMSM_TRIP_NONE && drive->control.fault != (uint32_t)PMSM_FAULT_NONE) {
        drive->trip = PMSM_TRIP_INTERNAL;
    }
    drive->control.live.flags |= (sensors->adc_clipped != 0u) ? (uint32_t)PMSM_FLAG_ADC_CLIPPED : 0u;
    drive->control.live.flags |= (drive->excitation_active != 0u) ? (uint32_t)PMSM_FLAG_EXCITATION : 0u;
    pmsm_drive_record(drive);
    pmsm_drive_average(drive);
    drive->period_count++;
}

float pmsm_drive_signal(const pmsm_drive *drive, uint32_t signal)
{
    const pmsm_live *live = &drive->control.live;
    const pmsm_sensors *s = &drive->sensors;
    switch (signal) {
    case PMSM_SIGNAL_I_D: return (float)live->i_d;
    case PMSM_SIGNAL_I_Q: return (float)live->i_q;
    case PMSM_SIGNAL_I_D_REQ: return (float)live->i_d_req;
    case PMSM_SIGNAL_I_Q_REQ: return (float)live->i_q_req;
    case PMSM_SIGNAL_I_D_REF: return (float)live->i_d_ref;
    case PMSM_SIGNAL_I_Q_REF: return (float)live->i_q_ref;
    case PMSM_SIGNAL_U_D: return (float)live->u_d;
    case PMSM_SIGNAL_U_Q: return (float)live->u_q;
    case PMSM_SIGNAL_U_D_LIM: return (float)live->u_d_lim;
    case PMSM_SIGNAL_U_Q_LIM: return (float)live->u_q_lim;
    case PMSM_SIGNAL_THETA_E: return (float)live->theta_e;
    case PMSM_SIGNAL_OMEGA_E: return (float)live->omega_e;
    case PMSM_SIGNAL_TAU: return (float)live->tau;
    case PMSM_SIGNAL_KAPPA: return (float)live->kappa;
    case PMSM_SIGNAL_BINDING: return (float)live->binding;
    case PMSM_SIGNAL_ITERATIONS: return (float)live->iterations;
    case PMSM_SIGNAL_FLAGS: return (float)live->flags;
    case PMSM_SIGNAL_I_A: return s->i_a;
    case PMSM_SIGNAL_I_B: return s->i_b;
    case PMSM_SIGNAL_I_C: return s->i_c;
    case PMSM_SIGNAL_U_DC: return s->U_dc;
    case PMSM_SIGNAL_T_WINDING: return s->T_winding;
    case PMSM_SIGNAL_T_MAGNET: return s->T_magnet;
    case PMSM_SIGNAL_THETA_M: return (float)(s->theta_M - drive->theta_M_base);
    default: return 0.0F;
    }
}
