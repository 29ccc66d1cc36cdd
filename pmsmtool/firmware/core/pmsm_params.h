/* SPDX-License-Identifier: MIT */
/* Generated from pmsmtool/params/catalogue.py by python -m pmsmtool.firmware.params_header: do not edit. */
#ifndef PMSM_PARAMS_H
#define PMSM_PARAMS_H

#include "pmsm_types.h"

#ifdef __cplusplus
extern "C" {
#endif

#define PMSM_PARAMS_SCHEMA_VERSION 1u
#define PMSM_PARAMS_SIGNATURE 0xAD57A489u /* CRC-32 of name:type:dim:unit:scale in struct order */
#define PMSM_PARAMS_WORDS 100u
#define PMSM_PARAMS_LUT_WORDS_MAX 8192u
#define PMSM_K_MAX_NOT_DETERMINED 255u

/* Every member takes four bytes: the little-endian memory image is the packed image. SI units, peak values. */
typedef struct pmsm_params {
    uint32_t motor_pole_pairs;               /* pole pairs */
    float    motor_R_s_ohm;                  /* [ohm] loop resistance per phase at T_ref */
    float    motor_L_d_h;                    /* [H] incremental d inductance */
    float    motor_L_q_h;                    /* [H] incremental q inductance */
    float    motor_psi_f_wb;                 /* [Wb] PM flux linkage at T_ref (peak) */
    float    motor_I_max_apk;                /* [A] time-limited peak current */
    float    motor_I_nom_apk;                /* [A] rated current (peak) */
    float    motor_J_kgm2;                   /* [kg m2] total inertia */
    float    motor_T_ref_c;                  /* [degC] reference temperature of R_s and psi_f */
    float    motor_alpha_R_per_k;            /* [1/K] temperature coefficient of R_s (copper's times its share) */
    float    motor_alpha_psi_per_k;          /* [1/K] temperature coefficient of the magnet flux */
    float    motor_L_d_app_h;                /* [H] apparent d inductance (decoupling, torque) */
    float    motor_L_q_app_h;                /* [H] apparent q inductance (decoupling, torque) */
    float    motor_B_nms;                    /* [N m s] viscous friction */
    float    motor_tau_c_nm;                 /* [N m] Coulomb friction torque */
    float    motor_I_max_time_s;             /* [s] time I_max may flow from cold (I2t) */
    float    motor_n_max_rpm;                /* [rpm] largest mechanical speed */
    uint32_t inverter_T_s_ns;                /* [ns] control period */
    float    inverter_voltage_utilisation;   /* V_max / U_dc */
    uint32_t inverter_dead_time_ns;          /* [ns] dead time per switching edge */
    float    inverter_delay_periods;         /* delay from sample to mean applied voltage, in T_s */
    uint32_t inverter_deadtime_compensation; /* 0 off, 1 on (V_dead, i_knee) */
    float    inverter_V_dead_v;              /* [V] compensated voltage error of one phase */
    float    inverter_i_knee_apk;            /* [A] current at which the error reaches its plateau */
    float    inverter_U_dc_nom_v;            /* [V] nominal DC-link voltage */
    uint32_t inverter_min_off_time_ns;       /* [ns] time a leg's lower switch is on in each period */
    uint32_t inverter_sample_window_ns;      /* [ns] time that reading a shunt takes */
    uint32_t inverter_shunts;                /* shunts: 1 in the link, 3 in the legs, 0: sensors in the phases */
    float    protection_i_trip_apk;          /* [A] instantaneous trip of any phase current */
    float    protection_U_dc_min_v;          /* [V] undervoltage trip */
    float    protection_U_dc_max_v;          /* [V] overvoltage trip */
    float    protection_n_trip_rpm;          /* [rpm] overspeed trip */
    float    protection_T_winding_max_c;     /* [degC] winding over-temperature trip */
    float    protection_I_cont_apk;          /* [A] current limit once the I2t budget is used */
    float    protection_n_short_circuit_rpm; /* [rpm] a fault above it shorts the windings, below it removes the
                                                gates; 0: removes them at every speed */
    float    encoder_offset_rad;             /* [rad] theta_e = direction p theta_M - offset */
    uint32_t encoder_reversed;               /* 1: the encoder counts against the phase order */
    float    encoder_pll_bandwidth_rad_s;    /* [rad/s] natural frequency of the speed estimate */
    uint32_t hall_commutation;               /* by Hall sensors: 0 not, 1 start, 2 alone, 3 six steps */
    float    hall_axis_1_rad;                /* [rad] middle of wire 1's high half */
    float    hall_axis_2_rad;                /* [rad] of wire 2's, electrical */
    float    hall_axis_3_rad;                /* [rad] of wire 3's, electrical */
    float    current_K_p_d_v_per_a;          /* [V/A] proportional gain, d axis */
    float    current_K_i_d_v_per_as;         /* [V/(A s)] integral gain, d axis */
    float    current_K_p_q_v_per_a;          /* [V/A] proportional gain, q axis */
    float    current_K_i_q_v_per_as;         /* [V/(A s)] integral gain, q axis */
    uint32_t current_options;                /* bit0 decoupling, bit1 emf feed-forward, bit2 back-calculation, bit3
                                                hexagon limit, bit4 one-step predictor, bit5 record the dead-time
                                                compensation in u_d_lim, u_q_lim */
    float    speed_K_p_nms_per_rad;          /* [N m s/rad] proportional gain */
    float    speed_K_i_nm_per_rad;           /* [N m/rad] integral gain */
    float    speed_filter_hz;                /* [Hz] feedback filter cut-off */
    float    speed_tau_max_nm;               /* [N m] torque limit of the speed controller */
    uint32_t speed_decimation;               /* control periods per speed-controller period */
    float    speed_notch_hz;                 /* [Hz] notch frequency, 0 off */
    float    speed_notch_zeta_num;           /* notch numerator damping */
    float    speed_notch_zeta_den;           /* notch denominator damping */
    float    speed_acceleration_rpm_per_s;   /* [rpm/s] slope limit of the speed reference */
    float    position_K_p_per_s;             /* [1/s] speed reference per position error, 0: not tuned */
    float    position_velocity_ff;           /* share of a move's speed added to it */
    float    position_inertia_ff_kgm2;       /* [kg m2] torque per acceleration of a move */
    uint32_t governor_mode;                  /* 0 off, 1 paper (exact), 2 line search, 3 best, 4 linearised, 5
                                                observe */
    uint32_t governor_k_max;                 /* horizon in T_s, 255 not determined */
    float    governor_eps;                   /* tightening of the steady-state row */
    uint32_t governor_options;               /* bit0 hexagon row 0, bit1 predictor, bit2 current row, bit3 pre-
                                                projection, bit4 minimum-time direction */
    float    governor_I_transient_apk;       /* [A] transient current limit */
    float    governor_observer_gain;         /* disturbance observer gain per T_s */
    float    governor_alpha_rad_s;           /* [rad/s] bandwidth the rows are built for */
    float    governor_slack;                 /* squared-voltage slack before the fallback */
    uint32_t field_weakening_mode;           /* 0 off, 1 look-up, 2 gradient, 3 accelerated, 4 uncompensated gradient */
    uint32_t field_weakening_N_fw;           /* control periods per optimisation step */
    float    field_weakening_margin;         /* V_m = (1 - margin) V_max */
    float    field_weakening_h1;             /* [1/(N m)2] weight of the torque error */
    float    field_weakening_h2;             /* [1/A2] weight of i_d - i_d_LM */
    float    field_weakening_beta;           /* first step length */
    float    field_weakening_sigma;          /* Armijo constant */
    uint32_t field_weakening_iterations;     /* iterations per call */
    float    field_weakening_i_d_min_a;      /* [A] most negative i_d (demagnetisation) */
    float    field_weakening_i_d_lm_a;       /* [A] loss-minimising i_d */
    uint32_t lut_format;                     /* 0 none, 1 binary32, 2 int16 times lsb */
    uint32_t lut_axis_kind;                  /* second axis: 0 mechanical speed (rpm), 1 flux limit (Wb) */
    uint32_t lut_n_x;                        /* nodes of the torque axis */
    uint32_t lut_n_y;                        /* nodes of the speed or flux axis */
    uint32_t lut_n_z;                        /* nodes of the U_dc axis, 1 when there is none */
    float    lut_lsb_a;                      /* [A] current of one int16 step */
    uint32_t saturation_n_d;                 /* nodes along i_d, 0 without saturation */
    uint32_t saturation_n_q;                 /* nodes along i_q, from 0 on */
    float    saturation_i_d_min_a;           /* [A] first node along i_d */
    float    saturation_i_d_max_a;           /* [A] last node along i_d */
    float    saturation_i_q_max_a;           /* [A] last node along i_q */
    uint32_t polar_mode;                     /* 0 off, 1 conventional, 2 proposed, 3 linear range, 4 linear as
                                                printed, 5 regularised, 6 unified */
    uint32_t polar_options;                  /* bit0 P and D on the measurement, bit1 no anti-windup, bit2 predict
                                                over the delay, bit3 switch to 5 in the linear range */
    float    polar_V_a_max_ratio;            /* amplitude limit / V_max */
    float    polar_sigma_phase_rad_s;        /* [rad/s] real part of the phase loop's poles */
    float    polar_sigma_amplitude_rad_s;    /* [rad/s] real part of the amplitude loop's poles */
    float    polar_tau_s;                    /* [s] CDM equivalent time constant */
    float    polar_gamma;                    /* CDM stability index */
    float    polar_omega_c_rad_s;            /* [rad/s] bandwidth of the unified law */
    float    polar_omega_dob_rad_s;          /* [rad/s] disturbance observer bandwidth */
    float    polar_eps_ratio;                /* regularisation radius / V_max of the polar map */
    float    polar_b;                        /* set-point weight of the regularised law */
    float    polar_V_ref_ratio;              /* reference amplitude of the unified law / V_max */
} pmsm_params;

typedef char pmsm_params_size_check[(sizeof(pmsm_params) == 4u * PMSM_PARAMS_WORDS) ? 1 : -1];

/* Inclusive bounds of one member; integer bounds are exact in binary32. */
typedef struct {
    float minimum;
    float maximum;
    uint32_t is_integer;
} pmsm_param_limit;

extern const pmsm_param_limit pmsm_param_limits[PMSM_PARAMS_WORDS];

#ifdef __cplusplus
}
#endif

#endif
