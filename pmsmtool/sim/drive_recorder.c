/* SPDX-License-Identifier: MIT */
/* Trace recorder (objects 0x2060 to 0x2062) and window averages (0x2063).
 *
 * A row belongs to one period: what was sampled at its start and what was computed from it.
 */
#include <math.h>
#include <stddef.h>
#include <string.h>

#include "drive_parts.h"

enum { RECORDER_IDLE = 0, RECORDER_ARMED = 1, RECORDER_TRIGGERED = 2, RECORDER_COMPLETE = 3 };
enum { TRIGGER_NOW = 0, TRIGGER_RISING = 1, TRIGGER_FALLING = 2, TRIGGER_WINDOW = 3, TRIGGER_EXCITATION = 4,
       TRIGGER_FAULT = 5 };
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
    uint32_t word;
    memcpy(&word, &value, sizeof word);
    at[0] = (uint8_t)(word & 0xFFu);
    at[1] = (uint8_t)((word >> 8) & 0xFFu);
    at[2] = (uint8_t)((word >> 16) & 0xFFu);
    at[3] = (uint8_t)(word >> 24);
}

/* Rows the ring holds: the depth asked for, or what the memory takes. */
static uint32_t ring_rows(const pmsm_recorder *recorder)
{
    const uint32_t count = channels(recorder);
    const uint32_t room = (count > 0u) ? PMSM_TRACE_BYTES / (4u * count) : 0u;
    return (recorder->depth < room) ? recorder->depth : room;
}

static void take_row(pmsm_drive *drive)
{
    const pmsm_recorder *recorder = &drive->recorder;
    const uint32_t count = channels(recorder);
    const uint32_t rows = ring_rows(recorder);
    uint8_t *row = drive->trace + 4u * count * drive->recorder_write;
    for (uint32_t k = 0u; k < count; k++) {
        put_float(row + 4u * k, pmsm_drive_signal(drive, recorder->channel[k]));
    }
    drive->recorder_write = (drive->recorder_write + 1u == rows) ? 0u : drive->recorder_write + 1u;
    drive->recorder_filled += (drive->recorder_filled < rows) ? 1u : 0u;
}

static void reverse_rows(uint8_t *trace, uint32_t size, uint32_t first, uint32_t last)
{
    uint8_t keep[4u * PMSM_TRACE_CHANNELS];
    while (first + 1u < last) {
        last--;
        memcpy(keep, trace + size * first, size);
        memcpy(trace + size * first, trace + size * last, size);
        memcpy(trace + size * last, keep, size);
        first++;
    }
}

/* Turn the ring so that the oldest of the stored rows comes first. */
static void complete(pmsm_drive *drive, uint32_t stored, uint32_t state)
{
    pmsm_recorder *recorder = &drive->recorder;
    const uint32_t rows = ring_rows(recorder);
    const uint32_t size = 4u * channels(recorder);
    const uint32_t start = (rows > 0u) ? (drive->recorder_write + rows - stored) % rows : 0u;
    reverse_rows(drive->trace, size, 0u, start);
    reverse_rows(drive->trace, size, start, rows);
    reverse_rows(drive->trace, size, 0u, rows);
    recorder->stored = stored;
    recorder->state = state;
}

static void arm(pmsm_drive *drive)
{
    pmsm_recorder *recorder = &drive->recorder;
    drive->recorder_count = 0u;
    drive->recorder_write = 0u;
    drive->recorder_filled = 0u;
    drive->trigger_primed = 0u;
    drive->theta_M_base = 6.28318530717958647692 * floor(drive->sensors.theta_M / 6.28318530717958647692 + 0.5);
    recorder->stored = 0u;
    recorder->trigger_position = 0u;
    recorder->state = (ring_rows(recorder) > 0u) ? RECORDER_ARMED : RECORDER_IDLE;
}

/* The trigger row itself is the first of those counted by recorder_after. */
static void trigger(pmsm_drive *drive)
{
    pmsm_recorder *recorder = &drive->recorder;
    const uint32_t rows = ring_rows(recorder);
    uint32_t before = (recorder->pretrigger < rows) ? recorder->pretrigger : rows - 1u;
    before = (before < drive->recorder_filled) ? before : drive->recorder_filled;
    recorder->trigger_position = before;
    recorder->state = RECORDER_TRIGGERED;
    drive->recorder_after = rows - before;
    drive->recorder_count = 0u; /* the row grid starts anew at the trigger */
}

static uint32_t is_triggered(pmsm_drive *drive)
{
    const pmsm_recorder *recorder = &drive->recorder;
    if (recorder->trigger == TRIGGER_NOW) {
        return 1u;
    }
    if (recorder->trigger == TRIGGER_EXCITATION) {
        return drive->excitation_started;
    }
    if (recorder->trigger == TRIGGER_FAULT) {
        return (drive->trip != PMSM_TRIP_NONE && drive->trip_last == PMSM_TRIP_NONE) ? 1u : 0u;
    }
    const float value = pmsm_drive_signal(drive, recorder->trigger_signal);
    const float last = drive->trigger_last;
    const uint32_t primed = drive->trigger_primed;
    drive->trigger_last = value;
    drive->trigger_primed = 1u;
    const float level = recorder->trigger_level;
    if (recorder->trigger == TRIGGER_WINDOW) {
        return (fabsf(value) > level) ? 1u : 0u;
    }
    const uint32_t rising = (last < level && value >= level) ? 1u : 0u;
    const uint32_t falling = (last > level && value <= level) ? 1u : 0u;
    return primed & ((recorder->trigger == TRIGGER_RISING) ? rising : falling);
}

/* Rows that belong to the recording so far. */
static uint32_t rows_taken(const pmsm_drive *drive)
{
    const pmsm_recorder *recorder = &drive->recorder;
    if (recorder->state != RECORDER_TRIGGERED) {
        return 0u;
    }
    return ring_rows(recorder) - drive->recorder_after;
}

static void obey(pmsm_drive *drive)
{
    pmsm_recorder *recorder = &drive->recorder;
    const uint32_t command = recorder->command;
    recorder->command = PMSM_COMMAND_TAKEN;
    if (command == COMMAND_STOP) {
        if (recorder->state == RECORDER_ARMED || recorder->state == RECORDER_TRIGGERED) {
            complete(drive, rows_taken(drive), RECORDER_IDLE);
        }
    } else if (command == COMMAND_ARM) {
        arm(drive);
    } else if (command == COMMAND_FORCE && recorder->state == RECORDER_ARMED) {
        trigger(drive);
    }
}

void pmsm_drive_record(pmsm_drive *drive)
{
    pmsm_recorder *recorder = &drive->recorder;
    if (recorder->command != PMSM_COMMAND_TAKEN) {
        obey(drive);
    }
    if (recorder->state != RECORDER_ARMED && recorder->state != RECORDER_TRIGGERED) {
        return;
    }
    if (recorder->state == RECORDER_ARMED && is_triggered(drive) != 0u) {
        trigger(drive);
    }
    if (drive->recorder_count == 0u) {
        take_row(drive);
        drive->recorder_count = (recorder->decimation > 0u) ? recorder->decimation : 1u;
        if (recorder->state == RECORDER_TRIGGERED) {
            drive->recorder_after--;
        }
    }
    drive->recorder_count--;
    if (recorder->state == RECORDER_TRIGGERED && drive->recorder_after == 0u) {
        complete(drive, ring_rows(recorder), RECORDER_COMPLETE);
    }
}

static void start_average(pmsm_drive *drive)
{
    pmsm_average *average = &drive->average;
    drive->average_count = 0u;
    average->state = (average->periods > 0u) ? AVERAGE_RUNNING : AVERAGE_IDLE;
    for (uint32_t k = 0u; k < PMSM_TRACE_CHANNELS; k++) {
        drive->average_sum[k] = 0.0;
        drive->average_square[k] = 0.0;
        drive->average_first[k] = (double)pmsm_drive_signal(drive, average->signal[k]);
    }
}

static void finish_average(pmsm_drive *drive)
{
    pmsm_average *average = &drive->average;
    const double n = (double)drive->average_count;
    for (uint32_t k = 0u; k < PMSM_TRACE_CHANNELS; k++) {
        const double mean = drive->average_sum[k] / n;
        const double spread = drive->average_square[k] - n * mean * mean;
        const double variance = (n > 1.0 && spread > 0.0) ? spread / (n - 1.0) : 0.0;
        average->mean[k] = (float)(drive->average_first[k] + mean);
        average->std[k] = (float)sqrt(variance);
    }
    average->state = AVERAGE_COMPLETE;
}

void pmsm_drive_average(pmsm_drive *drive)
{
    pmsm_average *average = &drive->average;
    if (average->command != PMSM_COMMAND_TAKEN) {
        if (average->command == COMMAND_ARM) {
            start_average(drive);
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
            const double x = (double)pmsm_drive_signal(drive, average->signal[k]) - drive->average_first[k];
            drive->average_sum[k] += x;
            drive->average_square[k] += x * x;
        }
    }
    drive->average_count++;
    if (drive->average_count >= average->periods) {
        finish_average(drive);
    }
}
