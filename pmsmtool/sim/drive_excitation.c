/* SPDX-License-Identifier: MIT */
/* Excitation: the signals an identification experiment asks the drive to generate (object 0x2050).
 *
 * Armed, the bias is held and the wave is off; running, the wave is on; aborted, the gates stay off until the next
 * command. Voltage points: bias_bandwidth > 0 holds the bias by the slow loop; 0 without a bias is pure voltage;
 * otherwise the normal current gains act. Current points set the reference to bias plus wave, the speed point adds the
 * wave to the speed reference.
 */
#include <math.h>
#include <stddef.h>

#include "drive_parts.h"

enum { STATE_IDLE = 0, STATE_ARMED = 1, STATE_RUNNING = 2, STATE_DONE = 3, STATE_ABORTED = 4 };
enum { COMMAND_STOP = 0, COMMAND_ARM = 1, COMMAND_START = 2 };

#define PRBS_SEED 0x7FFFu
#define TURN 6.28318530717958647692

void pmsm_drive_excitation_init(pmsm_drive *drive)
{
    pmsm_excitation *excitation = &drive->excitation;
    excitation->fixed_angle = (float)NAN;
    excitation->hold_periods = 1u;
    excitation->command = PMSM_COMMAND_TAKEN;
    excitation->state = STATE_IDLE;
}

static double period_s(const pmsm_drive *drive)
{
    return 1e-9 * (double)drive->params.inverter_T_s_ns;
}

static void start_wave(pmsm_drive *drive)
{
    drive->excitation_time = 0.0;
    drive->excitation_phase = 0.0;
    drive->excitation_sample = 0u;
    drive->prbs = PRBS_SEED;
    drive->hysteresis_sign_d = 1u;
    drive->hysteresis_sign_q = 1u;
    drive->excitation_started = 1u;
}

static void obey(pmsm_drive *drive)
{
    pmsm_excitation *excitation = &drive->excitation;
    const uint32_t command = excitation->command;
    drive->excitation_started = 0u;
    if (command > COMMAND_START) {
        return;
    }
    excitation->command = PMSM_COMMAND_TAKEN;
    if (command == COMMAND_STOP || excitation->shape == PMSM_SHAPE_NONE) {
        excitation->state = STATE_IDLE;
    } else if (command == COMMAND_ARM) {
        excitation->state = STATE_ARMED;
    } else {
        excitation->state = STATE_RUNNING;
        start_wave(drive);
    }
}

static uint32_t hold(const pmsm_excitation *excitation)
{
    return (excitation->hold_periods > 0u) ? excitation->hold_periods : 1u;
}

/* Maximal-length register of 15 bits, x^15 + x^14 + 1: period 32767 bits. */
static float prbs_value(pmsm_drive *drive)
{
    if (drive->excitation_sample > 0u && drive->excitation_sample % hold(&drive->excitation) == 0u) {
        const uint32_t bit = ((drive->prbs >> 14) ^ (drive->prbs >> 13)) & 1u;
        drive->prbs = ((drive->prbs << 1) | bit) & 0x7FFFu;
    }
    return ((drive->prbs & 1u) != 0u) ? drive->excitation.amplitude : -drive->excitation.amplitude;
}

static float sine_of_turns(double turns)
{
    const double rest = turns - floor(turns + 0.5);
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos((pmsm_real)(TURN * rest), &sine, &cosine);
    return (float)sine;
}

static float buffer_value(const pmsm_drive *drive)
{
    const uint32_t count = drive->excitation.buffer_samples;
    return (count > 0u) ? drive->buffer[(drive->excitation_sample / hold(&drive->excitation)) % count] : 0.0F;
}

/* Value of the wave in this period. */
static float wave(pmsm_drive *drive)
{
    const pmsm_excitation *excitation = &drive->excitation;
    const double t = drive->excitation_time;
    const uint32_t level = drive->excitation_sample / hold(excitation);
    switch (excitation->shape) {
    case PMSM_SHAPE_STEP:
        return excitation->amplitude;
    case PMSM_SHAPE_DC: /* rises over hold_periods */
        return (level > 0u) ? excitation->amplitude
                            : excitation->amplitude * (float)(drive->excitation_sample + 1u) / (float)hold(excitation);
    case PMSM_SHAPE_SINE:
        return excitation->amplitude * sine_of_turns((double)excitation->f0 * t);
    case PMSM_SHAPE_CHIRP: {
        const double slope = (excitation->duration > 0.0F)
                                 ? ((double)excitation->f1 - (double)excitation->f0) / (double)excitation->duration
                                 : 0.0;
        return excitation->amplitude * sine_of_turns(((double)excitation->f0 + 0.5 * slope * t) * t);
    }
    case PMSM_SHAPE_PRBS:
        return prbs_value(drive);
    case PMSM_SHAPE_SQUARE:
        return ((level & 1u) == 0u) ? excitation->amplitude : -excitation->amplitude;
    case PMSM_SHAPE_BUFFER:
        return buffer_value(drive);
    default:
        return 0.0F;
    }
}

static uint32_t finished(const pmsm_drive *drive)
{
    const pmsm_excitation *excitation = &drive->excitation;
    if (excitation->duration > 0.0F) {
        return (drive->excitation_time >= (double)excitation->duration - 0.5 * period_s(drive)) ? 1u : 0u;
    }
    return (excitation->shape == PMSM_SHAPE_BUFFER &&
            drive->excitation_sample >= excitation->buffer_samples * hold(excitation)) ? 1u : 0u;
}

static void advance(pmsm_drive *drive)
{
    drive->excitation_sample++;
    drive->excitation_time = (double)drive->excitation_sample * period_s(drive);
    if (finished(drive) != 0u) {
        drive->excitation.state = STATE_DONE;
    }
}

float pmsm_drive_rotor_angle(const pmsm_drive *drive)
{
    const double direction = (drive->params.encoder_reversed != 0u) ? -1.0 : 1.0;
    const double angle = direction * (double)drive->params.motor_pole_pairs * drive->sensors.theta_M -
                         (double)drive->params.encoder_offset_rad;
    return (float)(angle - TURN * floor(angle / TURN + 0.5));
}

static pmsm_ab stator_current(const pmsm_drive *drive)
{
    const pmsm_abc i = {(pmsm_real)drive->sensors.i_a, (pmsm_real)drive->sensors.i_b, (pmsm_real)drive->sensors.i_c};
    return pmsm_clarke(i);
}

static void abort_outside_limits(pmsm_drive *drive)
{
    pmsm_excitation *excitation = &drive->excitation;
    const pmsm_ab i = stator_current(drive);
    const double square = (double)i.alpha * (double)i.alpha + (double)i.beta * (double)i.beta;
    const double limit = (double)excitation->abort_current;
    const double speed = fabs((double)drive->params.motor_pole_pairs * drive->pll_omega); /* electrical, as the limit */
    if ((limit > 0.0 && square > limit * limit) ||
        (excitation->abort_speed > 0.0F && speed > (double)excitation->abort_speed)) {
        excitation->state = STATE_ABORTED;
    }
}

/* +-V pulses that turn when the current has left its band (Hinkkanen et al. 2017, DOI 10.1109/TIA.2016.2644624). */
static void hysteresis(pmsm_drive *drive, pmsm_reference *reference, float angle)
{
    const pmsm_excitation *excitation = &drive->excitation;
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos((pmsm_real)(isnan(angle) ? pmsm_drive_rotor_angle(drive) : angle), &sine, &cosine);
    const pmsm_dq i = pmsm_park(stator_current(drive), sine, cosine);
    const pmsm_real i_d = i.d - (pmsm_real)excitation->i_centre_d;
    if (i_d > (pmsm_real)excitation->i_limit_d) {
        drive->hysteresis_sign_d = 0u;
    } else if (i_d < -(pmsm_real)excitation->i_limit_d) {
        drive->hysteresis_sign_d = 1u;
    }
    if (i.q > (pmsm_real)excitation->i_limit_q) {
        drive->hysteresis_sign_q = 0u;
    } else if (i.q < -(pmsm_real)excitation->i_limit_q) {
        drive->hysteresis_sign_q = 1u;
    }
    const pmsm_real V_d = (pmsm_real)excitation->amplitude;
    const pmsm_real V_q = (pmsm_real)excitation->amplitude_q;
    reference->mode = PMSM_MODE_VOLTAGE;
    reference->u_d_inject = (drive->hysteresis_sign_d != 0u) ? V_d : -V_d;
    reference->u_q_inject = (drive->hysteresis_sign_q != 0u) ? V_q : -V_q;
}

static void inject(pmsm_drive *drive, pmsm_reference *reference, float value)
{
    const pmsm_excitation *excitation = &drive->excitation;
    const pmsm_real x = (pmsm_real)value;
    if (excitation->point == PMSM_INJECT_SPEED) {
        reference->mode = PMSM_MODE_SPEED;
        reference->omega_M_ref += x;
        return;
    }
    const uint32_t voltage = (excitation->point <= PMSM_INJECT_U_Q) ? 1u : 0u;
    const uint32_t open_loop = (voltage != 0u && excitation->bias_bandwidth == 0.0F &&
                                excitation->bias_d == 0.0F && excitation->bias_q == 0.0F) ? 1u : 0u;
    reference->mode = (open_loop != 0u) ? PMSM_MODE_VOLTAGE : PMSM_MODE_CURRENT;
    reference->bias_bandwidth = (pmsm_real)excitation->bias_bandwidth;
    reference->i_d_ref = (pmsm_real)excitation->bias_d + ((excitation->point == PMSM_INJECT_I_D) ? x : 0);
    reference->i_q_ref = (pmsm_real)excitation->bias_q + ((excitation->point == PMSM_INJECT_I_Q) ? x : 0);
    reference->u_d_inject = (excitation->point == PMSM_INJECT_U_D) ? x : 0;
    reference->u_q_inject = (excitation->point == PMSM_INJECT_U_Q) ? x : 0;
}

void pmsm_drive_excite(pmsm_drive *drive, pmsm_reference *reference, float *angle)
{
    pmsm_excitation *excitation = &drive->excitation;
    obey(drive);
    drive->excitation_active = 0u;
    if (drive->enabled == 0u || drive->trip != PMSM_TRIP_NONE || drive->quick_stop != 0u) {
        if (excitation->state == STATE_ARMED || excitation->state == STATE_RUNNING) {
            excitation->state = STATE_ABORTED;
        }
    }
    if (excitation->state == STATE_ARMED || excitation->state == STATE_RUNNING) {
        abort_outside_limits(drive);
    }
    if (excitation->state == STATE_ABORTED) {
        reference->mode = PMSM_MODE_OFF;
        return;
    }
    if (excitation->state != STATE_ARMED && excitation->state != STATE_RUNNING) {
        return;
    }
    if (!isnan(excitation->fixed_angle)) {
        *angle = excitation->fixed_angle;
    }
    const uint32_t running = (excitation->state == STATE_RUNNING) ? 1u : 0u;
    if (excitation->shape != PMSM_SHAPE_HYSTERESIS) {
        inject(drive, reference, (running != 0u) ? wave(drive) : 0.0F);
    } else if (running != 0u) {
        hysteresis(drive, reference, *angle);
    }
    drive->excitation_active = running;
    if (running != 0u) {
        advance(drive);
    }
}
