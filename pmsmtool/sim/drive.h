/* SPDX-License-Identifier: MIT */
/* The simulated drive: the application of firmware/application with memory of its own. The CANopen node (Python) reads
 * and writes its parts between calls; it never loops over periods.
 */
#ifndef PMSM_DRIVE_H
#define PMSM_DRIVE_H

#include "pmsm_application.h"

#define PMSM_TRACE_BYTES 65536u
#define PMSM_BUFFER_SAMPLES 4096u
#define PMSM_LUT_WORDS 8192u

typedef struct pmsm_drive {
    pmsm_params params;                 /* active set */
    uint32_t lut[PMSM_LUT_WORDS];
    pmsm_application application;
    float buffer[PMSM_BUFFER_SAMPLES];
    uint8_t trace[PMSM_TRACE_BYTES];
} pmsm_drive;

/* Bytes of a pmsm_drive (for the caller who allocates it). */
PMSM_EXPORT uint32_t pmsm_drive_size(void);
/* As after a reset: no parameters yet, everything cleared. */
PMSM_EXPORT void pmsm_drive_init(pmsm_drive *drive);
/* Take an image (params + lut words); returns 0, or the reason it was refused (enum pmsm_image_status). */
PMSM_EXPORT uint32_t pmsm_drive_load(pmsm_drive *drive, const uint8_t *image, uint32_t size);

#endif
