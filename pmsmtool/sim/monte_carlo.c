/* SPDX-License-Identifier: MIT */
/* Many drives over all cores; see monte_carlo.h. */
#if !defined(_WIN32) && !defined(_POSIX_C_SOURCE)
#define _POSIX_C_SOURCE 200112L /* strict C99 hides the threads otherwise */
#endif

#include "monte_carlo.h"

#include <math.h> /* sqrt and fabs only: exact everywhere */
#include <stddef.h>
#include <string.h>

#ifdef _WIN32
#define WIN32_LEAN_AND_MEAN
#include <windows.h>
typedef HANDLE thread_id;
#else
#include <pthread.h>
typedef pthread_t thread_id;
#endif

typedef struct {
    const pmsm_monte_carlo *all;
    uint32_t *next;            /* first drive that nobody has taken */
    pmsm_sim *sim;
    pmsm_drive *drive;
} worker;

static uint64_t whole_doubles(uint64_t bytes)
{
    return (bytes + sizeof(double) - 1u) / sizeof(double) * sizeof(double);
}

/* ---- one drive -------------------------------------------------------------------------------------------------- */

static void look(const pmsm_sim *sim, pmsm_drive_run *r)
{
    const pmsm_plant_state *state = &sim->plant.state;
    const uint32_t flags = sim->drive->application.control.live.flags;
    const double square = state->i_d * state->i_d + state->i_q * state->i_q;
    const double alpha = (double)sim->output.u_alpha, beta = (double)sim->output.u_beta;
    const double voltage = sim->U_dc > 0.0 ? (alpha * alpha + beta * beta) / (sim->U_dc * sim->U_dc) : 0.0;
    if (square > r->i_peak) /* the roots follow at the end */
        r->i_peak = square;
    if (voltage > r->u_peak)
        r->u_peak = voltage;
    if (fabs(state->omega_M) > r->omega_peak)
        r->omega_peak = fabs(state->omega_M);
    r->i_square += square;
    r->torque += fabs(state->torque);
    r->infeasible += (flags & (PMSM_FLAG_GOVERNOR_FALLBACK | PMSM_FLAG_FW_EMPTY)) != 0u;
}

static void run_drive(const worker *by, uint32_t k)
{
    const pmsm_monte_carlo *all = by->all;
    pmsm_drive_run r;
    memset(&r, 0, sizeof r);
    memcpy(by->drive, all->model->drive, sizeof *by->drive);
    pmsm_sim_start(by->sim, by->drive, &all->setup[k]);
    memcpy(by->sim->schedule, all->model->schedule, sizeof by->sim->schedule);
    by->sim->scheduled = all->model->scheduled;
    for (uint64_t period = 0; period < all->periods; period++) {
        (void)pmsm_sim_run(by->sim, 1u);
        look(by->sim, &r);
    }
    r.i_peak = sqrt(r.i_peak);
    r.u_peak = sqrt(r.u_peak);
    if (all->periods) {
        r.i_square /= (double)all->periods;
        r.torque /= (double)all->periods;
    }
    r.outside = pmsm_sim_outside_count(by->sim);
    r.trip = by->drive->application.trip;
    all->result[k] = r;
}

/* ---- threads ---------------------------------------------------------------------------------------------------- */

static void work(const worker *by)
{
    for (;;) {
        const uint32_t k = __atomic_fetch_add(by->next, 1u, __ATOMIC_RELAXED);
        if (k >= by->all->n)
            return;
        run_drive(by, k);
    }
}

#ifdef _WIN32
static DWORD WINAPI thread_main(LPVOID by)
{
    work((const worker *)by);
    return 0;
}

static int start(thread_id *id, worker *by)
{
    *id = CreateThread(NULL, 0, thread_main, by, 0, NULL);
    return *id != NULL;
}

static void join(thread_id id)
{
    (void)WaitForSingleObject(id, INFINITE);
    (void)CloseHandle(id);
}
#else
static void *thread_main(void *by)
{
    work((const worker *)by);
    return NULL;
}

static int start(thread_id *id, worker *by)
{
    return pthread_create(id, NULL, thread_main, by) == 0;
}

static void join(thread_id id)
{
    (void)pthread_join(id, NULL);
}
#endif

uint64_t pmsm_monte_carlo_memory(void)
{
    return whole_doubles(sizeof(pmsm_sim)) + whole_doubles(sizeof(pmsm_drive));
}

uint32_t pmsm_monte_carlo_layout(uint32_t what)
{
    return (uint32_t)(what ? sizeof(pmsm_drive_run) : sizeof(pmsm_monte_carlo));
}

uint32_t pmsm_monte_carlo_run(const pmsm_monte_carlo *all)
{
    thread_id id[PMSM_MONTE_CARLO_THREADS_MAX];
    worker each[PMSM_MONTE_CARLO_THREADS_MAX];
    uint32_t next = 0, threads = all->threads, started = 1;
    if (threads > all->n)
        threads = all->n;
    if (threads > PMSM_MONTE_CARLO_THREADS_MAX)
        threads = PMSM_MONTE_CARLO_THREADS_MAX;
    if (threads < 1u)
        threads = 1u;
    for (uint32_t k = 0; k < threads; k++) {
        unsigned char *memory = (unsigned char *)all->memory + k * pmsm_monte_carlo_memory();
        each[k].all = all;
        each[k].next = &next;
        each[k].sim = (pmsm_sim *)(void *)memory;
        each[k].drive = (pmsm_drive *)(void *)(memory + whole_doubles(sizeof(pmsm_sim)));
    }
    while (started < threads && start(&id[started], &each[started]))
        started++;
    work(&each[0]); /* the caller's own thread works as well */
    for (uint32_t k = 1; k < started; k++)
        join(id[k]);
    return started;
}
