/* SPDX-License-Identifier: MIT */
/* What the governor knows of the voltage beside the model: a first-order filter of what acted over the last period.
 *
 * While the current moves fast a wrong inductance looks like a lost voltage: the filter then holds. A jump of the speed
 * or of the DC link looks like one for a single period: only what two periods agree on is taken in. Where the mean of
 * what is new is small it is noise, of which the steady-state row would move the reference about: the filter is slow.
 */
#include "governor.h"

#define STILL_SHARE PMSM_C(0.2)  /* of V_max: a current that moves under more inductive voltage is not still */
#define MEAN_WEIGHT PMSM_C(0.05) /* of a period in the mean of what is new */
#define SURE_SHARE PMSM_C(0.01)  /* of V_max: a mean as large as that is taken in with the whole gain */
#define SLOW_GAIN PMSM_C(0.1)    /* of the gain, where the mean is small */
#define MODEL_SHARE PMSM_C(0.1)  /* of V_max: a larger difference says that the model is off */

/* The smaller of two of the same sign. */
static pmsm_real agreed(pmsm_real a, pmsm_real b)
{
    if (a * b <= PMSM_C(0.0)) {
        return PMSM_C(0.0);
    }
    return (pmsm_abs(a) < pmsm_abs(b)) ? a : b;
}

uint32_t pmsm_governor_observe(pmsm_period *period)
{
    pmsm_dq *held = &period->state->disturbance;
    pmsm_dq *before = &period->state->news_before;
    pmsm_dq *mean = &period->state->news_mean;
    const pmsm_real V_square = period->V_max * period->V_max;
    pmsm_dq inductive;
    pmsm_turn_half(period);
    const pmsm_dq lost = pmsm_lost_voltage(period, &inductive);
    const pmsm_dq news = {lost.d - held->d, lost.q - held->q};
    mean->d += MEAN_WEIGHT * (news.d - mean->d);
    mean->q += MEAN_WEIGHT * (news.q - mean->q);
    const pmsm_real lasting = pmsm_square(*mean) / (SURE_SHARE * SURE_SHARE * V_square);
    const pmsm_real gain =
        (pmsm_real)period->params->governor_observer_gain * pmsm_clamp(lasting, SLOW_GAIN, PMSM_C(1.0));
    if (pmsm_square(inductive) <= STILL_SHARE * STILL_SHARE * V_square) {
        held->d += gain * agreed(news.d, before->d);
        held->q += gain * agreed(news.q, before->q);
    }
    *before = news;
    return (pmsm_square(news) > MODEL_SHARE * MODEL_SHARE * V_square) ? 1u : 0u;
}
