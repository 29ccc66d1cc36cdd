/* SPDX-License-Identifier: MIT */
/* Arithmetic of the core: square root, sine and cosine, small vector helpers. Internal.
 *
 * Nothing here needs a libm: the square root is the correctly rounded machine instruction, sine and cosine are
 * polynomials of our own, so every target gives the same bits.
 */
#ifndef PMSM_MATH_H
#define PMSM_MATH_H

#include "pmsm_types.h"

#ifndef PMSM_SQRT /* a target without the instruction may name its own correctly rounded root */
#ifdef PMSM_REAL_DOUBLE
#define PMSM_SQRT(x) __builtin_sqrt(x)
#else
#define PMSM_SQRT(x) __builtin_sqrtf(x)
#endif
#endif

#define PMSM_PI PMSM_C(3.14159265358979323846)
#define PMSM_SQRT3 PMSM_C(1.73205080756887729353)
#define PMSM_RPM (PMSM_C(30.0) / PMSM_PI) /* rpm per rad/s */
#define PMSM_ANGLE_MAX PMSM_C(4000.0)     /* rad; up to here the argument reduction below is exact */

/* pi/2 in pieces whose products with the quadrant number are exact (Cody-Waite). */
#ifdef PMSM_REAL_DOUBLE
#define PMSM_PIO2_A 1.5707963267923332750797271728515625
#define PMSM_PIO2_B 2.56334415159451878818894209858469968755e-12
#define PMSM_PIO2_C 0.0
#else
#define PMSM_PIO2_A 1.570556640625F
#define PMSM_PIO2_B 0.000239670276641845703125F
#define PMSM_PIO2_C 1.5893254773528196692e-8F
#endif

static inline pmsm_real pmsm_min(pmsm_real x, pmsm_real y)
{
    return (x < y) ? x : y;
}

static inline pmsm_real pmsm_max(pmsm_real x, pmsm_real y)
{
    return (x > y) ? x : y;
}

static inline int32_t pmsm_nearest(pmsm_real x)
{
    return (int32_t)(x + ((x < PMSM_C(0.0)) ? PMSM_C(-0.5) : PMSM_C(0.5)));
}

/* Quarter turns nearest to x, and the rest in [-pi/4, pi/4]. |x| <= PMSM_ANGLE_MAX. */
static inline int32_t pmsm_quadrant(pmsm_real x, pmsm_real *rest)
{
    const int32_t k = pmsm_nearest(x * PMSM_C(0.63661977236758134308));
    const pmsm_real n = (pmsm_real)k;
    *rest = ((x - n * PMSM_PIO2_A) - n * PMSM_PIO2_B) - n * PMSM_PIO2_C;
    return k;
}

/* Sine and cosine; absolute error below 1.2e-7 (float) and 3e-16 (double). |x| <= PMSM_ANGLE_MAX. */
static inline void pmsm_sincos(pmsm_real x, pmsm_real *sine, pmsm_real *cosine)
{
    pmsm_real r;
    const int32_t k = pmsm_quadrant(x, &r);
    const pmsm_real z = r * r;
#ifdef PMSM_REAL_DOUBLE /* Taylor, the first term left out is below 5e-17 and 3e-18 */
    const pmsm_real s =
        r + r * z * (-1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0 +
            z * (-1.0 / 39916800.0 + z * (1.0 / 6227020800.0 + z * (-1.0 / 1307674368000.0 +
            z * (1.0 / 355687428096000.0))))))));
    const pmsm_real c =
        1.0 - 0.5 * z + z * z * (1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40320.0 + z * (-1.0 / 3628800.0 +
            z * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0 + z * (1.0 / 20922789888000.0)))))));
#else /* near-minimax on [-pi/4, pi/4], 1.8e-9 and 1e-10 before rounding */
    const pmsm_real s = r + r * z * (-0.16666651F + z * (0.00833197F + z * -0.00019495F));
    const pmsm_real c = 1.0F - 0.5F * z + z * z * (0.0416666467F + z * (-0.00138873614F + z * 2.443773e-5F));
#endif
    const pmsm_real first = ((k & 1) != 0) ? c : s;
    const pmsm_real second = ((k & 1) != 0) ? s : c;
    *sine = ((k & 2) != 0) ? -first : first;
    *cosine = (((k + 1) & 2) != 0) ? -second : second;
}

/* Arc tangent of y/x, in (-pi/2, pi/2]; absolute error below 3e-7 (float) and 1e-15 (double). 0 when both are 0. */
static inline pmsm_real pmsm_arctan(pmsm_real y, pmsm_real x)
{
    const pmsm_real size_x = (x < PMSM_C(0.0)) ? -x : x;
    const pmsm_real size_y = (y < PMSM_C(0.0)) ? -y : y;
    const pmsm_real large = pmsm_max(size_x, size_y);
    if (large <= PMSM_C(0.0)) {
        return PMSM_C(0.0);
    }
    pmsm_real t = pmsm_min(size_y, size_x) / large;
#ifdef PMSM_REAL_DOUBLE /* two half-angle steps bring t below tan(pi/16); the series ends below 1e-17 */
    t = t / (1.0 + PMSM_SQRT(1.0 + t * t));
    t = t / (1.0 + PMSM_SQRT(1.0 + t * t));
    const double z = t * t;
    double series = 1.0 / 23.0;
    for (int32_t k = 21; k > 0; k -= 2) {
        series = 1.0 / (double)k - z * series;
    }
    pmsm_real angle = 4.0 * t * series;
#else /* near-minimax on [0, 1], 6e-9 before rounding */
    const float z = t * t;
    pmsm_real angle = t * (0.99999989F + z * (-0.33332597F + z * (0.19985907F + z * (-0.14161229F + z * (0.10498946F +
                          z * (-0.07234858F + z * (0.03978123F + z * (-0.01440136F + z * 0.00245673F))))))));
#endif
    angle = (size_x > size_y) ? angle : PMSM_C(0.5) * PMSM_PI - angle;
    return ((y < PMSM_C(0.0)) != (x < PMSM_C(0.0))) ? -angle : angle;
}

/* 1 - exp(-x) for x >= 0, from a series that stays between 0 and 1; 1e-3 off at x = 0.5. */
static inline pmsm_real pmsm_filter_weight(pmsm_real x)
{
    return PMSM_C(1.0) - PMSM_C(1.0) / (PMSM_C(1.0) + x * (PMSM_C(1.0) + x * (PMSM_C(0.5) + x / PMSM_C(6.0))));
}

/* The same angle in [-pi, pi). |x| <= PMSM_ANGLE_MAX. */
static inline pmsm_real pmsm_wrap(pmsm_real x)
{
    const pmsm_real n = PMSM_C(4.0) * (pmsm_real)pmsm_nearest(x * PMSM_C(0.15915494309189533577));
    const pmsm_real y = ((x - n * PMSM_PIO2_A) - n * PMSM_PIO2_B) - n * PMSM_PIO2_C;
    if (y >= PMSM_PI) {
        return y - PMSM_C(2.0) * PMSM_PI;
    }
    return (y < -PMSM_PI) ? y + PMSM_C(2.0) * PMSM_PI : y;
}

static inline pmsm_real pmsm_abs(pmsm_real x)
{
#ifdef PMSM_REAL_DOUBLE /* one instruction; a comparison and a branch otherwise */
    return __builtin_fabs(x);
#else
    return __builtin_fabsf(x);
#endif
}

static inline pmsm_real pmsm_clamp(pmsm_real x, pmsm_real low, pmsm_real high)
{
    return (x < low) ? low : ((x > high) ? high : x);
}

static inline pmsm_real pmsm_square(pmsm_dq x)
{
    return x.d * x.d + x.q * x.q;
}

static inline uint32_t pmsm_is_within(pmsm_dq x, pmsm_real radius)
{
    return (pmsm_square(x) <= radius * radius) ? 1u : 0u;
}

/* Stator frame -> frame at the angle of (sine, cosine). */
static inline pmsm_dq pmsm_park(pmsm_ab x, pmsm_real sine, pmsm_real cosine)
{
    pmsm_dq y;
    y.d = cosine * x.alpha + sine * x.beta;
    y.q = cosine * x.beta - sine * x.alpha;
    return y;
}

static inline pmsm_ab pmsm_park_inverse(pmsm_dq x, pmsm_real sine, pmsm_real cosine)
{
    pmsm_ab y;
    y.alpha = cosine * x.d - sine * x.q;
    y.beta = sine * x.d + cosine * x.q;
    return y;
}

/* Amplitude-invariant Clarke transform; a common mode drops out. */
static inline pmsm_ab pmsm_clarke(pmsm_abc x)
{
    pmsm_ab y;
    y.alpha = (PMSM_C(2.0) * x.a - x.b - x.c) * (PMSM_C(1.0) / PMSM_C(3.0));
    y.beta = (x.b - x.c) * (PMSM_C(1.0) / PMSM_SQRT3);
    return y;
}

static inline pmsm_abc pmsm_clarke_inverse(pmsm_ab x)
{
    pmsm_abc y;
    y.a = x.alpha;
    y.b = PMSM_C(-0.5) * x.alpha + (PMSM_C(0.5) * PMSM_SQRT3) * x.beta;
    y.c = PMSM_C(-0.5) * x.alpha - (PMSM_C(0.5) * PMSM_SQRT3) * x.beta;
    return y;
}

#endif
