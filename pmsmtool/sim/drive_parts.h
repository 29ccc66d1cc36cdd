/* SPDX-License-Identifier: MIT */
/* The parts of the drive's application, one file each. Internal to sim/. */
#ifndef PMSM_DRIVE_PARTS_H
#define PMSM_DRIVE_PARTS_H

#include "drive.h"
#include "pmsm_math.h"

/* drive_excitation.c: obey the command, and put the excitation's share into reference and frame angle. */
void pmsm_drive_excite(pmsm_drive *drive, pmsm_reference *reference, float *angle);
void pmsm_drive_excitation_init(pmsm_drive *drive);
/* Electrical angle of the rotor by the encoder (rad, within one turn). */
float pmsm_drive_rotor_angle(const pmsm_drive *drive);

/* drive_recorder.c: trace and window averages, after the control step of the period. */
void pmsm_drive_record(pmsm_drive *drive);
void pmsm_drive_average(pmsm_drive *drive);

#endif
