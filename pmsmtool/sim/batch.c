/* Many simulations in one call; see batch.h. */
#include "batch.h"

void pmsm_sim_run_batch(pmsm_sim *const *sims, uint64_t count, uint64_t periods)
{
    for (uint64_t k = 0; k < count; k++)
        (void)pmsm_sim_run(sims[k], periods);
}
