/* SPDX-License-Identifier: MIT */
/* Types and build switches of the control core.
 *
 * The core is what a drive runs at every PWM period: portable C99, no allocation, no libm but the
 * correctly rounded square root, one operation order, so that host, simulator and target give the
 * same bits (compile with -ffp-contract=off). Amplitude-invariant (peak) dq quantities, SI,
 * electrical angle.
 */
#ifndef PMSM_TYPES_H
#define PMSM_TYPES_H

#include <stdint.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "without -ffast-math and -Ofast: they remove the checks that find samples which are not a number"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#ifdef PMSM_REAL_DOUBLE
typedef double pmsm_real;
#define PMSM_C(x) (x)
#else
typedef float pmsm_real; /* as flashed */
#define PMSM_C(x) (x##F)
#endif

#if defined(_WIN32) && defined(PMSM_SHARED)
#define PMSM_EXPORT __declspec(dllexport)
#elif defined(__GNUC__) && defined(PMSM_SHARED)
#define PMSM_EXPORT __attribute__((visibility("default")))
#else
#define PMSM_EXPORT
#endif

typedef struct {
    pmsm_real d;
    pmsm_real q;
} pmsm_dq;

typedef struct {
    pmsm_real alpha;
    pmsm_real beta;
} pmsm_ab;

typedef struct {
    pmsm_real a;
    pmsm_real b;
    pmsm_real c;
} pmsm_abc;

#ifdef __cplusplus
}
#endif

#endif
