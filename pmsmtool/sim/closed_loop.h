/* SPDX-License-Identifier: MIT */
/* The closed loop: sample, drive application, computation delay, inverter, machine; N periods in one call.
 *
 * Period k starts at t_k. Currents and angle are sampled there (the currents sampling_shift later or
 * earlier), the application computes duty ratios from them, and these act on [t_k, t_k+1) with delay 0.5, on
 * [t_k+1, t_k+2) with delay 1.5. Between two calls nothing moves, and nothing here reads a clock.
 * The caller owns all memory: the pmsm_sim, the pmsm_drive behind it, schedules and the record.
 */
#ifndef PMSM_CLOSED_LOOP_H
#define PMSM_CLOSED_LOOP_H

#include <stdint.h>

#include "drive.h"
#include "inverter.h"
#include "plant.h"
#include "sensors.h"

#define PMSM_DELAY_MAX 3u      /* whole periods of computation delay */
#define PMSM_RECORD_SIGNALS 64u

enum pmsm_runs {
    PMSM_RUNS_APPLICATION = 0, /* the drive's whole firmware: speed estimate, trips, excitation, recorder */
    PMSM_RUNS_CORE = 1   /* pmsm_step() alone, with the exact speed; starts out of zero voltage, gates released */
};

/* Piecewise linear functions of time; two nodes at one time make a step. */
enum pmsm_target {
    PMSM_TARGET_I_D = 0,       /* A peak */
    PMSM_TARGET_I_Q,           /* A peak */
    PMSM_TARGET_TORQUE,        /* N m */
    PMSM_TARGET_SPEED,         /* rad/s mechanical: reference of the speed controller */
    PMSM_TARGET_LOAD,          /* N m */
    PMSM_TARGET_DRIVEN_SPEED,  /* rad/s mechanical: imposed on a driven rotor */
    PMSM_TARGET_U_DC,          /* V */
    PMSM_TARGET_U_D,           /* V, voltage mode */
    PMSM_TARGET_U_Q,
    PMSM_TARGET_COUNT
};

typedef struct {
    const double *t;           /* s, not decreasing; null: not scheduled */
    const double *value;
    uint32_t n, cursor;
} pmsm_schedule;

/* Signals of the truth, beside enum pmsm_signal (numbers below 64) of the drive. */
enum pmsm_truth {
    PMSM_TRUTH_T = 64,         /* s, sampling instant */
    PMSM_TRUTH_I_D, PMSM_TRUTH_I_Q, PMSM_TRUTH_I_A, PMSM_TRUTH_I_B, PMSM_TRUTH_I_C,
    PMSM_TRUTH_PSI_D, PMSM_TRUTH_PSI_Q, PMSM_TRUTH_PSI_ALPHA, PMSM_TRUTH_PSI_BETA,
    PMSM_TRUTH_THETA_E, PMSM_TRUTH_THETA_M, PMSM_TRUTH_OMEGA_M, PMSM_TRUTH_TORQUE, PMSM_TRUTH_LOAD,
    PMSM_TRUTH_U_DC, PMSM_TRUTH_T_WINDING, PMSM_TRUTH_T_MAGNET,
    PMSM_TRUTH_DUTY_A, PMSM_TRUTH_DUTY_B, PMSM_TRUTH_DUTY_C, PMSM_TRUTH_GATES, /* computed in this period */
    PMSM_TRUTH_U_ALPHA, PMSM_TRUTH_U_BETA, /* demanded in this period, after the limiter */
    PMSM_TRUTH_OMEGA_LOAD, PMSM_TRUTH_TWIST,
    PMSM_TRUTH_R,              /* ohm at the winding's temperature */
    PMSM_TRUTH_U_ALPHA_MEAN, PMSM_TRUTH_U_BETA_MEAN, /* V at the terminals, mean over the last period */
    PMSM_TRUTH_TRIP            /* latched trip code of the drive */
};

typedef struct {               /* everything that is fixed during a run */
    pmsm_machine machine;
    pmsm_inverter_setup inverter;
    pmsm_sensor_setup sensors;
    double U_dc, U_dc_ripple, U_dc_ripple_hz;
    double U_dc_source, U_dc_source_time; /* ohm of the supply, s of its resistance with the link's capacitor */
    double U_dc_capacitance;   /* F behind a supply that takes nothing back; 0: the supply holds the link */
    double U_dc_chopper, U_dc_chopper_ohm; /* V from which a brake chopper is on, 0 none; ohm, 0: it holds that voltage */
    double T_winding, T_magnet; /* degC at the start */
    double theta_M, omega_M;   /* at the start */
    double load;               /* N m */
    double sensor_lag;         /* s */
    double sampling_shift;     /* s, positive: late; late needs a whole period of delay */
    double iron_hidden;        /* share of the iron-loss current that no sample holds: at the zero vector none flows */
    uint64_t seed;
    uint32_t delay;            /* whole periods of computation delay, 0 or 1 (or more) */
    uint32_t application;      /* enum pmsm_runs */
    uint32_t T_s_ns;           /* PWM period; 0: as the drive's parameter says */
} pmsm_sim_setup;

#define PMSM_WATCHED 6u           /* states whose change ends a run early */

typedef struct pmsm_sim {
    pmsm_sim_setup setup;
    pmsm_drive *drive;
    pmsm_plant plant;
    pmsm_inverter inverter;
    pmsm_current_lag lag;
    pmsm_random random;
    uint32_t ideal;            /* 1: current samples are the currents */
    pmsm_schedule schedule[PMSM_TARGET_COUNT];
    uint32_t scheduled;        /* targets with a schedule, as bits */
    pmsm_output output;        /* of the last period */
    pmsm_output pending[PMSM_DELAY_MAX];
    double early[3];           /* A, currents caught before the period (negative sampling shift) */
    uint32_t has_early;
    double i_read[3];          /* A, last current a shunt could read */
    double U_dc;               /* V, of this period */
    double link_current;       /* A, that the supply gives */
    double link_charge;        /* V, of the link's capacitor */
    double T_winding_shown;    /* degC, of the lagging sensor */
    double encoder_held;       /* rad, reading of a stuck encoder */
    uint32_t encoder_is_held;
    double encoder_zero;       /* rad, where an encoder with an index was switched on */
    uint32_t encoder_on, encoder_indexed;
    uint64_t period, t_ns;
    /* record */
    double *record;
    uint64_t record_rows, record_row;
    uint32_t record_signals, record_decimation, record_count;
    uint32_t record_signal[PMSM_RECORD_SIGNALS];
    uint32_t watch;            /* 1: return when trip, excitation, recorder, averages, position, homing changed */
    uint32_t seen[PMSM_WATCHED];
    double switch_negative, switch_positive; /* rad, where the limit switches begin, when has_switches */
    uint32_t has_switches;
} pmsm_sim;

/* Sizes of the structs a caller mirrors or allocates, in the order of enum pmsm_layout. */
enum pmsm_layout {
    PMSM_LAYOUT_SIM = 0, PMSM_LAYOUT_DRIVE, PMSM_LAYOUT_SETUP, PMSM_LAYOUT_MACHINE, PMSM_LAYOUT_INVERTER,
    PMSM_LAYOUT_SENSORS, PMSM_LAYOUT_PARAMS, PMSM_LAYOUT_REFERENCE, PMSM_LAYOUT_EXCITATION,
    PMSM_LAYOUT_RECORDER, PMSM_LAYOUT_AVERAGE, PMSM_LAYOUT_FLUX_MAP, PMSM_LAYOUT_POSITION
};
PMSM_EXPORT uint32_t pmsm_sim_layout(uint32_t what);

/* Parts of a drive that a caller reads and writes between calls. */
enum pmsm_part {
    PMSM_PART_PARAMS = 0, PMSM_PART_LUT, PMSM_PART_REFERENCE, PMSM_PART_EXCITATION, PMSM_PART_RECORDER,
    PMSM_PART_AVERAGE, PMSM_PART_BUFFER, PMSM_PART_TRACE, PMSM_PART_ENABLED, PMSM_PART_QUICK_STOP,
    PMSM_PART_TRIP, PMSM_PART_FIXED_ANGLE, PMSM_PART_RECORDER_WRITE, PMSM_PART_LIVE, PMSM_PART_APPLICATION,
    PMSM_PART_POSITION, PMSM_PART_SPEED_INTEGRAL, PMSM_PART_FIELD_WEAKENING
};
PMSM_EXPORT void *pmsm_sim_part(pmsm_drive *drive, uint32_t part);

/* Machine at rest or at its speed, no current, time zero, everything else of the sim cleared. The drive was
 * initialised and has its parameters; its speed estimate starts on the machine's speed. */
PMSM_EXPORT void pmsm_sim_start(pmsm_sim *sim, pmsm_drive *drive, const pmsm_sim_setup *setup);

/* Run at most n periods; returns how many ran (fewer only with watch). */
PMSM_EXPORT uint64_t pmsm_sim_run(pmsm_sim *sim, uint64_t n);

PMSM_EXPORT void pmsm_sim_watch(pmsm_sim *sim, uint32_t watch);
PMSM_EXPORT void pmsm_sim_set_schedule(pmsm_sim *sim, uint32_t target, uint32_t n, const double *t, const double *value);
/* Rows of the given signals (enum pmsm_signal or pmsm_truth) every decimation periods from the next one on, until
 * rows are full. record holds rows * n doubles. */
PMSM_EXPORT void pmsm_sim_set_record(pmsm_sim *sim, double *record, uint64_t rows, uint32_t n, const uint32_t *signals,
                                     uint32_t decimation);
PMSM_EXPORT uint64_t pmsm_sim_recorded(const pmsm_sim *sim);
PMSM_EXPORT double pmsm_sim_signal(const pmsm_sim *sim, uint32_t signal);
PMSM_EXPORT uint64_t pmsm_sim_time_ns(const pmsm_sim *sim);

/* What may change between two calls of run. */
PMSM_EXPORT void pmsm_sim_set_load(pmsm_sim *sim, double load);
PMSM_EXPORT void pmsm_sim_set_rotor(pmsm_sim *sim, uint32_t rotor, double omega_M);
PMSM_EXPORT void pmsm_sim_set_open(pmsm_sim *sim, uint32_t a, uint32_t b, uint32_t c);
/* Limit switches at two angles of the shaft (rad, unwrapped). */
PMSM_EXPORT void pmsm_sim_set_switches(pmsm_sim *sim, double negative, double positive);
PMSM_EXPORT void pmsm_sim_set_U_dc(pmsm_sim *sim, double U_dc);
PMSM_EXPORT void pmsm_sim_set_temperatures(pmsm_sim *sim, double T_winding, double T_magnet);

/* Evaluations outside the flux map, and intervals left before their events were resolved. */
PMSM_EXPORT uint64_t pmsm_sim_outside_count(const pmsm_sim *sim);
PMSM_EXPORT uint64_t pmsm_sim_overrun_count(const pmsm_sim *sim);

/* The plant alone, for tests and for callers with their own inverter: n intervals of h seconds, each with the
 * stator-frame voltage u[2 k], u[2 k + 1]; i[2 k], i[2 k + 1] receive i_d, i_q at each interval's end. */
PMSM_EXPORT void pmsm_sim_drive_plant(pmsm_sim *sim, uint64_t n, double h, const double *u, double *i);

/* Elementary functions as the plant computes them, for tests: which 0 sin, 1 cos, 2 exp, 3 log, 4 tanh, 5 atan. */
PMSM_EXPORT double pmsm_sim_elementary(uint32_t which, double x);
/* n standard normal numbers of a seed. */
PMSM_EXPORT void pmsm_sim_normal(uint64_t seed, uint64_t n, double *out);

#endif
