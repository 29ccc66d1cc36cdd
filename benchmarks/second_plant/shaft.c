/* SPDX-License-Identifier: MIT */
/* Torques on the shaft. Friction, drag and cogging act on the rotor, the load on the mass at the shaft's end. */
#include <math.h>

#include "phase_machine.h"

static double coupling(const pmsm_machine *machine, double twist, double slip)
{
    return machine->coupling_stiffness * twist + machine->coupling_damping * slip;
}

/* All torque on the rotor but Coulomb friction. */
static double moving_torque(const pmsm_plant *plant, double theta, double omega, double twist, double omega_load,
                            double torque)
{
    const pmsm_machine *machine = &plant->machine;
    double sum = torque - machine->B * omega - machine->drag * omega * fabs(omega);
    if (machine->cogging != 0.0)
        sum -= machine->cogging * sin(machine->cogging_periods * theta);
    if (machine->J_load > 0.0)
        return sum - coupling(machine, twist, omega - omega_load);
    return sum - plant->load - machine->load_viscous * omega;
}

double shaft_direction(const pmsm_plant *plant, double torque)
{
    const pmsm_plant_state *state = &plant->state;
    if (state->omega_M != 0.0)
        return state->omega_M > 0.0 ? 1.0 : -1.0;
    const double pull = moving_torque(plant, state->theta_M, 0.0, state->twist, state->omega_load, torque);
    if (fabs(pull) <= plant->machine.tau_c)
        return 0.0;
    return pull > 0.0 ? 1.0 : -1.0;
}

shaft_acceleration shaft_accelerate(const pmsm_plant *plant, double theta, double omega, double twist,
                                    double omega_load, double torque, double direction)
{
    const pmsm_machine *machine = &plant->machine;
    shaft_acceleration a = {0.0, 0.0};
    if (machine->rotor == PMSM_ROTOR_DRIVEN)
        a.rotor = plant->acceleration;
    else if (machine->rotor == PMSM_ROTOR_FREE && (direction != 0.0 || machine->tau_c == 0.0))
        a.rotor = (moving_torque(plant, theta, omega, twist, omega_load, torque) - direction * machine->tau_c)
                  / machine->J;
    if (machine->J_load > 0.0)
        a.load = machine->rotor == PMSM_ROTOR_FREE
                     ? (coupling(machine, twist, omega - omega_load) - plant->load
                        - machine->load_viscous * omega_load)
                           / machine->J_load
                     : a.rotor; /* held or turned together */
    return a;
}
