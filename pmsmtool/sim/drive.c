/* SPDX-License-Identifier: MIT */
/* The simulated drive's memory around the application. */
#include "drive.h"

#include <string.h>

#include "pmsm_image.h"

uint32_t pmsm_drive_size(void)
{
    return (uint32_t)sizeof(pmsm_drive);
}

void pmsm_drive_init(pmsm_drive *drive)
{
    pmsm_application *app = &drive->application;
    memset(drive, 0, sizeof *drive);
    pmsm_application_init(app, &drive->params, drive->lut);
    app->trace = drive->trace;
    app->trace_bytes = PMSM_TRACE_BYTES;
    app->buffer = drive->buffer;
    app->buffer_length = PMSM_BUFFER_SAMPLES;
}

uint32_t pmsm_drive_load(pmsm_drive *drive, const uint8_t *image, uint32_t size)
{
    const uint32_t status = pmsm_image_load(image, size, &drive->params, drive->lut, PMSM_LUT_WORDS);
    if (status == PMSM_IMAGE_OK) {
        pmsm_application_parameters_changed(&drive->application);
    }
    return status;
}
