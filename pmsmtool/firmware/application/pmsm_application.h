/* SPDX-License-Identifier: MIT */
/* The application around the control core, at PWM rate: speed estimate, Hall sensors, position control, homing, trips,
 * quick stop, excitation, recorder, window averages. The simulated drive runs these files; for another drive they are
 * optional.
 *
 * binary32 and integers, no allocation, no C library. Whoever asks (a bus, a user interface) reads and writes the
 * members between two periods.
 */
#ifndef PMSM_APPLICATION_H
#define PMSM_APPLICATION_H

#include "pmsm_core.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef PMSM_REAL_DOUBLE
#error "the application is single precision: build it with the core in single precision"
#endif

#define PMSM_TRACE_CHANNELS 8u

/* Signals a trace channel, a trigger or a window average can name. */
enum pmsm_signal {
    PMSM_SIGNAL_NONE = 0,
    PMSM_SIGNAL_I_D, PMSM_SIGNAL_I_Q, PMSM_SIGNAL_I_D_REQ, PMSM_SIGNAL_I_Q_REQ,
    PMSM_SIGNAL_I_D_REF, PMSM_SIGNAL_I_Q_REF, PMSM_SIGNAL_U_D, PMSM_SIGNAL_U_Q,
    PMSM_SIGNAL_U_D_LIM, PMSM_SIGNAL_U_Q_LIM, PMSM_SIGNAL_THETA_E, PMSM_SIGNAL_OMEGA_E,
    PMSM_SIGNAL_TAU, PMSM_SIGNAL_KAPPA, PMSM_SIGNAL_BINDING, PMSM_SIGNAL_ITERATIONS, PMSM_SIGNAL_FLAGS,
    PMSM_SIGNAL_I_A, PMSM_SIGNAL_I_B, PMSM_SIGNAL_I_C, PMSM_SIGNAL_U_DC,
    PMSM_SIGNAL_T_WINDING, PMSM_SIGNAL_T_MAGNET, PMSM_SIGNAL_THETA_M, /* mechanical, unwrapped, rad */
    PMSM_SIGNAL_FOLLOWING_ERROR, /* rad, mechanical: reference less position */
    PMSM_SIGNAL_HALL,
    PMSM_SIGNAL_COUNT
};

typedef struct {                 /* what the sensors deliver at the sampling instant */
    float i_a, i_b, i_c;         /* A */
    float U_dc;                  /* V */
    float T_winding, T_magnet;   /* degC, NaN without a sensor; nothing but the recorder reads T_magnet */
    int32_t turns;               /* whole mechanical turns of the encoder; may wrap */
    uint32_t angle;              /* 2^-32 mechanical turns */
    uint32_t encoder_failed;     /* 1: turns and angle are no reading */
    uint32_t limits;             /* limit switches that are active: bit 0 negative, bit 1 positive direction */
    uint32_t adc_clipped;        /* 1: a sample stood at full scale */
    uint32_t hall;               /* levels of the Hall wires, bit k of wire k + 1 */
    uint32_t encoder_unreferenced; /* 1: turns and angle count from anywhere, 0: from the encoder's index */
} pmsm_sensors;

enum pmsm_shape {                /* object 0x2050:01 */
    PMSM_SHAPE_NONE = 0, PMSM_SHAPE_STEP, PMSM_SHAPE_SINE, PMSM_SHAPE_CHIRP, PMSM_SHAPE_PRBS,
    PMSM_SHAPE_BUFFER, PMSM_SHAPE_SQUARE, PMSM_SHAPE_DC, PMSM_SHAPE_HYSTERESIS
};

enum pmsm_injection { PMSM_INJECT_U_D = 0, PMSM_INJECT_U_Q, PMSM_INJECT_I_D, PMSM_INJECT_I_Q, PMSM_INJECT_SPEED };

/* A command that has been carried out; 0 stop, 1 arm (or start an average), 2 start (or force) are new ones. */
#define PMSM_COMMAND_TAKEN 0xFFFFFFFFu

typedef struct {                 /* object 0x2050 */
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

/* Trips; object 0x603F carries the code. The latch clears with pmsm_application_reset_fault(). */
enum pmsm_trip {
    PMSM_TRIP_NONE = 0, PMSM_TRIP_OVERCURRENT = 0x2310, PMSM_TRIP_OVERVOLTAGE = 0x3210,
    PMSM_TRIP_UNDERVOLTAGE = 0x3220, PMSM_TRIP_OVERTEMPERATURE = 0x4310, PMSM_TRIP_OVERSPEED = 0x8480,
    PMSM_TRIP_INTERNAL = 0x5530,
    PMSM_TRIP_ENCODER = 0x7305   /* no angle of the rotor, by encoder or Hall sensors */
};

typedef struct {                 /* speed estimate */
    float omega;                 /* rad/s, mechanical, along the phase order */
    float lag;                   /* rad, by which the estimated angle is behind the encoder */
    float keep, beta;            /* gains, from the active parameters: share of an error that stays; 1/s */
    float lost;                  /* share of a first-order error that a period takes away */
    float T_s;                   /* s */
    uint32_t angle;              /* last reading */
    uint32_t follows;            /* 0: the next reading starts the estimate's angle, without a jump */
    uint32_t unreferenced;       /* of the last reading */
    uint32_t reversed;           /* direction that lag and omega were estimated with */
    uint32_t offset;             /* electrical angle of the encoder's zero, 2^-32 turns */
} pmsm_speed_estimate;

enum pmsm_hall_commutation {     /* parameter hall.commutation */
    PMSM_HALL_NONE = 0,
    PMSM_HALL_START,             /* until the encoder counts from its index */
    PMSM_HALL_ALONE,             /* in place of an encoder: angle, speed and position */
    PMSM_HALL_STEPS              /* the same, and the frame stands in the middle of the sector: six steps per turn */
};

typedef struct {                 /* rotor by the Hall sensors; electrical angles, 2^-32 turns */
    uint32_t angle;
    uint32_t failed;             /* 1: the wires show no sector */
    /* private memory */
    uint32_t axis[3];            /* where wires 1 to 3 are in the middle of their high half, from the parameters */
    uint32_t low, width;         /* sector: where it begins, how wide it is; width 0: none was seen */
    uint32_t edge;               /* that was passed last, or the middle of the first sector */
    uint32_t entered, up;        /* 1: over an edge, upwards */
    uint32_t since;              /* periods in the sector */
    float expected;              /* periods it is expected to take, 0: not known */
    uint32_t encoder;            /* electrical angle of the encoder at the edge */
    uint32_t counted, period, turns; /* last angle, electrical and mechanical turns that were counted */
} pmsm_hall;

typedef struct {                 /* memory of a running excitation */
    uint64_t phase, step, curvature; /* 2^-64 turns: angle of the sine, its increment, the increment's increment */
    uint64_t elapsed_ns;
    uint64_t duration_ns;
    float f0, f1, duration;      /* that step and curvature were computed from */
    uint32_t sample, prbs, sign_d, sign_q;
    uint32_t active;             /* 1 in a period with a wave */
    uint32_t started;            /* 1 in the period in which an excitation started */
} pmsm_wave;

typedef struct {                 /* memory of the recorder */
    uint32_t count, write, filled, after;
    float trigger_last;
    uint32_t trigger_primed;
    uint32_t trip_last;
    uint32_t turns;              /* taken off PMSM_SIGNAL_THETA_M so that binary32 resolves it */
} pmsm_recorder_memory;

typedef struct {                 /* memory of the window averages: sums with their rounding remainders (Kahan) */
    uint32_t count;
    float first[PMSM_TRACE_CHANNELS];
    float sum[PMSM_TRACE_CHANNELS], sum_carry[PMSM_TRACE_CHANNELS];
    float square[PMSM_TRACE_CHANNELS], square_carry[PMSM_TRACE_CHANNELS];
} pmsm_average_memory;

typedef struct {                 /* memory of a quick stop */
    uint32_t state;              /* 0 inactive, 1 stopping, 2 stopped */
    float share;                 /* of the first reference that is left, 1 -> 0 */
    pmsm_reference start;        /* reference when the quick stop came */
} pmsm_quick_stop;

/* Steps of the speed controller that a change of the acceleration takes at most: jerk * PMSM_JERK_STEPS * its period is
 * the largest acceleration of a move. */
#define PMSM_JERK_STEPS 128u

enum pmsm_position_flag {
    PMSM_POSITION_MOVING = 1u << 0,      /* the reference has not come to rest at the target */
    PMSM_POSITION_ERROR = 1u << 1,       /* the following error left its window for its time; the caller decides */
    PMSM_POSITION_SOFTWARE_LIMIT = 1u << 2, /* a target was cut to minimum or maximum */
    PMSM_POSITION_SWITCH = 1u << 3,      /* a limit switch stops the way to the target */
    PMSM_POSITION_SATURATED = 1u << 4    /* the speed reference is at the machine's largest speed */
};

enum pmsm_homing_method {        /* object 0x6098, in the encoder's direction; the stops are of this drive's own */
    PMSM_HOMING_STOP_POSITIVE = -2, PMSM_HOMING_STOP_NEGATIVE = -1,
    PMSM_HOMING_SWITCH_NEGATIVE = 17, PMSM_HOMING_SWITCH_POSITIVE = 18,
    PMSM_HOMING_INDEX_NEGATIVE = 33, PMSM_HOMING_INDEX_POSITIVE = 34,
    PMSM_HOMING_HERE = 37
};

enum pmsm_homing_phase {
    PMSM_HOMING_IDLE = 0,
    PMSM_HOMING_SEARCH,
    PMSM_HOMING_AWAY,            /* from the limit switch that was found, until it opens */
    PMSM_HOMING_REST,            /* found: the shaft comes to rest */
    PMSM_HOMING_DONE,
    PMSM_HOMING_INTERRUPTED,     /* start was taken back, or the control ended */
    PMSM_HOMING_FAILED           /* no such method, a limit switch in the way, nothing found */
};

typedef struct {                 /* homing, by the profile's velocity towards a switch or a stop, and its ramps */
    uint32_t active;             /* 1: homing takes the place of targets */
    uint32_t start;              /* 1: home, and stay; 0 interrupts a search */
    int32_t method;              /* enum pmsm_homing_method */
    float slow;                  /* increments/s, to an index, and away from a switch */
    float torque;                /* N m, of either sign, that says: a mechanical stop */
    int32_t home_offset;         /* increments: the zero lies so far beyond the home position */
} pmsm_homing_request;

typedef struct {                 /* position control: what is asked; used with reference.mode PMSM_MODE_POSITION */
    uint32_t increments;         /* of the position in a mechanical turn, in the encoder's direction */
    int32_t offset;              /* increments, added to the encoder's count: position = count + offset, modulo 2^32;
                                    homing writes it */
    uint32_t profile;            /* 1: move to every target by the profile; 0: follow targets, linear between two */
    int32_t target;              /* increments */
    uint32_t set_point;          /* another number: target is a new one. Without one the shaft is held where it is */
    float interval;              /* s from target to target, without a profile */
    float velocity;              /* increments/s */
    float acceleration, deceleration; /* increments/s^2 */
    float stop_deceleration;     /* increments/s^2, at a limit switch */
    float jerk;                  /* increments/s^3, 0: not limited; twice as much from one ramp to the other, where a
                                    move is too short for a constant speed between them */
    uint32_t halt;               /* 1: with a profile, come to rest by the deceleration */
    int32_t minimum, maximum;    /* increments, of every target; none when minimum >= maximum */
    float window, window_time;   /* increments, s: following error that is a fault; window 0: none */
    pmsm_homing_request homing;
} pmsm_position_request;

typedef struct {                 /* the reference of a move: trapezoid of the speed, averaged over the jerk's time */
    int32_t planned;             /* increments, where the trapezoid is */
    float planned_part;          /* increments in [-0.5, 0.5], beside planned */
    float planned_velocity;      /* increments per step */
    float moved[PMSM_JERK_STEPS]; /* increments of the last steps, a ring */
    uint32_t length, next;       /* steps that are averaged; the oldest of them */
    uint32_t resting;            /* steps since the trapezoid moved, up to length */
} pmsm_trajectory;

typedef struct {
    pmsm_position_request asked;
    int32_t actual;              /* increments */
    int32_t reference;           /* increments */
    float reference_part;        /* increments, beside reference */
    float velocity;              /* increments/s, of the reference */
    float acceleration;          /* increments/s^2, of the reference */
    float error;                 /* increments, reference - actual */
    uint32_t flags;              /* enum pmsm_position_flag */
    uint32_t limits;             /* limit switches, as the sensors show them */
    uint32_t homing;             /* enum pmsm_homing_phase */
    /* private memory */
    pmsm_trajectory trajectory;
    int32_t target;              /* increments, taken and within the limits */
    uint32_t seen;               /* set_point that was taken */
    uint32_t left;               /* PWM periods to the end of the interval */
    float step;                  /* increments per PWM period, within the interval */
    uint32_t stopped;            /* 1: a limit switch ended the following */
    uint32_t followed;           /* 1: targets were followed in the last period, without a profile */
    float outside;               /* s, with the error outside its window */
    uint32_t running;            /* 1: controlled in the last period */
    float omega_ref, torque;     /* rad/s, N m: handed to the speed controller until its next step */
    uint32_t homing_started;     /* start as it was at the last step */
    int32_t homing_turns;        /* turns of the encoder at the last step */
    float pushed;                /* s, with the torque of a stop */
    uint32_t unreferenced;       /* of the last reading */
    uint32_t indexed;            /* 1: the encoder has got its reference since the homing began */
} pmsm_position;

typedef struct pmsm_application {
    const pmsm_params *params;          /* active set */
    const uint32_t *lut;                /* its table words, NULL without */
    uint8_t *trace;                     /* of the recorder: sample-interleaved little-endian binary32 */
    const float *buffer;                /* of the excitation's buffer shape */
    uint32_t trace_bytes, buffer_length; /* 0: none */
    pmsm_state control;
    pmsm_reference reference;           /* what is asked for */
    pmsm_excitation excitation;
    pmsm_recorder recorder;
    pmsm_average average;
    pmsm_position position;
    pmsm_sensors sensors;               /* as sampled in the last period */
    uint32_t enabled;                   /* 1: operation enabled, 0: gates off */
    uint32_t quick_stop;                /* 1: ramp the current reference to zero and brake */
    uint32_t trip;                      /* enum pmsm_trip, latched */
    float fixed_angle;                  /* NaN: frame follows the rotor; else frozen electrical angle */
    pmsm_reference applied;             /* reference of the last period, excitation included */
    float applied_angle;                /* rad, fixed frame angle of the last period, NaN when it followed the rotor */
    /* private memory */
    pmsm_speed_estimate speed;
    pmsm_hall hall;
    pmsm_wave wave;
    pmsm_recorder_memory recording;
    pmsm_average_memory averaging;
    pmsm_quick_stop stopping;
} pmsm_application;

/* Clear everything and take a parameter set, which stays where it is. Afterwards set trace and buffer, if there are. */
PMSM_EXPORT void pmsm_application_init(pmsm_application *app, const pmsm_params *params, const uint32_t *lut);
/* Parameters in RAM changed: keep the memory, renew what was derived from them. */
PMSM_EXPORT void pmsm_application_parameters_changed(pmsm_application *app);
PMSM_EXPORT void pmsm_application_reset_fault(pmsm_application *app);
/* One PWM period: sensors in, duty ratios out. */
PMSM_EXPORT void pmsm_application_period(pmsm_application *app, const pmsm_sensors *sensors, pmsm_output *output);
/* Value of a signal as it would be recorded now. */
PMSM_EXPORT float pmsm_application_signal(const pmsm_application *app, uint32_t signal);

#ifdef __cplusplus
}
#endif

#endif
