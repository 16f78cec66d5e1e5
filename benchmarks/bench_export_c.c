/* Times of a controller in C over recorded states: steps in sequence, each from the plan before. See bench_export_c.py.

   cc -std=c99 -O2 -I FOLDER -o driver bench_export_c.c FOLDER/controller.c -lm;  ./driver samples.bin COUNT PERIOD */

#define _POSIX_C_SOURCE 199309L
#include "controller.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

static nsde_work work;
static nsde_plan plan;
static nsde_command command;

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Time [ms]: of the clock, or of the processor for this thread, which other work of the computer leaves alone. */
static double now(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return 1e3 * (double)t.tv_sec + 1e-6 * (double)t.tv_nsec;
}

int main(int argc, char **argv)
{
    enum { WIDTH = NSDE_NX * (1 + NSDE_STEPS) };
    static double row[WIDTH];
    static nsde_real state[NSDE_NX], reference[NSDE_STEPS][NSDE_NX];
    if (argc != 4) return 2;
    FILE *file = fopen(argv[1], "rb");
    int count = atoi(argv[2]), converged = 0, iterations = 0;
    double *times = malloc((size_t)count * sizeof *times), *own = malloc((size_t)count * sizeof *own);
    if (!file || !times || !own) return 2;
    for (int n = 0; n < count; n++) {
        double start, end;
        if (fread(row, sizeof *row, WIDTH, file) != WIDTH) return 2;
        for (int i = 0; i < NSDE_NX; i++) state[i] = (nsde_real)row[i];
        for (int i = 0; i < NSDE_STEPS * NSDE_NX; i++) (&reference[0][0])[i] = (nsde_real)row[NSDE_NX + i];
        start = now(CLOCK_THREAD_CPUTIME_ID);
        times[n] = -now(CLOCK_MONOTONIC);
        int status = nsde_step(&work, state, 1, (nsde_real)atof(argv[3]), (const nsde_real(*)[NSDE_NX])reference, NULL,
                               NULL, NULL, &plan, &command);
        times[n] += now(CLOCK_MONOTONIC);
        end = now(CLOCK_THREAD_CPUTIME_ID);
        own[n] = end - start;
        converged += status == 0;
        iterations += command.iterations;
    }
    qsort(times, (size_t)count, sizeof *times, ascending);
    qsort(own, (size_t)count, sizeof *own, ascending);
    char line[128];
    FILE *about = fopen("/proc/self/status", "r");
    long memory = 0; /* largest resident size [kB] */
    while (about && fgets(line, sizeof line, about)) sscanf(line, "VmHWM: %ld", &memory);
    printf("{\"p50_ms\": %.4f, \"p90_ms\": %.4f, \"p99_ms\": %.4f, \"max_ms\": %.4f, ", times[count / 2],
           times[count * 9 / 10], times[count * 99 / 100], times[count - 1]);
    printf("\"p50_cpu_ms\": %.4f, \"p99_cpu_ms\": %.4f, \"max_cpu_ms\": %.4f, ", own[count / 2], own[count * 99 / 100],
           own[count - 1]);
    printf("\"converged\": %d, \"iterations_mean\": %.3f, \"memory_mb\": %.2f}\n", converged,
           (double)iterations / count, (double)memory / 1024);
    return 0;
}
