/* SPDX-License-Identifier: MIT */
/* What the drive gets to see of the machine: currents, DC link, angle, temperatures, each with its faults.
 *
 * A current sample is  gain (i through a first-order lag) + offset + noise, clipped to the full scale and rounded to
 * the ADC's grid. All random numbers come from one seeded generator in here, so that equal seeds give
 * equal bytes on every platform.
 */
#ifndef PMSM_SENSORS_H
#define PMSM_SENSORS_H

#include <stdint.h>

typedef struct {
    double gain[3], offset[3];   /* 1, A */
    double noise;                /* A rms, white, each phase */
    double full_scale;           /* A, 0: no clipping and no grid */
    uint32_t adc_bits;           /* 0: no grid */
    uint32_t encoder_bits;       /* per mechanical turn, 0: no grid */
    double U_dc_gain;
    double encoder_offset_e;     /* rad electrical: theta_e = direction p theta_M - offset */
    uint32_t encoder_reversed;
    uint32_t fault;              /* enum pmsm_sensor_fault */
    double encoder_latency;      /* s */
    double encoder_once, encoder_twice; /* rad mechanical: error amplitudes per turn and per half turn */
    double encoder_line, encoder_line_twice; /* rad mechanical: error amplitudes per line and per half line */
    double encoder_lines;        /* lines of the encoder per turn, between which it interpolates */
    double encoder_noise;        /* rad mechanical rms, white, before the grid */
    double T_lag;                /* s, of the temperature sensor, 0: none */
    double blind;                /* s: shortest low-side pulse a shunt can read, 0: in-phase sensors */
    double cubic;                /* share of the full scale at full scale: gain i + cubic i^3 / full_scale^2 */
    double drift;                /* A/s, offset of phase a; that of b drifts against it */
    double hall_axis[3];         /* rad electrical: middle of the half turn in which a Hall wire is high */
    uint32_t hall;               /* 1: there are Hall sensors */
    uint32_t encoder;            /* enum pmsm_sensor_encoder */
} pmsm_sensor_setup;

enum pmsm_sensor_encoder {
    PMSM_SENSOR_ABSOLUTE = 0,
    PMSM_SENSOR_INDEX,           /* counts from where it was switched on until its first index */
    PMSM_SENSOR_NO_ENCODER
};

enum pmsm_sensor_fault {
    PMSM_SENSOR_OK = 0,
    PMSM_SENSOR_ENCODER_STUCK    /* the encoder keeps its first reading */
};

typedef struct {
    uint64_t word[4];            /* xoshiro256++ */
    double spare;                /* second number of the last normal pair */
    uint32_t has_spare;
} pmsm_random;

/* 1: a current sample is the current itself. */
static inline int pmsm_sensor_is_ideal(const pmsm_sensor_setup *s)
{
    return s->noise == 0.0 && s->full_scale == 0.0 && s->gain[0] == 1.0 && s->gain[1] == 1.0 && s->gain[2] == 1.0
           && s->offset[0] == 0.0 && s->offset[1] == 0.0 && s->offset[2] == 0.0 && s->drift == 0.0;
}

void pmsm_random_seed(pmsm_random *random, uint64_t seed);
/* Uniform in [0, 1), 53 bits. */
double pmsm_random_uniform(pmsm_random *random);
/* Standard normal. */
double pmsm_random_normal(pmsm_random *random);

/* One current sample of phase x; *clipped is set when it stood at full scale. */
double pmsm_sensor_current(const pmsm_sensor_setup *setup, pmsm_random *random, int x, double i, uint32_t *clipped);

/* Encoder position (rad mechanical, unwrapped) of the rotor at theta_M turning at omega_M. */
double pmsm_sensor_angle(const pmsm_sensor_setup *setup, pmsm_random *random, double theta_M, double omega_M,
                         double pole_pairs);

/* Levels of the Hall wires, bit k of wire k, at an electrical angle; 0 without sensors. */
uint32_t pmsm_sensor_hall(const pmsm_sensor_setup *setup, double theta_e);

#endif
