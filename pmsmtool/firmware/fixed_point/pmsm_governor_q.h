/* SPDX-License-Identifier: MIT */
/* Reference governor in fixed point, for processors without floating point: line search with offset-free rows.
 *
 * Every quantity is Q4.27 of its base value (currents of I_base, voltages of U_base, electrical speed of omega_base);
 * the constants of a motor and the bases are generated (<prefix>_cfg_q.h). Values saturate at 8 base values, products
 * are taken in 64 bits, every loop is bounded, nothing is undefined for any input. The law is the float core's mode
 * "line search" without options: the largest step from the last governed reference towards the request that keeps the
 * demanded voltage inside V_max now and, with what the integrators hold, in the steady state; where the held reference
 * became inadmissible its steady-state voltage is scaled down. Row 0, the voltage now, is met in any case.
 * For the machine of Jercic et al. it stays within 1e-3 A of the float core on equal inputs, and the currents of closed
 * loops within 0.02 A (pmsmtool's tests/firmware/test_governor_q.py).
 */
#ifndef PMSM_GOVERNOR_Q_H
#define PMSM_GOVERNOR_Q_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PMSM_Q27_BITS 27
#define PMSM_Q27_ONE ((int32_t)1 << PMSM_Q27_BITS)

typedef int32_t pmsm_q27; /* Q4.27 of a base value */

typedef struct {
    pmsm_q27 d;
    pmsm_q27 q;
} pmsm_q27_dq;

typedef struct {             /* of one motor, written by the exporter */
    pmsm_q27 K_p_d, K_p_q;   /* U_base/I_base */
    pmsm_q27 inverse_K_p_d, inverse_K_p_q; /* I_base/U_base */
    pmsm_q27 R_s;            /* U_base/I_base */
    pmsm_q27 L_d, L_q;       /* U_base/(I_base omega_base), apparent */
    pmsm_q27 psi_f;          /* U_base/omega_base */
    pmsm_q27 steady_share;   /* 1 - eps, of V_max */
    pmsm_q27 slack;          /* of V squared, that a held reference may be outside */
} pmsm_governor_q_constants;

enum pmsm_governor_q_binding { /* as in the float core */
    PMSM_Q_BINDING_ROW_0 = 0,
    PMSM_Q_BINDING_STEADY_STATE = 253,
    PMSM_Q_BINDING_NONE = 255
};

typedef struct {
    pmsm_q27_dq held;  /* governed reference of the last period; start with 0 */
    uint32_t binding;  /* row that stopped the step */
} pmsm_governor_q_state;

typedef struct {             /* of this period */
    pmsm_q27_dq request;     /* I_base */
    pmsm_q27_dq i;           /* I_base, the current the proportional part sees */
    pmsm_q27_dq integrator;  /* U_base, of the current controller with decoupling and emf feed-forward */
    pmsm_q27 omega_e;        /* omega_base */
    pmsm_q27 V_max;          /* U_base, radius of the voltage circle */
} pmsm_governor_q_input;

/* The governed reference. */
pmsm_q27_dq pmsm_governor_q(const pmsm_governor_q_constants *motor, pmsm_governor_q_state *state,
                            const pmsm_governor_q_input *input);

#ifdef __cplusplus
}
#endif

#endif
