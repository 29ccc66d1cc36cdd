/* SPDX-License-Identifier: MIT */
/* The packed parameter image: check, take, give. Byte order is handled here, so any target may be used. */
#include "pmsm_image.h"
#include "pmsm_modes.h"

static uint32_t word_at(const uint8_t *image, uint32_t word)
{
    const uint8_t *p = image + 4u * word;
    return (uint32_t)p[0] | ((uint32_t)p[1] << 8) | ((uint32_t)p[2] << 16) | ((uint32_t)p[3] << 24);
}

typedef union {
    float f;
    uint32_t u;
} float_bits;

static float float_at(const uint8_t *image, uint32_t word)
{
    float_bits bits;
    bits.u = word_at(image, word);
    return bits.f;
}

typedef union {
    pmsm_params params;
    uint32_t word[PMSM_PARAMS_WORDS];
} params_words;

uint32_t pmsm_image_crc32(const uint8_t *image, uint32_t size)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu};
    uint32_t crc = 0xFFFFFFFFu;
    for (uint32_t k = 0u; k < size; k++) {
        crc ^= image[k];
        crc = (crc >> 4) ^ table[crc & 15u];
        crc = (crc >> 4) ^ table[crc & 15u];
    }
    return crc ^ 0xFFFFFFFFu;
}

/* NaN fails every comparison, so it is outside. */
static uint32_t is_inside(uint32_t word, const pmsm_param_limit *limit)
{
    if (limit->is_integer != 0u) {
        return (word >= (uint32_t)limit->minimum && word <= (uint32_t)limit->maximum) ? 1u : 0u;
    }
    float_bits bits;
    bits.u = word;
    return (bits.f >= limit->minimum && bits.f <= limit->maximum) ? 1u : 0u;
}

uint32_t pmsm_params_check(const pmsm_params *params)
{
    params_words all;
    all.params = *params;
    uint32_t k = 0u;
    while (k < PMSM_PARAMS_WORDS && is_inside(all.word[k], &pmsm_param_limits[k]) != 0u) {
        k++;
    }
    return k;
}

static uint32_t saturation_words(const pmsm_params *params)
{
    return params->saturation_n_d * params->saturation_n_q * PMSM_SATURATION_VALUES;
}

static uint32_t look_up_words(const pmsm_params *params)
{
    if (params->lut_format == PMSM_LUT_NONE) {
        return 0u;
    }
    const uint32_t cells = params->lut_n_x * params->lut_n_y * params->lut_n_z;
    const uint32_t table = (params->lut_format == PMSM_LUT_BINARY32) ? cells : (cells + 1u) / 2u;
    return params->lut_n_x + params->lut_n_y + params->lut_n_z + 2u * table;
}

uint32_t pmsm_lut_words(const pmsm_params *params)
{
    return look_up_words(params) + saturation_words(params);
}

/* Finite and strictly increasing; a NaN or an infinite end fails one of the comparisons. */
static uint32_t axis_increases(const uint8_t *image, uint32_t first, uint32_t count)
{
    const float largest = 3.40282347e38F;
    float last = float_at(image, first);
    if (!(last >= -largest)) {
        return 0u;
    }
    for (uint32_t k = 1u; k < count; k++) {
        const float node = float_at(image, first + k);
        if (!(node > last)) {
            return 0u;
        }
        last = node;
    }
    return (last <= largest) ? 1u : 0u;
}

/* Fluxes of a machine, and inductances that a gain can follow. */
static uint32_t check_saturation(const uint8_t *image, const pmsm_params *params)
{
    if (params->saturation_n_d == 0u && params->saturation_n_q == 0u) {
        return PMSM_IMAGE_OK;
    }
    if (params->saturation_n_d < 2u || params->saturation_n_q < 2u) {
        return PMSM_IMAGE_LUT_SIZE;
    }
    if (!(params->saturation_i_d_max_a > params->saturation_i_d_min_a) || !(params->saturation_i_q_max_a > 0.0F)) {
        return PMSM_IMAGE_LUT_AXIS;
    }
    const uint32_t first = PMSM_PARAMS_WORDS + look_up_words(params);
    for (uint32_t k = 0u; k < saturation_words(params); k++) {
        const float value = float_at(image, first + k);
        const float least = (k % PMSM_SATURATION_VALUES == 0u) ? -PMSM_FLUX_MOST : PMSM_INDUCTANCE_LEAST;
        const float most = (k % PMSM_SATURATION_VALUES == 0u) ? PMSM_FLUX_MOST : PMSM_INDUCTANCE_MOST;
        if (!(value >= least && value <= most)) {
            return PMSM_IMAGE_RANGE;
        }
    }
    return PMSM_IMAGE_OK;
}

static uint32_t check_lut(const uint8_t *image, uint32_t size, const pmsm_params *params)
{
    const uint32_t words = pmsm_lut_words(params);
    if (size != 4u * (PMSM_PARAMS_WORDS + words) || words > PMSM_PARAMS_LUT_WORDS_MAX) {
        return PMSM_IMAGE_LUT_SIZE;
    }
    const uint32_t saturation = check_saturation(image, params);
    if (saturation != PMSM_IMAGE_OK || params->lut_format == PMSM_LUT_NONE) {
        return saturation;
    }
    if (params->lut_n_x < 2u || params->lut_n_y < 2u || params->lut_n_z < 1u) {
        return PMSM_IMAGE_LUT_SIZE;
    }
    const uint32_t x = PMSM_PARAMS_WORDS;
    const uint32_t y = x + params->lut_n_x;
    const uint32_t z = y + params->lut_n_y;
    const uint32_t good = axis_increases(image, x, params->lut_n_x) & axis_increases(image, y, params->lut_n_y) &
                          axis_increases(image, z, params->lut_n_z);
    return (good != 0u) ? PMSM_IMAGE_OK : PMSM_IMAGE_LUT_AXIS;
}

static void read_params(const uint8_t *image, pmsm_params *params)
{
    params_words all;
    for (uint32_t k = 0u; k < PMSM_PARAMS_WORDS; k++) {
        all.word[k] = word_at(image, k);
    }
    *params = all.params;
}

uint32_t pmsm_image_check_content(const uint8_t *image, uint32_t size)
{
    pmsm_params params;
    if (size < 4u * PMSM_PARAMS_WORDS) {
        return PMSM_IMAGE_SIZE;
    }
    read_params(image, &params);
    if (pmsm_params_check(&params) != PMSM_PARAMS_WORDS) {
        return PMSM_IMAGE_RANGE;
    }
    return check_lut(image, size, &params);
}

uint32_t pmsm_image_check(const uint8_t *image, uint32_t size, uint32_t schema, uint32_t signature, uint32_t crc)
{
    if (schema != PMSM_PARAMS_SCHEMA_VERSION) {
        return PMSM_IMAGE_SCHEMA;
    }
    if (signature != PMSM_PARAMS_SIGNATURE) {
        return PMSM_IMAGE_SIGNATURE;
    }
    if (crc != pmsm_image_crc32(image, size)) {
        return PMSM_IMAGE_CRC;
    }
    return pmsm_image_check_content(image, size);
}

uint32_t pmsm_image_load(const uint8_t *image, uint32_t size, pmsm_params *params, uint32_t *lut, uint32_t capacity)
{
    const uint32_t status = pmsm_image_check_content(image, size);
    if (status != PMSM_IMAGE_OK) {
        return status;
    }
    const uint32_t words = size / 4u - PMSM_PARAMS_WORDS;
    if (words > capacity) {
        return PMSM_IMAGE_LUT_SIZE;
    }
    read_params(image, params);
    for (uint32_t k = 0u; k < words; k++) {
        lut[k] = word_at(image, PMSM_PARAMS_WORDS + k);
    }
    return PMSM_IMAGE_OK;
}

static void put_word(uint8_t *image, uint32_t word, uint32_t value)
{
    uint8_t *p = image + 4u * word;
    p[0] = (uint8_t)(value & 0xFFu);
    p[1] = (uint8_t)((value >> 8) & 0xFFu);
    p[2] = (uint8_t)((value >> 16) & 0xFFu);
    p[3] = (uint8_t)(value >> 24);
}

uint32_t pmsm_image_store(const pmsm_params *params, const uint32_t *lut, uint8_t *image)
{
    params_words all;
    all.params = *params;
    const uint32_t words = pmsm_lut_words(params);
    for (uint32_t k = 0u; k < PMSM_PARAMS_WORDS; k++) {
        put_word(image, k, all.word[k]);
    }
    for (uint32_t k = 0u; k < words; k++) {
        put_word(image, PMSM_PARAMS_WORDS + k, lut[k]);
    }
    return 4u * (PMSM_PARAMS_WORDS + words);
}
