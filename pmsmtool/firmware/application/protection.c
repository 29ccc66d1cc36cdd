/* SPDX-License-Identifier: MIT */
/* Trips. */
#include "application_parts.h"

#define SAMPLE_MOST 1e7F             /* A, V: what is larger is no sample */

uint32_t pmsm_find_trip(const pmsm_application *app)
{
    const pmsm_sensors *s = &app->sensors;
    const pmsm_params *p = app->params;
    const float limit = p->protection_i_trip_apk;
    const float T = (pmsm_is_nan(s->T_winding) != 0u) ? 0.0F : s->T_winding; /* no sensor */
    const float sum = pmsm_abs(s->i_a) + pmsm_abs(s->i_b) + pmsm_abs(s->i_c) + pmsm_abs(s->U_dc) + pmsm_abs(T);
    if (!(sum <= SAMPLE_MOST)) {
        return (uint32_t)PMSM_TRIP_NONE; /* no sample to judge: the core holds its voltage, and trips at the second */
    }
    if (pmsm_abs(s->i_a) > limit || pmsm_abs(s->i_b) > limit || pmsm_abs(s->i_c) > limit) {
        return (uint32_t)PMSM_TRIP_OVERCURRENT;
    }
    if (s->U_dc > p->protection_U_dc_max_v) {
        return (uint32_t)PMSM_TRIP_OVERVOLTAGE;
    }
    if (app->enabled != 0u && s->U_dc < p->protection_U_dc_min_v) {
        return (uint32_t)PMSM_TRIP_UNDERVOLTAGE;
    }
    if (pmsm_abs(app->speed.omega) * PMSM_RPM > p->protection_n_trip_rpm) {
        return (uint32_t)PMSM_TRIP_OVERSPEED;
    }
    return (s->T_winding > p->protection_T_winding_max_c) ? (uint32_t)PMSM_TRIP_OVERTEMPERATURE
                                                          : (uint32_t)PMSM_TRIP_NONE;
}
