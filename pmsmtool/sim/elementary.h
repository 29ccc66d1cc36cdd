/* SPDX-License-Identifier: MIT */
/* Elementary functions in double from +, -, *, / and the square root alone.
 *
 * The bytes of a simulation must not depend on the C library, whose sin, exp and log differ in the
 * last bit between systems. Taylor series on reduced arguments, summed in pairs of terms, which a
 * processor works on side by side. Measured against extended precision in tests/sim/test_elementary.py,
 * in half units of the last place: sin and cos 1.5 (of 1), exp 1.3, log 2, atan 1.5, tanh 14 (at 0.01).
 */
#ifndef PMSM_ELEMENTARY_H
#define PMSM_ELEMENTARY_H

#include <math.h> /* sqrt only: correctly rounded everywhere */
#include <stdint.h>
#include <string.h>

#define PMSM_REAL64_PI 3.14159265358979323846
#define PMSM_REAL64_TWO_PI 6.28318530717958647693

/* Arguments beyond this are reduced with a visible error; electrical angles stay below 64 pi. */
#define PMSM_REAL64_SINCOS_MAX 1.0e6

/* Largest argument of pmsm_real64_sincos_small: its series end below 3e-17 there. */
#define PMSM_REAL64_SINCOS_SMALL_MAX 0.4

/* sin, cos for |x| <= pi/4: first omitted terms 8e-20 and 2e-18. */
static inline void pmsm_real64_sincos_kernel(double x, double *s, double *c)
{
    const double z = x * x, z2 = z * z, z4 = z2 * z2;
    const double s0 = -1.0 / 6.0 + z * (1.0 / 120.0), s2 = -1.0 / 5040.0 + z * (1.0 / 362880.0);
    const double s4 = -1.0 / 39916800.0 + z * (1.0 / 6227020800.0);
    const double s6 = -1.0 / 1307674368000.0 + z * (1.0 / 355687428096000.0);
    const double c0 = -0.5 + z * (1.0 / 24.0), c2 = -1.0 / 720.0 + z * (1.0 / 40320.0);
    const double c4 = -1.0 / 3628800.0 + z * (1.0 / 479001600.0);
    const double c6 = -1.0 / 87178291200.0 + z * (1.0 / 20922789888000.0);
    *s = x + x * (z * ((s0 + z2 * s2) + z4 * (s4 + z2 * s6)));
    *c = 1.0 + z * ((c0 + z2 * c2) + z4 * (c4 + z2 * c6));
}

/* sin, cos for |x| <= PMSM_REAL64_SINCOS_SMALL_MAX. */
static inline void pmsm_real64_sincos_small(double x, double *s, double *c)
{
    const double z = x * x, z2 = z * z, z4 = z2 * z2;
    const double s0 = -1.0 / 6.0 + z * (1.0 / 120.0), s2 = -1.0 / 5040.0 + z * (1.0 / 362880.0);
    const double s4 = -1.0 / 39916800.0 + z * (1.0 / 6227020800.0);
    const double c0 = -0.5 + z * (1.0 / 24.0), c2 = -1.0 / 720.0 + z * (1.0 / 40320.0);
    const double c4 = -1.0 / 3628800.0 + z * (1.0 / 479001600.0);
    *s = x + x * (z * ((s0 + z2 * s2) + z4 * s4));
    *c = 1.0 + z * ((c0 + z2 * c2) + z4 * c4);
}

/* sin, cos for |x| <= PMSM_REAL64_SINCOS_MAX. */
static inline void pmsm_real64_sincos(double x, double *s, double *c)
{
    /* pi/2 in two parts: the first has 32 significant bits, so k times it is exact */
    const double half_pi_high = 1.5707963267341256, half_pi_low = 6.077100506506192e-11;
    const double q = x * 0.63661977236758134308;
    const int64_t k = (int64_t)(q < 0.0 ? q - 0.5 : q + 0.5);
    const double dk = (double)k;
    const double r = (x - dk * half_pi_high) - dk * half_pi_low;
    double sr, cr;
    pmsm_real64_sincos_kernel(r, &sr, &cr);
    if (k & 1) {
        const double swap = sr;
        sr = cr;
        cr = -swap;
    }
    *s = (k & 2) ? -sr : sr;
    *c = (k & 2) ? -cr : cr;
}

static inline double pmsm_real64_abs(double x)
{
    return x < 0.0 ? -x : x;
}

/* exp for x <= 700; 0 below -700. */
static inline double pmsm_real64_exp(double x)
{
    const double ln2_high = 0.6931471804855391, ln2_low = 7.440617110012397e-11;
    if (!(x > -700.0))
        return x != x ? x : 0.0;
    const double q = x * 1.44269504088896340736;
    const int64_t k = (int64_t)(q < 0.0 ? q - 0.5 : q + 0.5);
    const double r = (x - (double)k * ln2_high) - (double)k * ln2_low;
    /* |r| <= 0.347: the first omitted term is r^14/14! = 4e-18 */
    const double r2 = r * r, r4 = r2 * r2, r8 = r4 * r4;
    const double p0 = 1.0 / 2.0 + r * (1.0 / 6.0), p2 = 1.0 / 24.0 + r * (1.0 / 120.0);
    const double p4 = 1.0 / 720.0 + r * (1.0 / 5040.0), p6 = 1.0 / 40320.0 + r * (1.0 / 362880.0);
    const double p8 = 1.0 / 3628800.0 + r * (1.0 / 39916800.0), p10 = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0);
    const double p = 1.0 + (r + r2 * (((p0 + r2 * p2) + r4 * (p4 + r2 * p6)) + r8 * (p8 + r2 * p10)));
    const uint64_t bits = (uint64_t)(k + 1023) << 52;
    double scale;
    memcpy(&scale, &bits, sizeof scale);
    return p * scale;
}

/* Natural logarithm of a positive normal number. */
static inline double pmsm_real64_log(double x)
{
    uint64_t bits;
    double m;
    memcpy(&bits, &x, sizeof bits);
    int64_t k = (int64_t)(bits >> 52) - 1023;
    bits = (bits & 0xFFFFFFFFFFFFFu) | 0x3FF0000000000000u;
    memcpy(&m, &bits, sizeof m);
    if (m > 1.41421356237309514547) {
        m *= 0.5;
        k += 1;
    }
    /* log m = 2 atanh f, |f| <= 0.1716: the first omitted term is f^21/21 = 4e-18 */
    const double f = (m - 1.0) / (m + 1.0), z = f * f;
    const double p = z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0
                   + z * (1.0 / 13.0 + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0)))))))));
    return (double)k * 0.6931471804855391 + ((double)k * 7.440617110012397e-11 + 2.0 * (f + f * p));
}

static inline double pmsm_real64_tanh(double x)
{
    const double a = pmsm_real64_abs(x);
    if (a < 0.01) { /* the difference below would lose digits; first omitted term 4e-16 of x */
        const double z = x * x;
        return x * (1.0 + z * (-1.0 / 3.0 + z * (2.0 / 15.0 + z * (-17.0 / 315.0 + z * (62.0 / 2835.0)))));
    }
    if (a > 19.0) /* e below is less than half a unit in the last place of 1 */
        return x < 0.0 ? -1.0 : 1.0;
    const double e = pmsm_real64_exp(-2.0 * a), t = (1.0 - e) / (1.0 + e);
    return x < 0.0 ? -t : t;
}

static inline double pmsm_real64_atan(double x)
{
    /* from the nearest of 0, 1, 2, 3, 4 times pi/8, with one division: |t| <= tan(pi/16) = 0.199 */
    const double a = pmsm_real64_abs(x), eighth = 0.41421356237309504880, three = 2.41421356237309504880;
    double from, t;
    if (a < 0.19891236737965800691) {
        from = 0.0;
        t = a;
    } else if (a < 0.66817863791929891999) {
        from = 0.125 * PMSM_REAL64_PI;
        t = (a - eighth) / (1.0 + a * eighth);
    } else if (a < 1.49660576266548901760) {
        from = 0.25 * PMSM_REAL64_PI;
        t = (a - 1.0) / (a + 1.0);
    } else if (a < 5.02733949212584810451) {
        from = 0.375 * PMSM_REAL64_PI;
        t = (a - three) / (1.0 + a * three);
    } else {
        from = 0.5 * PMSM_REAL64_PI;
        t = -1.0 / a;
    }
    const double z = t * t, z2 = z * z, z4 = z2 * z2; /* the first omitted term is 3e-18 */
    const double p0 = -1.0 / 3.0 + z * (1.0 / 5.0), p2 = -1.0 / 7.0 + z * (1.0 / 9.0);
    const double p4 = -1.0 / 11.0 + z * (1.0 / 13.0), p6 = -1.0 / 15.0 + z * (1.0 / 17.0);
    const double p8 = -1.0 / 19.0 + z * (1.0 / 21.0);
    const double angle = from + (t + t * (z * (((p0 + z2 * p2) + z4 * (p4 + z2 * p6)) + z4 * z4 * p8)));
    return x < 0.0 ? -angle : angle;
}

#endif
