/* Many simulations in one call. */
#ifndef PMSM_BATCH_H
#define PMSM_BATCH_H

#include "closed_loop.h"

/* Run each of count simulations by the same number of periods, one after the other. */
PMSM_EXPORT void pmsm_sim_run_batch(pmsm_sim *const *sims, uint64_t count, uint64_t periods);

#endif
