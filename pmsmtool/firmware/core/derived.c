/* SPDX-License-Identifier: MIT */
/* Constants of the active parameter set. */
#include "pmsm_image.h"
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

static void prepare_magnetics(pmsm_derived *derived, const pmsm_params *params)
{
    const pmsm_magnetics nominal = {
        (pmsm_real)params->motor_L_d_h, (pmsm_real)params->motor_L_q_h, (pmsm_real)params->motor_L_d_app_h,
        (pmsm_real)params->motor_L_q_app_h, (pmsm_real)params->motor_psi_f_wb,
        {(pmsm_real)params->current_K_p_d_v_per_a, (pmsm_real)params->current_K_p_q_v_per_a}};
    derived->nominal = nominal;
    /* the polar laws know one inductance */
    derived->saturates = (params->saturation_n_d > 0u && params->polar_mode == PMSM_POLAR_OFF) ? 1u : 0u;
    if (derived->saturates != 0u) {
        derived->saturation_word =
            pmsm_lut_words(params) - params->saturation_n_d * params->saturation_n_q * PMSM_SATURATION_VALUES;
        const pmsm_real span = (pmsm_real)params->saturation_i_d_max_a - (pmsm_real)params->saturation_i_d_min_a;
        derived->nodes_per_ampere.d = (pmsm_real)(params->saturation_n_d - 1u) / span;
        derived->nodes_per_ampere.q =
            (pmsm_real)(params->saturation_n_q - 1u) / (pmsm_real)params->saturation_i_q_max_a;
        derived->gain_per_L.d = nominal.K_p.d / nominal.L_d;
        derived->gain_per_L.q = nominal.K_p.q / nominal.L_q;
    }
}

static uint32_t uses_predictor(const pmsm_params *params)
{
    const uint32_t governed = (params->governor_mode != PMSM_GOVERNOR_OFF) ? params->governor_options : 0u;
    const uint32_t asked =
        (params->current_options & (uint32_t)PMSM_CURRENT_PREDICTOR) | (governed & (uint32_t)PMSM_GOVERNOR_PREDICTOR);
    return (asked != 0u && params->inverter_delay_periods >= 1.0F) ? 1u : 0u;
}

static uint32_t uses_hexagon(const pmsm_params *params)
{
    const uint32_t governed = (params->governor_mode != PMSM_GOVERNOR_OFF) ? params->governor_options : 0u;
    return ((params->current_options & PMSM_CURRENT_HEXAGON) != 0u || (governed & PMSM_GOVERNOR_HEXAGON) != 0u) ? 1u
                                                                                                                : 0u;
}

/* The polar laws and the hexagon have their own ways beyond the linear range. */
static uint32_t uses_overmodulation(const pmsm_params *params, const pmsm_derived *derived)
{
    const pmsm_real utilisation = (pmsm_real)params->inverter_voltage_utilisation;
    return (derived->hexagon == 0u && params->polar_mode == PMSM_POLAR_OFF && utilisation > derived->utilisation_linear)
               ? 1u
               : 0u;
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
    pmsm_prepare_duties(derived, params);
    derived->predicts = uses_predictor(params);
    derived->hexagon = uses_hexagon(params);
    derived->overmodulates = uses_overmodulation(params, derived);
    prepare_magnetics(derived, params);
    state->prepared = 1u;
}
