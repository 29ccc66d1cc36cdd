/* SPDX-License-Identifier: MIT */
/* The current plane of one machine: torque, flux and voltage at a point, and curves through it.
 *
 * Amplitude-invariant dq quantities, SI; t = psi_d i_q - psi_q i_d is the torque over 1.5 p. At electrical
 * speed w the squared voltage of a steady state is
 *
 *     |v|^2 = R^2 |i|^2 + 2 R w t + w^2 |psi|^2,
 *
 * so along a curve of constant torque it depends on |i|^2 and |psi|^2 only.
 *
 * The domain is the disc |i| <= I_max cut by the rectangle of the flux map and by i_d >= i_d_min.
 */
#ifndef PMSM_CURRENT_PLANE_H
#define PMSM_CURRENT_PLANE_H

#include "flux_map.h"

#include <stdint.h>

typedef struct pmsm_plane {
    const pmsm_flux_map *map;  /* null: constant machine */
    const pmsm_flux_map *loss; /* null: copper loss only; else (c_h, c_e): P_fe = c_h f + c_e f^2 */
    double R;                  /* ohm */
    double pole_pairs;
    double L_d, L_q, psi_f;    /* H, H, Wb; constant machine only */
    double psi_shift;          /* Wb, added to psi_d of the map (magnet temperature) */
    double I_max;              /* A peak */
    double i_d_min;            /* A, demagnetisation limit; -infinity when there is none */
} pmsm_plane;

enum pmsm_limit { /* bits: which limits a point touches */
    PMSM_LIMIT_CURRENT = 1,
    PMSM_LIMIT_VOLTAGE = 2,
    PMSM_LIMIT_DEMAGNETISATION = 4,
    PMSM_LIMIT_MAP = 8,
    PMSM_LIMIT_TORQUE_CUT = 16, /* the wanted torque lies outside; the point is the nearest torque */
    PMSM_LIMIT_NONE = 32        /* no admissible point at all */
};

typedef struct {
    double d_low, d_high, q_low, q_high; /* A; infinite where nothing limits */
    int32_t d_low_limit;                 /* PMSM_LIMIT_DEMAGNETISATION or PMSM_LIMIT_MAP */
} pmsm_rectangle;

typedef struct {
    double d, q;         /* A */
    double t, t_d, t_q;  /* torque / (1.5 p) and its gradient */
    double h;            /* |i|^2 */
    double g, g_d, g_q;  /* |psi|^2 and its gradient */
} pmsm_point;

/* Flux (Wb) and Jacobian (H), as pmsm_flux_map_flux. */
void pmsm_plane_flux(const pmsm_plane *plane, double d, double q, double psi[2], double jac[4]);
void pmsm_plane_at(const pmsm_plane *plane, double d, double q, pmsm_point *at);
pmsm_rectangle pmsm_plane_rectangle(const pmsm_plane *plane);

/* Whether torque rises with i_q there and at i_q = 0 of the same i_d. The other branch (reluctance torque against the
 * magnet) needs more current and, without a demagnetisation limit, never reaches more; a table that changed over to
 * it could not be interpolated. */
int32_t pmsm_on_branch(const pmsm_plane *plane, const pmsm_point *at);

/* How far a point lies outside the domain, relative to I_max; negative inside. */
double pmsm_plane_outside(const pmsm_plane *plane, const pmsm_rectangle *rectangle, const pmsm_point *at);

double pmsm_voltage_squared(const pmsm_plane *plane, const pmsm_point *at, double omega);
void pmsm_voltage_gradient(const pmsm_plane *plane, const pmsm_point *at, double omega, double gradient[2]);

/* Copper and iron loss (W) at electrical speed omega. */
double pmsm_plane_loss(const pmsm_plane *plane, const pmsm_point *at, double omega);

/* ---- curves ------------------------------------------------------------------------------------ */

enum pmsm_curve_kind {
    PMSM_CURVE_TORQUE,    /* t = level */
    PMSM_CURVE_VOLTAGE,   /* |v|^2 = level */
    PMSM_CURVE_CIRCLE,    /* |i| = level, parameter: angle (rad) */
    PMSM_CURVE_VERTICAL,  /* i_d = level, parameter: i_q (A) */
    PMSM_CURVE_HORIZONTAL /* i_q = level, parameter: i_d (A) */
};

typedef struct {
    const pmsm_plane *plane;
    const pmsm_rectangle *rectangle;
    enum pmsm_curve_kind kind;
    double level;
    double omega;        /* for the voltage, as a curve or as an indicator */
    double V2;           /* V^2, limit for PMSM_AT_VOLTAGE */
    double T;            /* torque / (1.5 p), for PMSM_AT_TORQUE */
} pmsm_curve;

/* What to look for along a curve: the zero of ... */
enum pmsm_indicator {
    PMSM_AT_VOLTAGE,         /* |v|^2 - V2 */
    PMSM_AT_TORQUE,          /* t - T */
    PMSM_AT_EDGE,            /* distance outside the domain */
    PMSM_AT_TORQUE_EXTREME,  /* slope of t */
    PMSM_AT_CURRENT_EXTREME, /* slope of |i|^2 */
    PMSM_AT_VOLTAGE_EXTREME, /* slope of |v|^2 */
    PMSM_AT_LOSS_EXTREME     /* slope of the loss */
};

/* Unit tangent: of a level curve, gradient turned by -90 degrees; else along the rising parameter. */
void pmsm_curve_tangent(const pmsm_curve *curve, const pmsm_point *at, double tangent[2]);

/* Place a parameter of a circle or line. */
void pmsm_curve_place(const pmsm_curve *curve, double s, pmsm_point *at);

/* Move the point along the gradient onto a level curve; 0 when that fails. */
int32_t pmsm_curve_correct(const pmsm_curve *curve, pmsm_point *at);

double pmsm_curve_indicator(const pmsm_curve *curve, enum pmsm_indicator what, const pmsm_point *at);

/* Zero of an indicator between two points of a level curve, or two parameters of a circle or line, that
 * differ in its sign; 0 when they do not. */
int32_t pmsm_curve_root(const pmsm_curve *curve, enum pmsm_indicator what, const pmsm_point *a, const pmsm_point *b,
                        pmsm_point *root);
int32_t pmsm_curve_root_between(const pmsm_curve *curve, enum pmsm_indicator what, double s_a, double s_b,
                                double *s, pmsm_point *root);

/* One step of about |length| along a level curve, against the tangent when negative; shortened where the
 * curve turns. 0 when no step succeeds. */
int32_t pmsm_curve_step(const pmsm_curve *curve, const pmsm_point *from, double length, pmsm_point *to);

/* ---- the domain's border and the torque limits -------------------------------------------------- */

#define PMSM_BORDER_PIECES 12
#define PMSM_BORDER_NODES 256

typedef struct {
    pmsm_curve curve;
    double s[2];            /* parameter range */
    int32_t first, count;   /* nodes */
} pmsm_piece;

typedef struct {
    pmsm_rectangle rectangle;
    int32_t n_pieces, n_nodes;
    pmsm_piece piece[PMSM_BORDER_PIECES];
    double s[PMSM_BORDER_NODES];
    pmsm_point node[PMSM_BORDER_NODES];
} pmsm_border;

/* Cut the circle of a radius to the rectangle; with_lines: add the rectangle's edges inside the circle. */
void pmsm_border_build(const pmsm_plane *plane, const pmsm_rectangle *rectangle, double radius, int32_t with_lines,
                       int32_t nodes_per_turn, pmsm_border *border);

/* Least and largest torque in the domain under |v| <= V: extreme[0], extreme[1]. 0: no admissible point. */
int32_t pmsm_torque_limits(const pmsm_plane *plane, const pmsm_border *border, double omega, double V,
                           pmsm_point extreme[2]);

#endif
