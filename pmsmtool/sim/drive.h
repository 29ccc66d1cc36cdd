/* SPDX-License-Identifier: MIT */
/* The simulated drive's application: everything around the control core that a real drive's
 * firmware has at PWM rate - sensor processing, excitation, trace recorder, window averages, trips.
 * The CANopen node (Python) reads and writes these structs between calls; it never loops over periods.
 */
#ifndef PMSM_DRIVE_H
#define PMSM_DRIVE_H

#include "pmsm_core.h"

#define PMSM_TRACE_BYTES 65536u
#define PMSM_TRACE_CHANNELS 8u
#define PMSM_BUFFER_SAMPLES 4096u
#define PMSM_LUT_WORDS 8192u

/* Signals a trace channel, a trigger or a window average can name. */
enum pmsm_signal {
    PMSM_SIGNAL_NONE = 0,
    PMSM_SIGNAL_I_D, PMSM_SIGNAL_I_Q, PMSM_SIGNAL_I_D_REQ, PMSM_SIGNAL_I_Q_REQ,
    PMSM_SIGNAL_I_D_REF, PMSM_SIGNAL_I_Q_REF, PMSM_SIGNAL_U_D, PMSM_SIGNAL_U_Q,
    PMSM_SIGNAL_U_D_LIM, PMSM_SIGNAL_U_Q_LIM, PMSM_SIGNAL_THETA_E, PMSM_SIGNAL_OMEGA_E,
    PMSM_SIGNAL_TAU, PMSM_SIGNAL_KAPPA, PMSM_SIGNAL_BINDING, PMSM_SIGNAL_ITERATIONS, PMSM_SIGNAL_FLAGS,
    PMSM_SIGNAL_I_A, PMSM_SIGNAL_I_B, PMSM_SIGNAL_I_C, PMSM_SIGNAL_U_DC,
    PMSM_SIGNAL_T_WINDING, PMSM_SIGNAL_T_MAGNET, PMSM_SIGNAL_THETA_M, /* mechanical, unwrapped, rad */
    PMSM_SIGNAL_COUNT
};

typedef struct {                 /* what the sensors deliver at the sampling instant */
    float i_a, i_b, i_c;         /* A, after gain, offset, lag, noise and quantisation */
    float U_dc;                  /* V */
    float T_winding, T_magnet;   /* degC, as the sensors show them */
    double theta_M;              /* rad, mechanical, quantised encoder position, unwrapped */
    uint32_t adc_clipped;        /* 1: a sample stood at full scale */
} pmsm_sensors;

enum pmsm_shape {                /* object 0x2050:01 */
    PMSM_SHAPE_NONE = 0, PMSM_SHAPE_STEP, PMSM_SHAPE_SINE, PMSM_SHAPE_CHIRP, PMSM_SHAPE_PRBS,
    PMSM_SHAPE_BUFFER, PMSM_SHAPE_SQUARE, PMSM_SHAPE_DC, PMSM_SHAPE_HYSTERESIS
};

enum pmsm_injection { PMSM_INJECT_U_D = 0, PMSM_INJECT_U_Q, PMSM_INJECT_I_D, PMSM_INJECT_I_Q, PMSM_INJECT_SPEED };

typedef struct {                 /* object 0x2050, fields as drive/port.py Excitation */
    uint32_t shape, point, hold_periods;
    float amplitude, amplitude_q, bias_d, bias_q, bias_bandwidth;
    float f0, f1, duration;
    float fixed_angle;           /* NaN: follow the rotor */
    float i_limit_d, i_limit_q, i_centre_d;
    float abort_current, abort_speed;
    uint32_t command;            /* 0 stop, 1 arm, 2 start */
    uint32_t state;              /* 0 idle, 1 armed, 2 running, 3 done, 4 aborted */
    uint32_t buffer_samples;
} pmsm_excitation;

typedef struct {                 /* object 0x2060..0x2062 */
    uint32_t decimation, depth, pretrigger, trigger, trigger_signal;
    float trigger_level;
    uint32_t command;            /* 0 stop, 1 arm, 2 force */
    uint32_t state;              /* 0 idle, 1 armed, 2 triggered, 3 complete */
    uint32_t stored, trigger_position;
    uint32_t channel[PMSM_TRACE_CHANNELS]; /* enum pmsm_signal */
} pmsm_recorder;

typedef struct {                 /* object 0x2063: means over a window, taken in the drive */
    uint32_t periods;            /* window length; writing a command 1 starts it */
    uint32_t command, state;     /* state 0 idle, 1 running, 2 complete */
    uint32_t signal[PMSM_TRACE_CHANNELS];
    float mean[PMSM_TRACE_CHANNELS];
    float std[PMSM_TRACE_CHANNELS];
} pmsm_average;

/* Trips, object 0x603F carries the code; the latch clears with pmsm_drive_reset_fault(). */
enum pmsm_trip {
    PMSM_TRIP_NONE = 0, PMSM_TRIP_OVERCURRENT = 0x2310, PMSM_TRIP_OVERVOLTAGE = 0x3210,
    PMSM_TRIP_UNDERVOLTAGE = 0x3220, PMSM_TRIP_OVERTEMPERATURE = 0x4310, PMSM_TRIP_OVERSPEED = 0x8480,
    PMSM_TRIP_INTERNAL = 0x5530
};

typedef struct pmsm_drive {
    pmsm_params params;                 /* active set */
    uint32_t lut[PMSM_LUT_WORDS];
    pmsm_state control;
    pmsm_reference reference;           /* what the node asks for */
    pmsm_excitation excitation;
    pmsm_recorder recorder;
    pmsm_average average;
    pmsm_sensors sensors;               /* as sampled in the last period */
    uint32_t enabled;                   /* 1: operation enabled (node decides), 0: gates off */
    uint32_t quick_stop;                /* 1: ramp the current reference to zero and brake */
    uint32_t trip;                      /* enum pmsm_trip, latched */
    float fixed_angle;                  /* NaN: frame follows the rotor; else frozen electrical angle */
    uint64_t period_count;
    float buffer[PMSM_BUFFER_SAMPLES];
    uint8_t trace[PMSM_TRACE_BYTES];    /* sample-interleaved little-endian binary32 */
    /* private memory of the application */
    double theta_M_last, pll_theta, pll_omega;
    double excitation_time, excitation_phase, excitation_i_ref;
    uint32_t excitation_sample, prbs, hysteresis_sign_d, hysteresis_sign_q;
    uint32_t recorder_count, recorder_write, recorder_filled, recorder_after;
    uint32_t average_count;
    double average_sum[PMSM_TRACE_CHANNELS], average_square[PMSM_TRACE_CHANNELS];
    float trigger_last;
    uint32_t trigger_primed;
    double theta_M_base;                /* rad, whole turns taken off PMSM_SIGNAL_THETA_M so that binary32 resolves it */
    double pll_alpha, pll_beta;         /* gains of the speed estimate, from the active parameters */
    uint32_t quick_stop_state;          /* 0 inactive, 1 stopping, 2 stopped */
    float quick_stop_share;             /* 1 -> 0 */
    pmsm_reference quick_stop_start;    /* reference when the quick stop came */
    pmsm_reference applied;             /* reference of the last period, excitation included */
    float applied_angle;                /* rad, fixed frame angle of the last period, NaN when it followed the rotor */
    uint32_t excitation_active;         /* 1 in a period with a wave */
    uint32_t excitation_started;        /* 1 in the period in which an excitation started */
    uint32_t trip_last;
    double average_first[PMSM_TRACE_CHANNELS];
    uint32_t pll_follows;               /* 0: the next angle starts the speed estimate's, without a jump */
} pmsm_drive;

/* A command that has been carried out; 0 stop, 1 arm (or start an average), 2 start (or force) are new ones. */
#define PMSM_COMMAND_TAKEN 0xFFFFFFFFu

/* Bytes of a pmsm_drive (for the caller who allocates it). */
PMSM_EXPORT uint32_t pmsm_drive_size(void);
PMSM_EXPORT void pmsm_drive_init(pmsm_drive *drive);
/* Take an image (params + lut words); returns 0, or the reason it was refused (enum pmsm_image_status). */
PMSM_EXPORT uint32_t pmsm_drive_load(pmsm_drive *drive, const uint8_t *image, uint32_t size);
PMSM_EXPORT void pmsm_drive_reset_fault(pmsm_drive *drive);
/* One PWM period of the application: sensors in, duty ratios out. */
PMSM_EXPORT void pmsm_drive_period(pmsm_drive *drive, const pmsm_sensors *sensors, pmsm_output *output);
/* Value of a signal as it would be recorded now. */
PMSM_EXPORT float pmsm_drive_signal(const pmsm_drive *drive, uint32_t signal);

#endif
