/* SPDX-License-Identifier: MIT */
/* Check, take and give the packed parameter image (the bytes of object 0x2001). */
#ifndef PMSM_IMAGE_H
#define PMSM_IMAGE_H

#include "pmsm_params.h"

#ifdef __cplusplus
extern "C" {
#endif

enum pmsm_image_status {
    PMSM_IMAGE_OK = 0,
    PMSM_IMAGE_SIZE = 1,      /* not the size that scalars and look-up descriptor announce */
    PMSM_IMAGE_SCHEMA = 2,    /* another schema version */
    PMSM_IMAGE_SIGNATURE = 3, /* another layout */
    PMSM_IMAGE_CRC = 4,       /* damaged */
    PMSM_IMAGE_RANGE = 5,     /* a member outside its bounds, or not a number */
    PMSM_IMAGE_LUT_SIZE = 6,  /* look-up words do not match the descriptor, or exceed the capacity */
    PMSM_IMAGE_LUT_AXIS = 7   /* an axis does not increase strictly */
};

/* CRC-32 (IEEE 802.3, as zlib) of the image bytes. */
PMSM_EXPORT uint32_t pmsm_image_crc32(const uint8_t *image, uint32_t size);

/* Index of the first member outside its bounds, PMSM_PARAMS_WORDS when all are inside. */
PMSM_EXPORT uint32_t pmsm_params_check(const pmsm_params *params);

/* Words of axes and tables the descriptor announces; cannot overflow for members inside their bounds. */
PMSM_EXPORT uint32_t pmsm_lut_words(const pmsm_params *params);

/* Is the image what its sender says it is? enum pmsm_image_status; checks in the order schema, signature, CRC,
 * size, ranges, look-up. */
PMSM_EXPORT uint32_t pmsm_image_check(const uint8_t *image, uint32_t size, uint32_t schema, uint32_t signature,
                                      uint32_t crc);

/* The checks that need no announced numbers: size, ranges, look-up. */
PMSM_EXPORT uint32_t pmsm_image_check_content(const uint8_t *image, uint32_t size);

/* Take a checked image; lut receives at most capacity words. enum pmsm_image_status. */
PMSM_EXPORT uint32_t pmsm_image_load(const uint8_t *image, uint32_t size, pmsm_params *params, uint32_t *lut,
                                     uint32_t capacity);

/* Write the image of params and look-up words; returns its size in bytes (image has room for it). */
PMSM_EXPORT uint32_t pmsm_image_store(const pmsm_params *params, const uint32_t *lut, uint8_t *image);

#ifdef __cplusplus
}
#endif

#endif
