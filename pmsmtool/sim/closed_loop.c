/* SPDX-License-Identifier: MIT */
/* The closed loop; see closed_loop.h. */
#include "closed_loop.h"

#include <stddef.h>
#include <string.h>

#include "elementary.h"

#define ANGLE_MOST 1e9 /* rad, mechanical: a year at 300 rpm; the encoder fails beyond */

/* ---- what a caller sees of the structs ---------------------------------------------------------------- */

uint32_t pmsm_sim_layout(uint32_t what)
{
    switch (what) {
    case PMSM_LAYOUT_SIM: return (uint32_t)sizeof(pmsm_sim);
    case PMSM_LAYOUT_DRIVE: return (uint32_t)sizeof(pmsm_drive);
    case PMSM_LAYOUT_SETUP: return (uint32_t)sizeof(pmsm_sim_setup);
    case PMSM_LAYOUT_MACHINE: return (uint32_t)sizeof(pmsm_machine);
    case PMSM_LAYOUT_INVERTER: return (uint32_t)sizeof(pmsm_inverter_setup);
    case PMSM_LAYOUT_SENSORS: return (uint32_t)sizeof(pmsm_sensor_setup);
    case PMSM_LAYOUT_PARAMS: return (uint32_t)sizeof(pmsm_params);
    case PMSM_LAYOUT_REFERENCE: return (uint32_t)sizeof(pmsm_reference);
    case PMSM_LAYOUT_EXCITATION: return (uint32_t)sizeof(pmsm_excitation);
    case PMSM_LAYOUT_RECORDER: return (uint32_t)sizeof(pmsm_recorder);
    case PMSM_LAYOUT_AVERAGE: return (uint32_t)sizeof(pmsm_average);
    case PMSM_LAYOUT_FLUX_MAP: return (uint32_t)sizeof(pmsm_flux_map);
    case PMSM_LAYOUT_POSITION: return (uint32_t)offsetof(pmsm_position, trajectory);
    default: return 0u;
    }
}

void *pmsm_sim_part(pmsm_drive *drive, uint32_t part)
{
    switch (part) {
    case PMSM_PART_PARAMS: return &drive->params;
    case PMSM_PART_LUT: return drive->lut;
    case PMSM_PART_REFERENCE: return &drive->application.reference;
    case PMSM_PART_EXCITATION: return &drive->application.excitation;
    case PMSM_PART_RECORDER: return &drive->application.recorder;
    case PMSM_PART_AVERAGE: return &drive->application.average;
    case PMSM_PART_BUFFER: return drive->buffer;
    case PMSM_PART_TRACE: return drive->trace;
    case PMSM_PART_ENABLED: return &drive->application.enabled;
    case PMSM_PART_QUICK_STOP: return &drive->application.quick_stop;
    case PMSM_PART_TRIP: return &drive->application.trip;
    case PMSM_PART_FIXED_ANGLE: return &drive->application.fixed_angle;
    case PMSM_PART_RECORDER_WRITE: return &drive->application.recording.write;
    case PMSM_PART_LIVE: return &drive->application.control.live;
    case PMSM_PART_APPLICATION: return &drive->application;
    case PMSM_PART_POSITION: return &drive->application.position;
    case PMSM_PART_SPEED_INTEGRAL: return &drive->application.control.speed_integrator;
    case PMSM_PART_FIELD_WEAKENING: return &drive->application.control.fw_reference;
    default: return NULL;
    }
}

/* ---- schedules -------------------------------------------------------------------------------------------- */

/* Value at t, right-continuous at steps; time only moves forward between resets of the cursor. */
static double schedule_value(pmsm_schedule *s, double t)
{
    while (s->cursor + 1u < s->n && s->t[s->cursor + 1u] <= t)
        s->cursor++;
    const uint32_t k = s->cursor;
    if (t <= s->t[k] || k + 1u >= s->n)
        return s->value[k];
    return s->value[k] + (s->value[k + 1u] - s->value[k]) * (t - s->t[k]) / (s->t[k + 1u] - s->t[k]);
}

static void apply_reference(pmsm_sim *sim, uint32_t target, double t, pmsm_real *field)
{
    if (sim->schedule[target].t)
        *field = (pmsm_real)schedule_value(&sim->schedule[target], t);
}

static void apply_schedules(pmsm_sim *sim, double t, double T_s)
{
    /* a node a rounding error behind t_k belongs to period k */
    const double now = t + 1e-6 * T_s;
    pmsm_reference *reference = &sim->drive->application.reference;
    apply_reference(sim, PMSM_TARGET_I_D, now, &reference->i_d_ref);
    apply_reference(sim, PMSM_TARGET_I_Q, now, &reference->i_q_ref);
    apply_reference(sim, PMSM_TARGET_TORQUE, now, &reference->tau_ref);
    apply_reference(sim, PMSM_TARGET_SPEED, now, &reference->omega_M_ref);
    apply_reference(sim, PMSM_TARGET_U_D, now, &reference->u_d_inject);
    apply_reference(sim, PMSM_TARGET_U_Q, now, &reference->u_q_inject);
    if (sim->schedule[PMSM_TARGET_LOAD].t)
        sim->plant.load = schedule_value(&sim->schedule[PMSM_TARGET_LOAD], now);
    if (sim->schedule[PMSM_TARGET_U_DC].t)
        sim->setup.U_dc = schedule_value(&sim->schedule[PMSM_TARGET_U_DC], now);
    if (sim->schedule[PMSM_TARGET_DRIVEN_SPEED].t && sim->plant.machine.rotor == PMSM_ROTOR_DRIVEN) {
        pmsm_schedule *speed = &sim->schedule[PMSM_TARGET_DRIVEN_SPEED];
        sim->plant.state.omega_M = schedule_value(speed, now);
        pmsm_schedule ahead = *speed;
        sim->plant.acceleration = (schedule_value(&ahead, now + (1.0 - 2e-6) * T_s) - sim->plant.state.omega_M)
                                  / ((1.0 - 2e-6) * T_s);
    }
}

static double dc_link(const pmsm_sim *sim, double t)
{
    double supply = sim->setup.U_dc - sim->setup.U_dc_source * sim->link_current;
    if (sim->setup.U_dc_ripple != 0.0) {
        const double turns = sim->setup.U_dc_ripple_hz * t;
        double s, c;
        pmsm_real64_sincos(PMSM_REAL64_TWO_PI * (turns - (double)(int64_t)turns), &s, &c);
        supply += sim->setup.U_dc_ripple * s;
    }
    return supply > sim->link_charge ? supply : sim->link_charge;
}

/* The bridge takes the sum of duty times current from the capacitor, which the supply recharges. */
static void load_link(pmsm_sim *sim, const pmsm_output *acting, double T_s)
{
    const double duty[3] = {(double)acting->duty_a, (double)acting->duty_b, (double)acting->duty_c};
    double current = 0.0;
    for (int x = 0; x < 3 && acting->gates; x++)
        current += duty[x] * pmsm_plant_leg_current(&sim->plant, x);
    sim->link_current += (current - sim->link_current) * T_s / (sim->setup.U_dc_source_time + T_s);
}

/* Energy balance of the capacitor over a period. A supply that has failed is one of 0 V. */
static void charge_link(pmsm_sim *sim, double T_s)
{
    const double C = sim->setup.U_dc_capacitance, limit = sim->setup.U_dc_chopper, R = sim->setup.U_dc_chopper_ohm;
    const double left = sim->U_dc * sim->U_dc - 2.0 * sim->inverter.energy / C;
    double charge = left > 0.0 ? sqrt(left) : 0.0;
    if (limit > 0.0 && charge > limit) {
        const double burnt = R > 0.0 ? charge * (1.0 - T_s / (R * C)) : limit;
        charge = burnt > limit ? burnt : limit;
    }
    sim->link_charge = charge;
}

/* ---- sampling ----------------------------------------------------------------------------------------------- */

/* Terminal currents as they reach the sensors' output. */
static void catch_currents(const pmsm_sim *sim, double i[3])
{
    const pmsm_plant *plant = &sim->plant;
    const double hidden = sim->setup.iron_hidden;
    for (int x = 0; x < 3; x++) {
        i[x] = sim->lag.tau > 0.0 ? sim->lag.value[x] : pmsm_plant_leg_current(plant, x);
        if (hidden > 0.0)
            i[x] -= hidden * (pmsm_leg_alpha[x] * plant->iron_alpha + pmsm_leg_beta[x] * plant->iron_beta);
    }
}

/* A low-side shunt reads its leg only while the bottom transistor conducts long enough around the sample. */
static void read_shunts(pmsm_sim *sim, const pmsm_output *acting, double T_s, double i[3])
{
    const double duty[3] = {(double)acting->duty_a, (double)acting->duty_b, (double)acting->duty_c};
    for (int x = 0; x < 3; x++) {
        if (acting->gates && (1.0 - duty[x]) * T_s < sim->setup.sensors.blind)
            i[x] = sim->i_read[x];
        else
            sim->i_read[x] = i[x];
    }
}

static double encoder(pmsm_sim *sim)
{
    const pmsm_plant_state *state = &sim->plant.state;
    const pmsm_sensor_setup *setup = &sim->setup.sensors;
    if (setup->fault == PMSM_SENSOR_ENCODER_STUCK && sim->encoder_is_held)
        return sim->encoder_held;
    const double theta_M = state->theta_M + (double)state->turns * PMSM_REAL64_TWO_PI;
    sim->encoder_held =
        pmsm_sensor_angle(setup, &sim->random, theta_M, state->omega_M, sim->plant.machine.pole_pairs);
    sim->encoder_is_held = 1;
    return sim->encoder_held;
}

/* An unwrapped angle (rad) as the encoder's counters show it. */
static void read_encoder(double theta_M, pmsm_sensors *sensors)
{
    const double parts = theta_M * (4294967296.0 / PMSM_REAL64_TWO_PI);
    sensors->encoder_failed = pmsm_real64_abs(theta_M) <= ANGLE_MOST ? 0u : 1u;
    if (sensors->encoder_failed)
        return;
    const uint64_t counted = (uint64_t)(int64_t)(parts < 0.0 ? parts - 0.5 : parts + 0.5);
    sensors->turns = (int32_t)(uint32_t)(counted >> 32);
    sensors->angle = (uint32_t)counted;
}

static int64_t whole_turns(double theta_M)
{
    const double turns = theta_M * (1.0 / PMSM_REAL64_TWO_PI);
    return (int64_t)turns - (turns < (double)(int64_t)turns ? 1 : 0);
}

/* Zero of the count of an encoder that has not passed its index yet. */
static double unreferenced(pmsm_sim *sim, double theta_M, pmsm_sensors *sensors)
{
    sensors->encoder_unreferenced = 0;
    if (sim->setup.sensors.encoder != PMSM_SENSOR_INDEX || sim->encoder_indexed)
        return 0.0;
    if (!sim->encoder_on)
        sim->encoder_zero = theta_M;
    sim->encoder_on = 1;
    sim->encoder_indexed = whole_turns(theta_M) != whole_turns(sim->encoder_zero);
    sensors->encoder_unreferenced = sim->encoder_indexed ? 0u : 1u;
    return sim->encoder_indexed ? 0.0 : sim->encoder_zero;
}

static void sample(pmsm_sim *sim, const pmsm_output *acting, double T_s, double theta_M, pmsm_sensors *sensors)
{
    const pmsm_sensor_setup *setup = &sim->setup.sensors;
    const double drifted = setup->drift * 1e-9 * (double)sim->t_ns, drift[3] = {drifted, -drifted, 0.0};
    double i[3], seen[3];
    if (sim->has_early)
        memcpy(i, sim->early, sizeof i);
    else
        catch_currents(sim, i);
    if (setup->blind > 0.0)
        read_shunts(sim, acting, T_s, i);
    sensors->adc_clipped = 0;
    for (int x = 0; x < 3; x++)
        seen[x] = sim->ideal ? i[x] : pmsm_sensor_current(setup, &sim->random, x, i[x] + drift[x], &sensors->adc_clipped);
    sensors->i_a = (float)seen[0];
    sensors->i_b = (float)seen[1];
    sensors->i_c = (float)seen[2];
    sensors->hall = pmsm_sensor_hall(setup, sim->plant.machine.pole_pairs * sim->plant.state.theta_M);
    sensors->U_dc = (float)(setup->U_dc_gain * sim->U_dc);
    sensors->T_winding = (float)(setup->T_lag > 0.0 ? sim->T_winding_shown : sim->plant.T_winding);
    sensors->T_magnet = (float)sim->plant.T_magnet;
    read_encoder(theta_M - unreferenced(sim, theta_M, sensors), sensors);
    sensors->encoder_failed |= (setup->encoder == PMSM_SENSOR_NO_ENCODER) ? 1u : 0u;
    sensors->limits = 0;
    if (sim->has_switches) {
        const double shaft = sim->plant.state.theta_M + (double)sim->plant.state.turns * PMSM_REAL64_TWO_PI;
        sensors->limits = (shaft <= sim->switch_negative ? 1u : 0u) | (shaft >= sim->switch_positive ? 2u : 0u);
    }
}

/* ---- the core alone ------------------------------------------------------------------------------------------- */

/* What the papers assume: the exact angle and speed, no trips. The application would feed the core its estimate, which
 * starts late and is rounded: no second one stands here, only what it is left out for. */
static void run_core(pmsm_sim *sim, double theta_M, const pmsm_sensors *sensors, pmsm_output *output)
{
    const pmsm_drive *drive = sim->drive;
    pmsm_application *app = &sim->drive->application;
    const double direction = drive->params.encoder_reversed ? -1.0 : 1.0;
    const double theta = direction * (double)drive->params.motor_pole_pairs * theta_M
                         - (double)drive->params.encoder_offset_rad;
    const double turns = theta * (1.0 / PMSM_REAL64_TWO_PI);
    const double whole = (double)(int64_t)(turns < 0.0 ? turns - 0.5 : turns + 0.5);
    const pmsm_measurement m = {
        (pmsm_real)sensors->i_a,
        (pmsm_real)sensors->i_b,
        (pmsm_real)sensors->i_c,
        (pmsm_real)(theta - whole * PMSM_REAL64_TWO_PI),
        (pmsm_real)((double)drive->params.motor_pole_pairs * sim->plant.state.omega_M),
        (pmsm_real)sensors->U_dc,
        (pmsm_real)sensors->T_winding,
    };
    app->sensors = *sensors;
    pmsm_step(&app->control, &drive->params, drive->lut, &m, &app->reference, output);
}

/* ---- record ----------------------------------------------------------------------------------------------------- */

static double truth(const pmsm_sim *sim, uint32_t signal)
{
    const pmsm_plant *plant = &sim->plant;
    const pmsm_plant_state *state = &plant->state;
    const double p = plant->machine.pole_pairs;
    switch (signal) {
    case PMSM_TRUTH_T: return 1e-9 * (double)sim->t_ns;
    case PMSM_TRUTH_I_D: return state->i_d;
    case PMSM_TRUTH_I_Q: return state->i_q;
    case PMSM_TRUTH_I_A: return pmsm_plant_leg_current(plant, 0);
    case PMSM_TRUTH_I_B: return pmsm_plant_leg_current(plant, 1);
    case PMSM_TRUTH_I_C: return pmsm_plant_leg_current(plant, 2);
    case PMSM_TRUTH_PSI_D: return state->cos_e * state->psi_alpha + state->sin_e * state->psi_beta;
    case PMSM_TRUTH_PSI_Q: return state->cos_e * state->psi_beta - state->sin_e * state->psi_alpha;
    case PMSM_TRUTH_PSI_ALPHA: return state->psi_alpha;
    case PMSM_TRUTH_PSI_BETA: return state->psi_beta;
    case PMSM_TRUTH_THETA_E: {
        const double turns = p * state->theta_M / PMSM_REAL64_TWO_PI;
        const double whole = (double)(int64_t)(turns < 0.0 ? turns - 0.5 : turns + 0.5);
        return p * state->theta_M - whole * PMSM_REAL64_TWO_PI;
    }
    case PMSM_TRUTH_THETA_M: return state->theta_M + (double)state->turns * PMSM_REAL64_TWO_PI;
    case PMSM_TRUTH_OMEGA_M: return state->omega_M;
    case PMSM_TRUTH_TORQUE: return state->torque;
    case PMSM_TRUTH_LOAD: return plant->load;
    case PMSM_TRUTH_U_DC: return sim->U_dc;
    case PMSM_TRUTH_T_WINDING: return plant->T_winding;
    case PMSM_TRUTH_T_MAGNET: return plant->T_magnet;
    case PMSM_TRUTH_DUTY_A: return (double)sim->output.duty_a;
    case PMSM_TRUTH_DUTY_B: return (double)sim->output.duty_b;
    case PMSM_TRUTH_DUTY_C: return (double)sim->output.duty_c;
    case PMSM_TRUTH_GATES: return (double)sim->output.gates;
    case PMSM_TRUTH_U_ALPHA: return (double)sim->output.u_alpha;
    case PMSM_TRUTH_U_BETA: return (double)sim->output.u_beta;
    case PMSM_TRUTH_OMEGA_LOAD: return plant->machine.J_load > 0.0 ? state->omega_load : state->omega_M;
    case PMSM_TRUTH_TWIST: return state->twist;
    case PMSM_TRUTH_R: return plant->R;
    case PMSM_TRUTH_U_ALPHA_MEAN:
        return sim->inverter.elapsed > 0.0 ? sim->inverter.volt_seconds_alpha / sim->inverter.elapsed : 0.0;
    case PMSM_TRUTH_U_BETA_MEAN:
        return sim->inverter.elapsed > 0.0 ? sim->inverter.volt_seconds_beta / sim->inverter.elapsed : 0.0;
    case PMSM_TRUTH_TRIP: return (double)sim->drive->application.trip;
    default: return 0.0;
    }
}

double pmsm_sim_signal(const pmsm_sim *sim, uint32_t signal)
{
    return signal < (uint32_t)PMSM_TRUTH_T ? (double)pmsm_application_signal(&sim->drive->application, signal)
                                           : truth(sim, signal);
}

static void write_row(pmsm_sim *sim)
{
    if (sim->record_row >= sim->record_rows || ++sim->record_count < sim->record_decimation)
        return;
    double *row = sim->record + sim->record_row * sim->record_signals;
    for (uint32_t j = 0; j < sim->record_signals; j++)
        row[j] = pmsm_sim_signal(sim, sim->record_signal[j]);
    sim->record_row++;
    sim->record_count = 0;
}

/* ---- one period --------------------------------------------------------------------------------------------------- */

static void begin_inverter(pmsm_sim *sim, const pmsm_output *acting, double T_s)
{
    const double duty[3] = {(double)acting->duty_a, (double)acting->duty_b, (double)acting->duty_c};
    pmsm_inverter_begin(&sim->inverter, duty, acting->gates, sim->U_dc, T_s);
}

static void run_period(pmsm_sim *sim)
{
    const double T_s = 1e-9 * (double)(sim->setup.T_s_ns ? sim->setup.T_s_ns : sim->drive->params.inverter_T_s_ns);
    const double t = 1e-9 * (double)sim->t_ns, shift = sim->setup.sampling_shift;
    const uint32_t delay = sim->setup.delay;
    pmsm_output acting = sim->pending[0];
    pmsm_sensors sensors;
    double done = 0.0;

    if (sim->scheduled)
        apply_schedules(sim, t, T_s);
    sim->U_dc = dc_link(sim, t + 0.5 * T_s);
    const double theta_M = encoder(sim);
    if (shift > 0.0 && delay > 0u) {
        begin_inverter(sim, &acting, T_s);
        pmsm_inverter_run(&sim->inverter, &sim->plant, &sim->lag, 0.0, shift);
        done = shift;
    }
    sample(sim, &acting, T_s, theta_M, &sensors);
    if (sim->setup.application == PMSM_RUNS_CORE)
        run_core(sim, theta_M, &sensors, &sim->output);
    else
        pmsm_application_period(&sim->drive->application, &sensors, &sim->output);
    if (sim->record_rows)
        write_row(sim);

    if (delay == 0u) {
        acting = sim->output;
    } else {
        for (uint32_t j = 0; j + 1u < delay; j++)
            sim->pending[j] = sim->pending[j + 1u];
        sim->pending[delay - 1u] = sim->output;
        if (!sim->output.gates && acting.gates) { /* releasing the gates takes no computation */
            acting.gates = 0;
            done = shift > 0.0 ? -1.0 : 0.0;
        }
    }
    if (done <= 0.0) {
        begin_inverter(sim, &acting, T_s);
        done = done < 0.0 ? shift : 0.0;
    }
    sim->has_early = 0;
    if (shift < 0.0) {
        pmsm_inverter_run(&sim->inverter, &sim->plant, &sim->lag, done, T_s + shift);
        catch_currents(sim, sim->early);
        sim->has_early = 1;
        done = T_s + shift;
    }
    pmsm_inverter_run(&sim->inverter, &sim->plant, &sim->lag, done, T_s);
    if (sim->setup.U_dc_source > 0.0)
        load_link(sim, &acting, T_s);
    if (sim->inverter.metered)
        charge_link(sim, T_s);
    if (sim->plant.machine.thermal_capacity > 0.0)
        pmsm_plant_heat(&sim->plant, T_s);
    if (sim->setup.sensors.T_lag > 0.0)
        sim->T_winding_shown += (sim->plant.T_winding - sim->T_winding_shown) * T_s / (sim->setup.sensors.T_lag + T_s);
    sim->t_ns += sim->setup.T_s_ns ? sim->setup.T_s_ns : sim->drive->params.inverter_T_s_ns;
    sim->period++;
}

static uint32_t has_news(pmsm_sim *sim)
{
    const pmsm_application *app = &sim->drive->application;
    const uint32_t now[PMSM_WATCHED] = {app->trip, app->excitation.state, app->recorder.state, app->average.state,
                                        app->position.flags, app->position.homing};
    const uint32_t changed = memcmp(now, sim->seen, sizeof now) != 0;
    memcpy(sim->seen, now, sizeof now);
    return changed;
}

uint64_t pmsm_sim_run(pmsm_sim *sim, uint64_t n)
{
    if (sim->watch)
        (void)has_news(sim); /* what the caller changed itself is no news */
    for (uint64_t k = 0; k < n; k++) {
        run_period(sim);
        if (sim->watch && has_news(sim))
            return k + 1u;
    }
    return n;
}

/* ---- set-up ---------------------------------------------------------------------------------------------------------- */

void pmsm_sim_start(pmsm_sim *sim, pmsm_drive *drive, const pmsm_sim_setup *setup)
{
    memset(sim, 0, sizeof *sim);
    sim->setup = *setup;
    sim->drive = drive;
    sim->plant.machine = setup->machine;
    sim->plant.T_winding = setup->T_winding;
    sim->plant.T_magnet = setup->T_magnet;
    sim->plant.load = setup->load;
    pmsm_plant_start(&sim->plant, setup->theta_M, setup->omega_M);
    sim->inverter.setup = setup->inverter;
    pmsm_inverter_start(&sim->inverter, &sim->plant);
    sim->inverter.metered = setup->U_dc_capacitance > 0.0 ? 1u : 0u;
    sim->lag.tau = setup->sensor_lag;
    sim->lag.decay_h = -1.0;
    sim->T_winding_shown = setup->T_winding;
    sim->U_dc = setup->U_dc;
    pmsm_random_seed(&sim->random, setup->seed);
    sim->ideal = (uint32_t)pmsm_sensor_is_ideal(&setup->sensors);
    if (setup->application == PMSM_RUNS_CORE) { /* as if it had run at zero voltage before */
        const pmsm_output zero = {(pmsm_real)0.5, (pmsm_real)0.5, (pmsm_real)0.5, (pmsm_real)0, (pmsm_real)0, 1u};
        for (uint32_t j = 0; j < PMSM_DELAY_MAX; j++)
            sim->pending[j] = zero;
    }
    drive->application.speed.omega = (float)(
        (setup->sensors.encoder_reversed != drive->params.encoder_reversed ? -1.0 : 1.0) * sim->plant.state.omega_M);
}

void pmsm_sim_watch(pmsm_sim *sim, uint32_t watch)
{
    sim->watch = watch;
}

void pmsm_sim_set_schedule(pmsm_sim *sim, uint32_t target, uint32_t n, const double *t, const double *value)
{
    const pmsm_schedule schedule = {n ? t : NULL, value, n, 0};
    if (target >= (uint32_t)PMSM_TARGET_COUNT)
        return;
    sim->schedule[target] = schedule;
    sim->scheduled = n ? sim->scheduled | 1u << target : sim->scheduled & ~(1u << target);
}

void pmsm_sim_set_record(pmsm_sim *sim, double *record, uint64_t rows, uint32_t n, const uint32_t *signals,
                         uint32_t decimation)
{
    sim->record = record;
    sim->record_rows = n <= PMSM_RECORD_SIGNALS ? rows : 0;
    sim->record_row = 0;
    sim->record_signals = n;
    sim->record_decimation = decimation;
    sim->record_count = decimation - 1u; /* the next period is a row */
    for (uint32_t j = 0; j < n && j < PMSM_RECORD_SIGNALS; j++)
        sim->record_signal[j] = signals[j];
}

uint64_t pmsm_sim_recorded(const pmsm_sim *sim)
{
    return sim->record_row;
}

uint64_t pmsm_sim_time_ns(const pmsm_sim *sim)
{
    return sim->t_ns;
}

void pmsm_sim_set_load(pmsm_sim *sim, double load)
{
    sim->plant.load = load;
}

void pmsm_sim_set_rotor(pmsm_sim *sim, uint32_t rotor, double omega_M)
{
    sim->plant.machine.rotor = rotor;
    sim->plant.state.sticking = 0;
    sim->plant.acceleration = 0.0;
    if (rotor != PMSM_ROTOR_FREE) {
        sim->plant.state.omega_M = rotor == PMSM_ROTOR_LOCKED ? 0.0 : omega_M;
        sim->plant.state.omega_load = sim->plant.state.omega_M;
        sim->plant.state.twist = 0.0;
    }
}

void pmsm_sim_set_open(pmsm_sim *sim, uint32_t a, uint32_t b, uint32_t c)
{
    const uint32_t open[3] = {a, b, c};
    for (int x = 0; x < 3; x++) {
        if (open[x] && !sim->inverter.setup.open[x])
            pmsm_plant_clear_current(&sim->plant, x); /* the arc is shorter than anything resolved here */
        sim->inverter.setup.open[x] = sim->setup.inverter.open[x] = open[x];
    }
}

void pmsm_sim_set_switches(pmsm_sim *sim, double negative, double positive)
{
    sim->switch_negative = negative;
    sim->switch_positive = positive;
    sim->has_switches = 1;
}

void pmsm_sim_set_U_dc(pmsm_sim *sim, double U_dc)
{
    sim->setup.U_dc = U_dc;
}

void pmsm_sim_set_temperatures(pmsm_sim *sim, double T_winding, double T_magnet)
{
    pmsm_plant_set_temperatures(&sim->plant, T_winding, T_magnet);
    pmsm_plant_refresh(&sim->plant);
}

uint64_t pmsm_sim_outside_count(const pmsm_sim *sim)
{
    return sim->plant.outside_count;
}

uint64_t pmsm_sim_overrun_count(const pmsm_sim *sim)
{
    return sim->plant.event_overruns + sim->inverter.event_overruns;
}

/* ---- for tests ---------------------------------------------------------------------------------------------------------- */

void pmsm_sim_drive_plant(pmsm_sim *sim, uint64_t n, double h, const double *u, double *i)
{
    pmsm_supply supply = {{0.0, 0.0, 0.0}, {0.0, 0.0, 0.0}, NULL, -1, 0, 0, 0.0, 0.0, 0.0};
    for (uint64_t k = 0; k < n; k++) {
        supply.alpha = u[2u * k];
        supply.beta = u[2u * k + 1u];
        pmsm_plant_advance(&sim->plant, &supply, h);
        i[2u * k] = sim->plant.state.i_d;
        i[2u * k + 1u] = sim->plant.state.i_q;
    }
}

double pmsm_sim_elementary(uint32_t which, double x)
{
    double s, c;
    switch (which) {
    case 0:
        pmsm_real64_sincos(x, &s, &c);
        return s;
    case 1:
        pmsm_real64_sincos(x, &s, &c);
        return c;
    case 2: return pmsm_real64_exp(x);
    case 3: return pmsm_real64_log(x);
    case 4: return pmsm_real64_tanh(x);
    default: return pmsm_real64_atan(x);
    }
}

void pmsm_sim_normal(uint64_t seed, uint64_t n, double *out)
{
    pmsm_random random;
    pmsm_random_seed(&random, seed);
    for (uint64_t k = 0; k < n; k++)
        out[k] = pmsm_random_normal(&random);
}
