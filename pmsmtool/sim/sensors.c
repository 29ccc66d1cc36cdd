/* SPDX-License-Identifier: MIT */
/* Sensors and the random numbers of the simulated drive; see sensors.h. */
#include "sensors.h"

#include "elementary.h"

/* ---- random numbers ------------------------------------------------------------------------------
 * xoshiro256++ seeded by splitmix64: Blackman, Vigna, "Scrambled linear pseudorandom number generators",
 * ACM TOMS 47 (2021), DOI 10.1145/3460772. Normal numbers by Marsaglia's polar method, SIAM Review 6 (1964),
 * DOI 10.1137/1006063. */

static uint64_t rotated(uint64_t x, int k)
{
    return (x << k) | (x >> (64 - k));
}

void pmsm_random_seed(pmsm_random *random, uint64_t seed)
{
    for (int j = 0; j < 4; j++) {
        seed += 0x9E3779B97F4A7C15u;
        uint64_t z = seed;
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        random->word[j] = z ^ (z >> 31);
    }
    random->has_spare = 0;
    random->spare = 0.0;
}

static uint64_t next_word(pmsm_random *random)
{
    uint64_t *s = random->word;
    const uint64_t result = rotated(s[0] + s[3], 23) + s[0], t = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = rotated(s[3], 45);
    return result;
}

double pmsm_random_uniform(pmsm_random *random)
{
    return (double)(next_word(random) >> 11) * (1.0 / 9007199254740992.0);
}

double pmsm_random_normal(pmsm_random *random)
{
    if (random->has_spare) {
        random->has_spare = 0;
        return random->spare;
    }
    for (;;) {
        const double x = 2.0 * pmsm_random_uniform(random) - 1.0, y = 2.0 * pmsm_random_uniform(random) - 1.0;
        const double r2 = x * x + y * y;
        if (r2 > 0.0 && r2 < 1.0) {
            const double k = sqrt(-2.0 * pmsm_real64_log(r2) / r2);
            random->spare = k * y;
            random->has_spare = 1;
            return k * x;
        }
    }
}

/* ---- sensors ------------------------------------------------------------------------------------------ */

/* Nearest integer, halves upwards; without a branch, which noise would make unforeseeable. */
static inline double nearest(double x)
{
    const double whole = (double)(int64_t)x;
    const double down = whole - (whole > x ? 1.0 : 0.0);
    return down + (x - down >= 0.5 ? 1.0 : 0.0);
}

double pmsm_sensor_current(const pmsm_sensor_setup *setup, pmsm_random *random, int x, double i, uint32_t *clipped)
{
    double value = setup->gain[x] * i + setup->offset[x];
    if (setup->cubic != 0.0 && setup->full_scale > 0.0)
        value += setup->cubic * i * (i / setup->full_scale) * (i / setup->full_scale);
    if (setup->noise > 0.0)
        value += setup->noise * pmsm_random_normal(random);
    if (!(setup->full_scale > 0.0))
        return value;
    if (setup->adc_bits == 0) {
        if (pmsm_real64_abs(value) < setup->full_scale)
            return value;
        *clipped = 1;
        return value > 0.0 ? setup->full_scale : -setup->full_scale;
    }
    const double half = (double)((uint64_t)1 << (setup->adc_bits - 1)), lsb = setup->full_scale / half;
    if (!(pmsm_real64_abs(value) < 2.0 * setup->full_scale)) /* keeps the cast below in range */
        value = value > 0.0 ? 2.0 * setup->full_scale : -2.0 * setup->full_scale;
    double code = nearest(value / lsb);
    if (code >= half - 1.0) {
        code = half - 1.0;
        *clipped = 1;
    } else if (code <= -half) {
        code = -half;
        *clipped = 1;
    }
    return code * lsb;
}

double pmsm_sensor_angle(const pmsm_sensor_setup *setup, pmsm_random *random, double theta_M, double omega_M,
                         double pole_pairs)
{
    double theta = theta_M - omega_M * setup->encoder_latency;
    if (setup->encoder_offset_e != 0.0)
        theta += setup->encoder_offset_e / pole_pairs;
    if (setup->encoder_once != 0.0 || setup->encoder_twice != 0.0) {
        double s, c, turn = theta_M / PMSM_REAL64_TWO_PI;
        turn -= nearest(turn);
        pmsm_real64_sincos(PMSM_REAL64_TWO_PI * turn, &s, &c);
        theta += setup->encoder_once * s + setup->encoder_twice * 2.0 * s * c;
    }
    if (setup->encoder_line != 0.0 || setup->encoder_line_twice != 0.0) {
        double s, c, line = setup->encoder_lines * theta_M / PMSM_REAL64_TWO_PI;
        line -= nearest(line);
        pmsm_real64_sincos(PMSM_REAL64_TWO_PI * line, &s, &c);
        theta += setup->encoder_line * s + setup->encoder_line_twice * 2.0 * s * c;
    }
    if (setup->encoder_noise > 0.0)
        theta += setup->encoder_noise * pmsm_random_normal(random);
    if (setup->encoder_reversed)
        theta = -theta;
    if (setup->encoder_bits > 0) {
        const double step = PMSM_REAL64_TWO_PI / (double)((uint64_t)1 << setup->encoder_bits);
        theta = nearest(theta / step) * step;
    }
    return theta;
}

uint32_t pmsm_sensor_hall(const pmsm_sensor_setup *setup, double theta_e)
{
    uint32_t pattern = 0;
    for (uint32_t k = 0; setup->hall != 0 && k < 3; k++) {
        double s, c, turn = (theta_e - setup->hall_axis[k]) / PMSM_REAL64_TWO_PI;
        turn -= nearest(turn);
        pmsm_real64_sincos(PMSM_REAL64_TWO_PI * turn, &s, &c);
        pattern |= (c >= 0.0 ? 1u : 0u) << k;
    }
    return pattern;
}
