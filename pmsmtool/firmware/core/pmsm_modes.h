/* SPDX-License-Identifier: MIT */
/* Meaning of the mode and option members of pmsm_params. */
#ifndef PMSM_MODES_H
#define PMSM_MODES_H

enum pmsm_current_option {
    PMSM_CURRENT_DECOUPLING = 1u << 0,       /* rotation voltages omega_e L i */
    PMSM_CURRENT_EMF = 1u << 1,              /* omega_e psi */
    PMSM_CURRENT_BACK_CALCULATION = 1u << 2, /* realizable-reference anti-windup; off: plain clip */
    PMSM_CURRENT_HEXAGON = 1u << 3,          /* limit to the inverter's hexagon instead of the circle */
    PMSM_CURRENT_PREDICTOR = 1u << 4,        /* proportional part and decoupling act on the predicted current */
    PMSM_CURRENT_RECORD_COMPENSATION = 1u << 5 /* u_d_lim, u_q_lim include the dead-time compensation */
};

enum pmsm_governor_mode {
    PMSM_GOVERNOR_OFF = 0,
    PMSM_GOVERNOR_PAPER = 1,      /* exact projection on the rows 0..k_max and the tightened steady state */
    PMSM_GOVERNOR_LINE = 2,       /* line search from the last governed reference */
    PMSM_GOVERNOR_BEST = 3,       /* offset-free rows 0 and infinity */
    PMSM_GOVERNOR_LINEARISED = 4, /* voltage rows replaced by their tangents, reference [18] of Jercic et al. */
    PMSM_GOVERNOR_OBSERVE = 5     /* rows are evaluated and reported, the reference passes */
};

enum pmsm_governor_option {
    PMSM_GOVERNOR_HEXAGON = 1u << 0,       /* row 0 uses the hexagon's radius in the demanded direction */
    PMSM_GOVERNOR_PREDICTOR = 1u << 1,     /* rows start from the predicted current */
    PMSM_GOVERNOR_CURRENT_ROW = 1u << 2,   /* |reference| <= I_transient */
    PMSM_GOVERNOR_PRE_PROJECTION = 1u << 3,/* request onto the steady-state row first */
    PMSM_GOVERNOR_MINIMUM_TIME = 1u << 4   /* steer the flux along the minimum-time direction */
};

/* pmsm_live.binding: a prediction row 0..PMSM_GOVERNOR_ROWS - 1, or one of these. */
enum pmsm_binding {
    PMSM_BINDING_MINIMUM_TIME = 250, /* the reference steers the flux along the minimum-time direction */
    PMSM_BINDING_PRE_PROJECTION = 251, /* only the request itself was moved */
    PMSM_BINDING_CURRENT = 252,      /* |reference| <= I_transient */
    PMSM_BINDING_STEADY_STATE = 253,
    PMSM_BINDING_EMPTY = 254,        /* no reference satisfies all rows: fallback */
    PMSM_BINDING_NONE = 255
};

/* Prediction rows the core can hold; a longer k_max is cut to this, the steady-state row covers what follows. */
#define PMSM_GOVERNOR_ROWS 64u

enum pmsm_fw_mode {
    PMSM_FW_OFF = 0,
    PMSM_FW_LUT = 1,
    PMSM_FW_GRADIENT = 2,     /* projected gradient with Armijo steps, (43)-(48), compensated (42) */
    PMSM_FW_ACCELERATED = 3,  /* FISTA with restart, compensated */
    PMSM_FW_UNCOMPENSATED = 4 /* projected gradient on the nominal ellipse (33) */
};

enum pmsm_lut_format { PMSM_LUT_NONE = 0, PMSM_LUT_BINARY32 = 1, PMSM_LUT_INT16 = 2 };
enum pmsm_lut_axis { PMSM_LUT_SPEED_RPM = 0, PMSM_LUT_FLUX_LIMIT = 1 };

/* Words of a node of the saturation table. */
#define PMSM_SATURATION_VALUES 4u
#define PMSM_FLUX_MOST 100.0F         /* Wb; what a node may hold */
#define PMSM_INDUCTANCE_LEAST 1e-7F   /* H */
#define PMSM_INDUCTANCE_MOST 10.0F    /* H */

enum pmsm_polar_mode {
    PMSM_POLAR_OFF = 0,
    PMSM_POLAR_CONVENTIONAL = 1,
    PMSM_POLAR_PROPOSED = 2,
    PMSM_POLAR_LINEAR = 3,
    PMSM_POLAR_LINEAR_PRINTED = 4,
    PMSM_POLAR_REGULARISED = 5,
    PMSM_POLAR_UNIFIED = 6
};

enum pmsm_polar_option {
    PMSM_POLAR_ON_MEASUREMENT = 1u << 0,  /* P and D act on the measurement (I-PD) */
    PMSM_POLAR_NO_ANTI_WINDUP = 1u << 1,
    PMSM_POLAR_PREDICT = 1u << 2,         /* predict the current over the delay */
    PMSM_POLAR_LINEAR_RANGE = 1u << 3     /* regularised law while the voltage is inside the circle */
};

#endif
