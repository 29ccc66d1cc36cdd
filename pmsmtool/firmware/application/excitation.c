/* SPDX-License-Identifier: MIT */
/* Excitation: the signals an identification experiment asks the drive to generate (object 0x2050).
 *
 * Armed, the bias is held and the wave is off; running, the wave is on; aborted, the gates stay off until the next
 * command. Voltage points: bias_bandwidth > 0 holds the bias by the slow loop; 0 without a bias is pure voltage;
 * otherwise the normal current gains act. Current points set the reference to bias plus wave, the speed point adds the
 * wave to the speed reference.
 */
#include "application_parts.h"

enum { STATE_IDLE = 0, STATE_ARMED = 1, STATE_RUNNING = 2, STATE_DONE = 3, STATE_ABORTED = 4 };
enum { COMMAND_STOP = 0, COMMAND_ARM = 1, COMMAND_START = 2 };

#define PRBS_SEED 0x7FFFu
#define NS_PER_S 1000000000u
#define SECONDS_MOST 1e6F /* a longer excitation ends here */
#define PARTS 4294967296.0F /* 2^32: what as_parts() counts in */

void pmsm_excitation_init(pmsm_excitation *excitation)
{
    excitation->fixed_angle = PMSM_NAN;
    excitation->hold_periods = 1u;
    excitation->command = PMSM_COMMAND_TAKEN;
    excitation->state = (uint32_t)STATE_IDLE;
}

/* ---- frequency and time as integers: a sine of some minutes keeps its phase, and no 64-bit division is needed ---*/

/* A number that is not negative and below 2^32, in 2^-32. */
static uint64_t as_parts(float x)
{
    const uint32_t whole = (uint32_t)x;
    return ((uint64_t)whole << 32) + (uint64_t)(uint32_t)((x - (float)whole) * PARTS);
}

/* a/b in 2^-64, rounded down; a < b < 2^63, else 0 */
static uint64_t fraction_of(uint64_t a, uint64_t b)
{
    uint64_t rest = (a < b) ? a : 0u;
    uint64_t quotient = 0u;
    for (uint32_t k = 0u; k < 64u; k++) {
        rest <<= 1;
        quotient <<= 1;
        if (rest >= b) {
            rest -= b;
            quotient |= 1u;
        }
    }
    return quotient;
}

/* Upper 64 bits of a product. */
static uint64_t high_product(uint64_t a, uint64_t b)
{
    const uint64_t a_0 = a & 0xFFFFFFFFu;
    const uint64_t b_0 = b & 0xFFFFFFFFu;
    const uint64_t middle = (a >> 32) * b_0 + ((a_0 * b_0) >> 32);
    const uint64_t other = a_0 * (b >> 32) + (middle & 0xFFFFFFFFu);
    return (a >> 32) * (b >> 32) + (middle >> 32) + (other >> 32);
}

/* Turns in one period, 2^-64; two's complement for a negative frequency. None from a turn in a period on. */
static uint64_t turns_per_period(float hz, uint32_t T_s_ns)
{
    const float most = 1e9F / (float)T_s_ns;
    const float bounded = (pmsm_abs(hz) < most) ? pmsm_abs(hz) : 0.0F;
    const uint64_t size = fraction_of(as_parts(bounded) * T_s_ns, (uint64_t)NS_PER_S << 32);
    return (hz < 0.0F) ? 0u - size : size;
}

static void prepare_wave(pmsm_application *app)
{
    const pmsm_excitation *excitation = &app->excitation;
    const uint32_t T_s_ns = app->params->inverter_T_s_ns;
    pmsm_wave *wave = &app->wave;
    const uint64_t duration = as_parts(pmsm_clamp(excitation->duration, 0.0F, SECONDS_MOST));
    wave->f0 = excitation->f0;
    wave->f1 = excitation->f1;
    wave->duration = excitation->duration;
    wave->duration_ns = (duration >> 32) * NS_PER_S + (((duration & 0xFFFFFFFFu) * NS_PER_S + 0x80000000u) >> 32);
    wave->step = turns_per_period(excitation->f0, T_s_ns);
    wave->curvature = 0u;
    if (excitation->shape == (uint32_t)PMSM_SHAPE_CHIRP) { /* f0 t + (f1 - f0)/duration t^2/2 at t = k T_s */
        const uint32_t down = (excitation->f1 < excitation->f0) ? 1u : 0u;
        const uint64_t last = turns_per_period(excitation->f1, T_s_ns);
        const uint64_t way = (down != 0u) ? wave->step - last : last - wave->step;
        const uint64_t size = high_product(way, fraction_of(T_s_ns, wave->duration_ns));
        wave->curvature = (down != 0u) ? 0u - size : size;
        wave->step += ((down != 0u) ? 0u - size / 2u : size / 2u) + wave->curvature * wave->sample;
    }
}

static void start_wave(pmsm_application *app)
{
    pmsm_wave *wave = &app->wave;
    wave->phase = 0u;
    wave->elapsed_ns = 0u;
    wave->sample = 0u;
    prepare_wave(app);
    wave->prbs = PRBS_SEED;
    wave->sign_d = 1u;
    wave->sign_q = 1u;
    wave->started = 1u;
}

/* A frequency or duration that changes while the wave runs: its phase goes on. */
static void follow_changes(pmsm_application *app)
{
    const pmsm_excitation *excitation = &app->excitation;
    const pmsm_wave *wave = &app->wave;
    if (excitation->f0 != wave->f0 || excitation->f1 != wave->f1 || excitation->duration != wave->duration) {
        prepare_wave(app);
    }
}

static void obey(pmsm_application *app)
{
    pmsm_excitation *excitation = &app->excitation;
    const uint32_t command = excitation->command;
    app->wave.started = 0u;
    if (command > (uint32_t)COMMAND_START) {
        return;
    }
    excitation->command = PMSM_COMMAND_TAKEN;
    if (command == (uint32_t)COMMAND_STOP || excitation->shape == (uint32_t)PMSM_SHAPE_NONE) {
        excitation->state = (uint32_t)STATE_IDLE;
    } else if (command == (uint32_t)COMMAND_ARM) {
        excitation->state = (uint32_t)STATE_ARMED;
    } else {
        excitation->state = (uint32_t)STATE_RUNNING;
        start_wave(app);
    }
}

/* ---- the shapes -------------------------------------------------------------------------------------------------- */

static uint32_t hold(const pmsm_excitation *excitation)
{
    return (excitation->hold_periods > 0u) ? excitation->hold_periods : 1u;
}

/* Maximal-length register of 15 bits, x^15 + x^14 + 1: period 32767 bits. */
static float prbs_value(pmsm_application *app)
{
    pmsm_wave *wave = &app->wave;
    if (wave->sample > 0u && wave->sample % hold(&app->excitation) == 0u) {
        const uint32_t bit = ((wave->prbs >> 14) ^ (wave->prbs >> 13)) & 1u;
        wave->prbs = ((wave->prbs << 1) | bit) & 0x7FFFu;
    }
    return ((wave->prbs & 1u) != 0u) ? app->excitation.amplitude : -app->excitation.amplitude;
}

static float sine(const pmsm_wave *wave)
{
    float sine_of_phase;
    float cosine;
    pmsm_sincos(pmsm_signed_angle((uint32_t)(wave->phase >> 32)), &sine_of_phase, &cosine);
    return sine_of_phase;
}

static float buffer_value(const pmsm_application *app)
{
    const uint32_t asked = app->excitation.buffer_samples;
    const uint32_t count = (asked < app->buffer_length) ? asked : app->buffer_length;
    return (count > 0u) ? app->buffer[(app->wave.sample / hold(&app->excitation)) % count] : 0.0F;
}

/* Value of the wave in this period. */
static float wave_value(pmsm_application *app)
{
    const pmsm_excitation *excitation = &app->excitation;
    const uint32_t level = app->wave.sample / hold(excitation);
    switch (excitation->shape) {
    case PMSM_SHAPE_STEP:
        return excitation->amplitude;
    case PMSM_SHAPE_DC: /* rises over hold_periods */
        return (level > 0u) ? excitation->amplitude
                            : excitation->amplitude * (float)(app->wave.sample + 1u) / (float)hold(excitation);
    case PMSM_SHAPE_SINE:
    case PMSM_SHAPE_CHIRP:
        return excitation->amplitude * sine(&app->wave);
    case PMSM_SHAPE_PRBS:
        return prbs_value(app);
    case PMSM_SHAPE_SQUARE:
        return ((level & 1u) == 0u) ? excitation->amplitude : -excitation->amplitude;
    case PMSM_SHAPE_BUFFER:
        return buffer_value(app);
    default:
        return 0.0F;
    }
}

static uint32_t finished(const pmsm_application *app)
{
    const pmsm_excitation *excitation = &app->excitation;
    const pmsm_wave *wave = &app->wave;
    if (excitation->duration > 0.0F) {
        return (wave->elapsed_ns + app->params->inverter_T_s_ns / 2u >= wave->duration_ns) ? 1u : 0u;
    }
    return (excitation->shape == (uint32_t)PMSM_SHAPE_BUFFER &&
            wave->sample >= excitation->buffer_samples * hold(excitation)) ? 1u : 0u;
}

static void advance(pmsm_application *app)
{
    pmsm_wave *wave = &app->wave;
    wave->sample++;
    wave->elapsed_ns += app->params->inverter_T_s_ns;
    wave->phase += wave->step;
    wave->step += wave->curvature;
    if (finished(app) != 0u) {
        app->excitation.state = (uint32_t)STATE_DONE;
    }
}

/* ---- what it does to the reference ------------------------------------------------------------------------------- */

static pmsm_ab stator_current(const pmsm_application *app)
{
    const pmsm_abc i = {app->sensors.i_a, app->sensors.i_b, app->sensors.i_c};
    return pmsm_clarke(i);
}

static void abort_outside_limits(pmsm_application *app)
{
    pmsm_excitation *excitation = &app->excitation;
    const pmsm_ab i = stator_current(app);
    const float square = i.alpha * i.alpha + i.beta * i.beta;
    const float limit = excitation->abort_current;
    /* electrical, as the limit */
    const float speed = pmsm_abs((float)app->params->motor_pole_pairs * app->speed.omega);
    if ((limit > 0.0F && square > limit * limit) ||
        (excitation->abort_speed > 0.0F && speed > excitation->abort_speed)) {
        excitation->state = (uint32_t)STATE_ABORTED;
    }
}

/* +-V pulses that turn when the current has left its band (Hinkkanen et al. 2017, DOI 10.1109/TIA.2016.2644624). */
static void hysteresis(pmsm_application *app, pmsm_reference *reference, float angle)
{
    const pmsm_excitation *excitation = &app->excitation;
    pmsm_wave *wave = &app->wave;
    float sine_of_angle;
    float cosine;
    pmsm_sincos((pmsm_is_nan(angle) != 0u) ? pmsm_rotor_angle(app) : angle, &sine_of_angle, &cosine);
    const pmsm_dq i = pmsm_park(stator_current(app), sine_of_angle, cosine);
    const float i_d = i.d - excitation->i_centre_d;
    if (i_d > excitation->i_limit_d) {
        wave->sign_d = 0u;
    } else if (i_d < -excitation->i_limit_d) {
        wave->sign_d = 1u;
    } else {
        /* inside its band */
    }
    if (i.q > excitation->i_limit_q) {
        wave->sign_q = 0u;
    } else if (i.q < -excitation->i_limit_q) {
        wave->sign_q = 1u;
    } else {
        /* inside its band */
    }
    reference->mode = (uint32_t)PMSM_MODE_VOLTAGE;
    reference->u_d_inject = (wave->sign_d != 0u) ? excitation->amplitude : -excitation->amplitude;
    reference->u_q_inject = (wave->sign_q != 0u) ? excitation->amplitude_q : -excitation->amplitude_q;
}

static void inject(const pmsm_excitation *excitation, pmsm_reference *reference, float x)
{
    if (excitation->point == (uint32_t)PMSM_INJECT_SPEED) {
        reference->mode = (uint32_t)PMSM_MODE_SPEED;
        reference->omega_M_ref += x;
        return;
    }
    const uint32_t voltage = (excitation->point <= (uint32_t)PMSM_INJECT_U_Q) ? 1u : 0u;
    const uint32_t open_loop = (voltage != 0u && excitation->bias_bandwidth == 0.0F &&
                                excitation->bias_d == 0.0F && excitation->bias_q == 0.0F) ? 1u : 0u;
    reference->mode = (open_loop != 0u) ? (uint32_t)PMSM_MODE_VOLTAGE : (uint32_t)PMSM_MODE_CURRENT;
    reference->bias_bandwidth = excitation->bias_bandwidth;
    reference->i_d_ref = excitation->bias_d + ((excitation->point == (uint32_t)PMSM_INJECT_I_D) ? x : 0.0F);
    reference->i_q_ref = excitation->bias_q + ((excitation->point == (uint32_t)PMSM_INJECT_I_Q) ? x : 0.0F);
    reference->u_d_inject = (excitation->point == (uint32_t)PMSM_INJECT_U_D) ? x : 0.0F;
    reference->u_q_inject = (excitation->point == (uint32_t)PMSM_INJECT_U_Q) ? x : 0.0F;
}

static uint32_t is_on(const pmsm_excitation *excitation)
{
    return (excitation->state == (uint32_t)STATE_ARMED || excitation->state == (uint32_t)STATE_RUNNING) ? 1u : 0u;
}

void pmsm_excite(pmsm_application *app, pmsm_reference *reference, float *angle)
{
    pmsm_excitation *excitation = &app->excitation;
    obey(app);
    app->wave.active = 0u;
    if (is_on(excitation) != 0u) {
        if (app->enabled == 0u || app->trip != (uint32_t)PMSM_TRIP_NONE || app->quick_stop != 0u) {
            excitation->state = (uint32_t)STATE_ABORTED;
        } else {
            abort_outside_limits(app);
        }
    }
    if (excitation->state == (uint32_t)STATE_ABORTED) {
        reference->mode = (uint32_t)PMSM_MODE_OFF;
        return;
    }
    if (is_on(excitation) == 0u) {
        return;
    }
    if (pmsm_is_nan(excitation->fixed_angle) == 0u) {
        *angle = excitation->fixed_angle;
    }
    const uint32_t running = (excitation->state == (uint32_t)STATE_RUNNING) ? 1u : 0u;
    if (running != 0u) {
        follow_changes(app);
    }
    if (excitation->shape != (uint32_t)PMSM_SHAPE_HYSTERESIS) {
        inject(excitation, reference, (running != 0u) ? wave_value(app) : 0.0F);
    } else if (running != 0u) {
        hysteresis(app, reference, *angle);
    } else {
        /* armed: nothing is held */
    }
    app->wave.active = running;
    if (running != 0u) {
        advance(app);
    }
}
