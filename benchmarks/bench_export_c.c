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

int main(int argc, char **argv)
{
    enum { WIDTH = NSDE_NX * (1 + NSDE_STEPS) };
    static double row[WIDTH];
    static nsde_real state[NSDE_NX], reference[NSDE_STEPS][NSDE_NX];
    if (argc != 4) return 2;
    FILE *file = fopen(argv[1], "rb");
    int count = atoi(argv[2]), converged = 0, iterations = 0;
    double *times = malloc((size_t)count * sizeof *times);
    if (!file || !times) return 2;
    for (int n = 0; n < count; n++) {
        struct timespec start, end;
        if (fread(row, sizeof *row, WIDTH, file) != WIDTH) return 2;
        for (int i = 0; i < NSDE_NX; i++) state[i] = (nsde_real)row[i];
        for (int i = 0; i < NSDE_STEPS * NSDE_NX; i++) (&reference[0][0])[i] = (nsde_real)row[NSDE_NX + i];
        clock_gettime(CLOCK_MONOTONIC, &start);
        int status = nsde_step(&work, state, 1, (nsde_real)atof(argv[3]), (const nsde_real(*)[NSDE_NX])reference, NULL,
                               NULL, NULL, &plan, &command);
        clock_gettime(CLOCK_MONOTONIC, &end);
        times[n] = 1e3 * (double)(end.tv_sec - start.tv_sec) + 1e-6 * (double)(end.tv_nsec - start.tv_nsec);
        converged += status == 0;
        iterations += command.iterations;
    }
    qsort(times, (size_t)count, sizeof *times, ascending);
    char line[128];
    FILE *about = fopen("/proc/self/status", "r");
    long memory = 0; /* largest resident size [kB] */
    while (about && fgets(line, sizeof line, about)) sscanf(line, "VmHWM: %ld", &memory);
    printf("{\"p50_ms\": %.4f, \"p90_ms\": %.4f, \"p99_ms\": %.4f, \"max_ms\": %.4f, ", times[count / 2],
           times[count * 9 / 10], times[count * 99 / 100], times[count - 1]);
    printf("\"converged\": %d, \"iterations_mean\": %.3f, \"memory_mb\": %.2f}\n", converged,
           (double)iterations / count, (double)memory / 1024);
    return 0;
}
