/* SPDX-License-Identifier: MIT */
/* Contours of constant torque in the domain of a machine, each from its point of least current. */
#ifndef PMSM_TORQUE_CONTOUR_H
#define PMSM_TORQUE_CONTOUR_H

#include "current_plane.h"

#include <stdint.h>

#define PMSM_LOCUS_RADII 40
#define PMSM_CONTOUR_NODES 160
#define PMSM_CONTOUR_STEP 0.05 /* of I_max */

typedef struct {             /* least current per torque, one sign of torque */
    int32_t n;
    pmsm_point at[PMSM_LOCUS_RADII + 2];
} pmsm_locus;

typedef struct {             /* one side of a torque contour, from its start */
    int32_t n;
    int32_t traced;
    int32_t rising;          /* 1: the current falls nowhere along it, as on every machine but the oddly saturated */
    pmsm_point at[PMSM_CONTOUR_NODES];
} pmsm_branch;

typedef struct {
    const pmsm_plane *plane;
    pmsm_border border;
    pmsm_point bound[2];     /* least and largest torque of the domain, whatever the voltage */
    pmsm_locus least[2];     /* negative, positive torque */
} pmsm_contours;

typedef struct {
    pmsm_curve curve;
    pmsm_point start;
    double first_length;     /* signed step of side 0 */
    pmsm_branch side[2];
} pmsm_contour;

/* What all contours of a machine start from. */
void pmsm_contours_prepare(const pmsm_plane *plane, pmsm_contours *all);

/* The contour of a torque level T at its point of least current, not yet traced; 0: no such point in the domain. */
int32_t pmsm_contour_start(const pmsm_contours *all, double T, pmsm_contour *c);

/* Trace one side by steps of a signed length, to the edge of the domain. */
void pmsm_contour_trace(pmsm_contour *c, int32_t which, double length);

#endif
