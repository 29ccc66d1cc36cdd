/* SPDX-License-Identifier: MIT */
/* Law 6: state feedback to the equilibrium that holds the reference, with a disturbance observer. One law from
 * standstill to deep field weakening, for both signs of speed and torque, for L_d = L_q and L_d != L_q; there is no
 * integrator.
 *
 * With E the voltage of no current (back-EMF and what the observer found), a = R^2 + X_d^2, b and l linear in i_q,
 * |v(i_d, i_q)|^2 = ((a i_d + b)^2 + l^2) / a: on the circle i_d = (sqrt(a V^2 - l^2) - b) / a, the stable branch.
 */
#include "polar.h"

#define REACH PMSM_C(0.97)   /* share of the largest i_q on the circle that is asked for */
#define TORQUE_STEPS 2u      /* Newton steps from above on a convex function: below 1e-3 of the torque */
#define CURRENT_STEPS 3u

typedef struct {
    pmsm_real R, X_d, X_q;     /* ohm */
    pmsm_dq E;                 /* V at no current */
    pmsm_real V;               /* V, radius */
    pmsm_real inverse, power;  /* 1/a, a V^2 */
    pmsm_real slope, offset, reach; /* l = slope i_q + offset, and the largest l asked for */
    pmsm_real b_0, b_1;        /* b = b_0 + b_1 i_q */
} circle;

typedef struct {
    pmsm_dq i, v;
    uint32_t weakened;         /* 1: the voltage limit moved the current */
} operating_point;

static pmsm_dq steady_voltage(const pmsm_period *period, pmsm_dq i)
{
    const pmsm_state *state = period->state;
    pmsm_dq v = pmsm_model_voltage(period, i);
    v.d += state->disturbance.d + state->polar.shortfall.d;
    v.q += state->disturbance.q + state->polar.shortfall.q;
    return v;
}

static circle voltage_circle(const pmsm_period *period, pmsm_real V)
{
    const pmsm_dq zero = {PMSM_C(0.0), PMSM_C(0.0)};
    circle c;
    c.R = period->R_s;
    c.X_d = period->omega_e * (pmsm_real)period->params->motor_L_d_app_h;
    c.X_q = period->omega_e * (pmsm_real)period->params->motor_L_q_app_h;
    c.E = steady_voltage(period, zero);
    c.V = V;
    const pmsm_real a = c.R * c.R + c.X_d * c.X_d;
    c.inverse = PMSM_C(1.0) / a;
    c.power = a * V * V;
    c.slope = c.R * c.R + c.X_d * c.X_q;
    c.offset = c.R * c.E.q - c.X_d * c.E.d;
    c.reach = REACH * PMSM_SQRT(c.power);
    c.b_0 = c.R * c.E.d + c.X_d * c.E.q;
    c.b_1 = c.R * (c.X_d - c.X_q);
    return c;
}

/* i_d on the circle for an i_q, which is cut to what can be reached; slope receives di_d/di_q. */
static pmsm_dq on_circle(const circle *c, pmsm_real i_q, pmsm_real *slope)
{
    const pmsm_real level = c->slope * i_q + c->offset;
    const pmsm_real cut = pmsm_clamp(level, -c->reach, c->reach);
    const pmsm_real q = (cut == level) ? i_q : (cut - c->offset) / c->slope;
    const pmsm_real root = PMSM_SQRT(c->power - cut * cut);
    const pmsm_dq i = {(root - (c->b_0 + c->b_1 * q)) * c->inverse, q};
    *slope = -(c->b_1 + cut * c->slope / root) * c->inverse;
    return i;
}

/* i_q on the circle for an i_d, on the side of sign; 0 when the circle does not reach i_d. */
static uint32_t at_i_d(const circle *c, pmsm_real i_d, pmsm_real sign, pmsm_dq *i)
{
    const pmsm_real v_d = c->R * i_d + c->E.d;
    const pmsm_real v_q = c->X_d * i_d + c->E.q;
    const pmsm_real square = c->R * c->R + c->X_q * c->X_q;
    const pmsm_real half = c->R * v_q - c->X_q * v_d;
    const pmsm_real D = half * half - square * (v_d * v_d + v_q * v_q - c->V * c->V);
    if (D < PMSM_C(0.0)) {
        return 0u;
    }
    const pmsm_real root = PMSM_SQRT(D);
    i->d = i_d;
    i->q = (((sign < PMSM_C(0.0)) ? -root : root) - half) / square;
    return 1u;
}

/* With L_d != L_q weakening changes the torque of a given i_q: i_q is reduced until the torque is the one asked for. */
static pmsm_dq hold_torque(const pmsm_period *period, const circle *c, pmsm_real i_q)
{
    const pmsm_params *params = period->params;
    const pmsm_real saliency = (pmsm_real)params->motor_L_d_app_h - (pmsm_real)params->motor_L_q_app_h;
    pmsm_real slope;
    pmsm_dq i = on_circle(c, i_q, &slope);
    if (saliency == PMSM_C(0.0) || period->request->mode == PMSM_MODE_CURRENT) {
        return i;
    }
    const pmsm_real psi = (pmsm_real)params->motor_psi_f_wb;
    const pmsm_real asked = (psi + saliency * period->reference.d) * period->reference.q;
    for (uint32_t k = 0u; k < TORQUE_STEPS; k++) {
        const pmsm_real flux = psi + saliency * i.d;
        const pmsm_real gradient = flux + saliency * slope * i.q;
        if (gradient <= PMSM_C(0.0)) {
            break;
        }
        i = on_circle(c, i.q - (flux * i.q - asked) / gradient, &slope);
    }
    return i;
}

/* The current limit on the circle: i_q gives way. */
static pmsm_dq limit_current(pmsm_period *period, const circle *c, pmsm_dq i)
{
    const pmsm_real I = pmsm_current_limit(period);
    if (pmsm_is_within(i, I) != 0u) {
        return i;
    }
    pmsm_real slope;
    i = on_circle(c, i.q, &slope);
    for (uint32_t k = 0u; k < CURRENT_STEPS; k++) {
        const pmsm_real gradient = PMSM_C(2.0) * (i.d * slope + i.q);
        if (gradient * i.q <= PMSM_C(0.0)) {
            break; /* i_d alone is beyond the limit: no i_q makes the current smaller */
        }
        i = on_circle(c, i.q - (pmsm_square(i) - I * I) / gradient, &slope);
    }
    period->flags |= (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
    return i;
}

/* The steady state for the reference: its own current inside the voltage circle; else on the circle, at the torque
 * asked for, or as much of it as voltage, current and i_d_min leave. */
static operating_point find_point(pmsm_period *period, pmsm_real V)
{
    const pmsm_dq wanted = period->reference;
    operating_point point = {wanted, steady_voltage(period, wanted), 0u};
    if (pmsm_is_within(point.v, V) != 0u) {
        return point;
    }
    const circle c = voltage_circle(period, V);
    const pmsm_real i_d_min = (pmsm_real)period->params->field_weakening_i_d_min_a;
    point.weakened = 1u;
    point.i = limit_current(period, &c, hold_torque(period, &c, wanted.q));
    if (point.i.d > wanted.d) { /* near standstill the resistance limits: nothing to weaken */
        (void)at_i_d(&c, wanted.d, wanted.q, &point.i);
    } else if (point.i.d < i_d_min && at_i_d(&c, i_d_min, wanted.q, &point.i) != 0u) {
        period->flags |= (uint32_t)PMSM_FLAG_CURRENT_LIMITED;
    }
    point.v = steady_voltage(period, point.i);
    return point;
}

void pmsm_polar_unified(pmsm_period *period, const polar_plant *p)
{
    const pmsm_params *params = period->params;
    pmsm_polar_state *memory = &period->state->polar;
    memory->weight = pmsm_filter_weight((pmsm_real)params->polar_omega_dob_rad_s * p->T_s);
    pmsm_observe_disturbance(period, memory->weight);
    const pmsm_real V_ref = (pmsm_real)params->polar_V_ref_ratio * period->V_max;
    const operating_point o = find_point(period, pmsm_min(V_ref, p->V));
    const pmsm_real L_d = (pmsm_real)params->motor_L_d_h;
    const pmsm_real L_q = (pmsm_real)params->motor_L_q_h;
    const pmsm_dq e = {o.i.d - period->i_model.d, o.i.q - period->i_model.q};
    const pmsm_real omega_c = (pmsm_real)params->polar_omega_c_rad_s;
    pmsm_dq v = {o.v.d + L_d * omega_c * e.d + period->omega_e * (pmsm_real)params->motor_L_q_app_h * e.q,
                 o.v.q + L_q * omega_c * e.q - period->omega_e * (pmsm_real)params->motor_L_d_app_h * e.d};
    if (o.weakened != 0u && pmsm_square(v) > p->V * p->V) { /* only the phase acts: state feedback 2 |omega| */
        const pmsm_real omega_f = PMSM_C(2.0) * pmsm_abs(period->omega_e);
        v.d = o.v.d + L_d * omega_f * e.d;
        v.q = o.v.q + L_q * omega_f * e.q;
        const pmsm_real size = PMSM_SQRT(pmsm_square(v));
        if (size > PMSM_C(0.0)) {
            const pmsm_real share = p->V / size;
            v.d *= share;
            v.q *= share;
        }
    }
    if (o.weakened != 0u) { /* the speed loop's anti-windup and the record see what the voltage left */
        period->state->tau_granted = pmsm_torque(params, period->magnetics, o.i);
        period->reference = o.i;
    }
    pmsm_polar_map(period, v, (pmsm_real)params->polar_eps_ratio * p->V);
}

/* Overmodulation gives less fundamental than is demanded. The mean of what the legs cut off is added to the voltage an
 * equilibrium needs; what the circle cuts off, in a step, is not. */
void pmsm_polar_unified_settle(pmsm_period *period)
{
    pmsm_polar_state *memory = &period->state->polar;
    pmsm_dq cut = {PMSM_C(0.0), PMSM_C(0.0)};
    if ((period->flags & (uint32_t)PMSM_FLAG_DUTY_CLIPPED) != 0u) {
        const pmsm_real size = PMSM_SQRT(pmsm_square(period->u));
        const pmsm_real share = (size > period->V_max) ? period->V_max / size : PMSM_C(1.0);
        cut.d = share * period->u.d - period->u_realised.d;
        cut.q = share * period->u.q - period->u_realised.q;
    }
    memory->shortfall.d += memory->weight * (cut.d - memory->shortfall.d);
    memory->shortfall.q += memory->weight * (cut.q - memory->shortfall.q);
}
