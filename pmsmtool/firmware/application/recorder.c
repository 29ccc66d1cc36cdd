/* SPDX-License-Identifier: MIT */
/* Trace recorder (objects 0x2060 to 0x2062) and window averages (0x2063).
 *
 * A row belongs to one period: what was sampled at its start and what was computed from it.
 */
#include "application_parts.h"

enum { RECORDER_IDLE = 0, RECORDER_ARMED = 1, RECORDER_TRIGGERED = 2, RECORDER_COMPLETE = 3 };
enum { TRIGGER_NOW = 0, TRIGGER_RISING = 1, TRIGGER_FALLING = 2, TRIGGER_WINDOW = 3, TRIGGER_EXCITATION = 4,
       TRIGGER_FAULT = 5, TRIGGER_MOVE = 6 };
enum { COMMAND_STOP = 0, COMMAND_ARM = 1, COMMAND_FORCE = 2 };
enum { AVERAGE_IDLE = 0, AVERAGE_RUNNING = 1, AVERAGE_COMPLETE = 2 };

static uint32_t channels(const pmsm_recorder *recorder)
{
    uint32_t count = 0u;
    while (count < PMSM_TRACE_CHANNELS && recorder->channel[count] != PMSM_SIGNAL_NONE) {
        count++;
    }
    return count;
}

static void put_float(uint8_t *at, float value)
{
    union {
        float value;
        uint32_t word;
    } bits;
    bits.value = value;
    at[0] = (uint8_t)(bits.word & 0xFFu);
    at[1] = (uint8_t)((bits.word >> 8) & 0xFFu);
    at[2] = (uint8_t)((bits.word >> 16) & 0xFFu);
    at[3] = (uint8_t)(bits.word >> 24);
}

/* Rows the ring holds: the depth asked for, or what the memory takes. */
static uint32_t ring_rows(const pmsm_application *app)
{
    const pmsm_recorder *recorder = &app->recorder;
    const uint32_t count = channels(recorder);
    const uint32_t room = (count > 0u) ? app->trace_bytes / (4u * count) : 0u;
    return (recorder->depth < room) ? recorder->depth : room;
}

static void take_row(pmsm_application *app)
{
    const pmsm_recorder *recorder = &app->recorder;
    const uint32_t count = channels(recorder);
    const uint32_t rows = ring_rows(app);
    for (uint32_t k = 0u; k < count; k++) {
        const float value = pmsm_application_signal(app, recorder->channel[k]);
        put_float(&app->trace[4u * (count * app->recording.write + k)], value);
    }
    app->recording.write = (app->recording.write + 1u == rows) ? 0u : app->recording.write + 1u;
    app->recording.filled += (app->recording.filled < rows) ? 1u : 0u;
}

static void reverse_rows(uint8_t *trace, uint32_t size, uint32_t first, uint32_t last)
{
    uint32_t low = first;
    uint32_t high = last;
    while (low + 1u < high) {
        high--;
        for (uint32_t k = 0u; k < size; k++) {
            const uint8_t kept = trace[size * low + k];
            trace[size * low + k] = trace[size * high + k];
            trace[size * high + k] = kept;
        }
        low++;
    }
}

/* Turn the ring so that the oldest of the stored rows comes first. */
static void complete(pmsm_application *app, uint32_t stored, uint32_t state)
{
    pmsm_recorder *recorder = &app->recorder;
    const uint32_t rows = ring_rows(app);
    const uint32_t size = 4u * channels(recorder);
    const uint32_t start = (rows > 0u) ? (app->recording.write + rows - stored) % rows : 0u;
    reverse_rows(app->trace, size, 0u, start);
    reverse_rows(app->trace, size, start, rows);
    reverse_rows(app->trace, size, 0u, rows);
    recorder->stored = stored;
    recorder->state = state;
}

static void arm(pmsm_application *app)
{
    pmsm_recorder *recorder = &app->recorder;
    app->recording.count = 0u;
    app->recording.write = 0u;
    app->recording.filled = 0u;
    app->recording.trigger_primed = 0u;
    app->recording.turns = pmsm_nearest_turn(&app->sensors);
    recorder->stored = 0u;
    recorder->trigger_position = 0u;
    recorder->state = (ring_rows(app) > 0u) ? RECORDER_ARMED : RECORDER_IDLE;
}

/* The trigger row itself is the first of those counted by recorder_after. */
static void trigger(pmsm_application *app)
{
    pmsm_recorder *recorder = &app->recorder;
    const uint32_t rows = ring_rows(app);
    uint32_t before = (recorder->pretrigger < rows) ? recorder->pretrigger : rows - 1u;
    before = (before < app->recording.filled) ? before : app->recording.filled;
    recorder->trigger_position = before;
    recorder->state = RECORDER_TRIGGERED;
    app->recording.after = rows - before;
    app->recording.count = 0u; /* the row grid starts anew at the trigger */
}

static uint32_t is_triggered(pmsm_application *app)
{
    const pmsm_recorder *recorder = &app->recorder;
    if (recorder->trigger == TRIGGER_NOW) {
        return 1u;
    }
    if (recorder->trigger == TRIGGER_EXCITATION) {
        return app->wave.started;
    }
    if (recorder->trigger == TRIGGER_MOVE) {
        return (app->position.running != 0u && (app->position.flags & (uint32_t)PMSM_POSITION_MOVING) != 0u) ? 1u : 0u;
    }
    if (recorder->trigger == TRIGGER_FAULT) {
        return (app->trip != PMSM_TRIP_NONE && app->recording.trip_last == PMSM_TRIP_NONE) ? 1u : 0u;
    }
    const float value = pmsm_application_signal(app, recorder->trigger_signal);
    const float last = app->recording.trigger_last;
    const uint32_t primed = app->recording.trigger_primed;
    app->recording.trigger_last = value;
    app->recording.trigger_primed = 1u;
    const float level = recorder->trigger_level;
    if (recorder->trigger == TRIGGER_WINDOW) {
        return (pmsm_abs(value) > level) ? 1u : 0u;
    }
    const uint32_t rising = (last < level && value >= level) ? 1u : 0u;
    const uint32_t falling = (last > level && value <= level) ? 1u : 0u;
    return primed & ((recorder->trigger == TRIGGER_RISING) ? rising : falling);
}

/* Rows that belong to the recording so far. */
static uint32_t rows_taken(const pmsm_application *app)
{
    const pmsm_recorder *recorder = &app->recorder;
    if (recorder->state != RECORDER_TRIGGERED) {
        return 0u;
    }
    return ring_rows(app) - app->recording.after;
}

static void obey(pmsm_application *app)
{
    pmsm_recorder *recorder = &app->recorder;
    const uint32_t command = recorder->command;
    recorder->command = PMSM_COMMAND_TAKEN;
    if (command == COMMAND_STOP) {
        if (recorder->state == RECORDER_ARMED || recorder->state == RECORDER_TRIGGERED) {
            complete(app, rows_taken(app), RECORDER_IDLE);
        }
    } else if (command == COMMAND_ARM) {
        arm(app);
    } else if (command == COMMAND_FORCE && recorder->state == RECORDER_ARMED) {
        trigger(app);
    }
}

void pmsm_record(pmsm_application *app)
{
    pmsm_recorder *recorder = &app->recorder;
    if (recorder->command != PMSM_COMMAND_TAKEN) {
        obey(app);
    }
    if (recorder->state != RECORDER_ARMED && recorder->state != RECORDER_TRIGGERED) {
        return;
    }
    if (recorder->state == RECORDER_ARMED && is_triggered(app) != 0u) {
        trigger(app);
    }
    if (app->recording.count == 0u) {
        take_row(app);
        app->recording.count = (recorder->decimation > 0u) ? recorder->decimation : 1u;
        if (recorder->state == RECORDER_TRIGGERED) {
            app->recording.after--;
        }
    }
    app->recording.count--;
    if (recorder->state == RECORDER_TRIGGERED && app->recording.after == 0u) {
        complete(app, ring_rows(app), RECORDER_COMPLETE);
    }
}

static void start_average(pmsm_application *app)
{
    pmsm_average *average = &app->average;
    const pmsm_average_memory none = {0};
    app->averaging = none;
    average->state = (average->periods > 0u) ? AVERAGE_RUNNING : AVERAGE_IDLE;
    for (uint32_t k = 0u; k < PMSM_TRACE_CHANNELS; k++) {
        app->averaging.first[k] = pmsm_application_signal(app, average->signal[k]);
    }
}

/* Kahan: what rounding added to a sum is taken off the next term. */
static void add(float *sum, float *carry, float x)
{
    const float term = x - *carry;
    const float total = *sum + term;
    *carry = (total - *sum) - term;
    *sum = total;
}

static void finish_average(pmsm_application *app)
{
    pmsm_average *average = &app->average;
    const pmsm_average_memory *taken = &app->averaging;
    const float n = (float)taken->count;
    for (uint32_t k = 0u; k < PMSM_TRACE_CHANNELS; k++) {
        const float mean = (taken->sum[k] - taken->sum_carry[k]) / n;
        const float spread = (taken->square[k] - taken->square_carry[k]) - n * mean * mean;
        const float variance = (n > 1.0F && spread > 0.0F) ? spread / (n - 1.0F) : 0.0F;
        average->mean[k] = taken->first[k] + mean;
        average->std[k] = PMSM_SQRT(variance);
    }
    average->state = AVERAGE_COMPLETE;
}

void pmsm_take_average(pmsm_application *app)
{
    pmsm_average *average = &app->average;
    pmsm_average_memory *taken = &app->averaging;
    if (average->command != PMSM_COMMAND_TAKEN) {
        if (average->command == COMMAND_ARM) {
            start_average(app);
        } else {
            average->state = AVERAGE_IDLE;
        }
        average->command = PMSM_COMMAND_TAKEN;
    }
    if (average->state != AVERAGE_RUNNING) {
        return;
    }
    for (uint32_t k = 0u; k < PMSM_TRACE_CHANNELS; k++) {
        if (average->signal[k] != PMSM_SIGNAL_NONE) {
            /* relative to the first value: the squares keep their digits */
            const float x = pmsm_application_signal(app, average->signal[k]) - taken->first[k];
            add(&taken->sum[k], &taken->sum_carry[k], x);
            add(&taken->square[k], &taken->square_carry[k], x * x);
        }
    }
    taken->count++;
    if (taken->count >= average->periods) {
        finish_average(app);
    }
}
