/* SPDX-License-Identifier: MIT */
/* memset and memcpy for programs without a C library; only with PMSM_NO_C_LIBRARY defined.
 *
 * A compiler may call them to clear and copy structures, by these names or by those of the ARM run-time ABI. volatile
 * keeps it from making a call of itself of the loop. Nothing that runs in every period depends on their speed.
 */
#ifdef PMSM_NO_C_LIBRARY

#include <stddef.h>

void *memset(void *to, int value, size_t count);
void *memcpy(void *to, const void *from, size_t count);

void *memset(void *to, int value, size_t count)
{
    volatile unsigned char *byte = (volatile unsigned char *)to;
    for (size_t k = 0u; k < count; k++) {
        byte[k] = (unsigned char)value;
    }
    return to;
}

void *memcpy(void *to, const void *from, size_t count)
{
    volatile unsigned char *byte = (volatile unsigned char *)to;
    const unsigned char *source = (const unsigned char *)from;
    for (size_t k = 0u; k < count; k++) {
        byte[k] = source[k];
    }
    return to;
}

#ifdef __ARM_EABI__
#define PMSM_EABI(suffix)                                                        \
    void __aeabi_memclr##suffix(void *to, size_t count);                         \
    void __aeabi_memclr##suffix(void *to, size_t count)                          \
    {                                                                            \
        (void)memset(to, 0, count);                                              \
    }                                                                            \
    void __aeabi_memcpy##suffix(void *to, const void *from, size_t count);       \
    void __aeabi_memcpy##suffix(void *to, const void *from, size_t count)        \
    {                                                                            \
        (void)memcpy(to, from, count);                                           \
    }
PMSM_EABI()
PMSM_EABI(4)
PMSM_EABI(8)
#endif

#endif
