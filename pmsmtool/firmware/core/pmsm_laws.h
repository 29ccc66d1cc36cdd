/* SPDX-License-Identifier: MIT */
/* Laws that are compiled in, 1 or 0. Here all of them; an export leaves out those its parameter set does not use. */
#ifndef PMSM_LAWS_H
#define PMSM_LAWS_H

#define PMSM_LAW_GOVERNOR 1        /* governor.mode above 0 */
#define PMSM_LAW_FIELD_WEAKENING 1 /* field_weakening.mode above 1; a table needs none */
#define PMSM_LAW_POLAR 1           /* polar.mode above 0 */

#endif
