/* SPDX-License-Identifier: MIT */
/* Constants of the active parameter set. */
#include "pmsm_period.h"

/* Biquad of (s^2 + 2 z_n w s + w^2)/(s^2 + 2 z_d w s + w^2), bilinear with the notch frequency kept in place. */
static void prepare_notch(pmsm_derived *derived, const pmsm_params *params)
{
    const pmsm_real half = PMSM_PI * (pmsm_real)params->speed_notch_hz * derived->speed_period;
    derived->notch_b0 = PMSM_C(0.0);
    if (half <= PMSM_C(0.0) || half >= PMSM_C(0.45) * PMSM_PI) {
        return; /* off, or too close to the Nyquist frequency to be one */
    }
    pmsm_real sine;
    pmsm_real cosine;
    pmsm_sincos(half, &sine, &cosine);
    const pmsm_real k = sine / cosine;
    const pmsm_real numerator = PMSM_C(2.0) * (pmsm_real)params->speed_notch_zeta_num * k;
    const pmsm_real denominator = PMSM_C(2.0) * (pmsm_real)params->speed_notch_zeta_den * k;
    const pmsm_real scale = PMSM_C(1.0) / (PMSM_C(1.0) + denominator + k * k);
    derived->notch_b0 = (PMSM_C(1.0) + numerator + k * k) * scale;
    derived->notch_b1 = PMSM_C(2.0) * (k * k - PMSM_C(1.0)) * scale;
    derived->notch_b2 = (PMSM_C(1.0) - numerator + k * k) * scale;
    derived->notch_a2 = (PMSM_C(1.0) - denominator + k * k) * scale;
}

void pmsm_prepare(pmsm_state *state, const pmsm_params *params)
{
    pmsm_derived *derived = &state->derived;
    derived->T_s = (pmsm_real)params->inverter_T_s_ns * PMSM_C(1e-9);
    derived->pole_pairs = (pmsm_real)params->motor_pole_pairs;
    derived->torque_per_flux = PMSM_C(1.5) * derived->pole_pairs;

    const pmsm_real I_max = (pmsm_real)params->motor_I_max_apk;
    const pmsm_real I_cont = (pmsm_real)params->protection_I_cont_apk;
    const pmsm_real time = (pmsm_real)params->motor_I_max_time_s;
    const pmsm_real excess = I_max * I_max - I_cont * I_cont;
    derived->i2t_rate = (excess > PMSM_C(0.0) && time > PMSM_C(0.0)) ? derived->T_s / (time * excess) : PMSM_C(0.0);

    derived->speed_period = derived->T_s * (pmsm_real)params->speed_decimation;
    const pmsm_real step = PMSM_C(2.0) * PMSM_PI * (pmsm_real)params->speed_filter_hz * derived->T_s;
    derived->speed_filter = step / (PMSM_C(1.0) + step);
    prepare_notch(derived, params);
    state->prepared = 1u;
}
