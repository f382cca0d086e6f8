/* Asks an exported field about a place, in metres of the world, and times it.
 *
 *     cc -O2 query.c -I FOLDER -L FOLDER/build -lgsparc_field -Wl,-rpath,FOLDER/build -lm -o query
 *     ./query FOLDER/field.gsparc X Y Z [QUERIES]
 */
#define _POSIX_C_SOURCE 200112L
#include <gsparc_field.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static int ascending(const void* a, const void* b) {
    const double x = *(const double*)a, y = *(const double*)b;
    return (x > y) - (x < y);
}

static double now_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * 1e6 + now.tv_nsec * 1e-3;
}

int main(int count, char** given) {
    char why[200];
    gsparc_field* field = count > 4 ? gsparc_load(given[1], why, sizeof why) : NULL;
    if (!field) return fprintf(stderr, "%s\n", count > 4 ? why : "query FILE X Y Z [QUERIES]"), 1;
    const gsparc_facts facts = gsparc_about(field);
    float place[6] = {0}, variance, unknown;
    for (int axis = 0; axis < facts.axes && axis + 2 < count; ++axis)
        place[axis] = (float)(atof(given[2 + axis]) - facts.origin[axis % 3]);
    void* scratch = NULL;
    float* values = malloc(facts.values * sizeof *values);
    if (posix_memalign(&scratch, 64, facts.scratch) || !values) return fprintf(stderr, "out of memory\n"), 1;
    const int status = gsparc_query(field, place, values, &variance, &unknown, scratch);
    printf("status %d, %d x %d, first value %g, variance %g, unknown %g\n", status, facts.shape[0], facts.shape[1], values[0], variance, unknown);
    const int queries = count > 5 ? atoi(given[5]) : 0;
    enum { COLD = 64 << 20 };
    volatile char* other = malloc(COLD); /* what pushes the field out of the caches */
    double* times = malloc((queries + 1) * sizeof *times);
    for (int mode = 0; mode < 4 && queries > 0 && other && times; ++mode) {
        const int cold = mode / 2, doubt = mode % 2, turns = cold ? queries / 50 + 1 : queries;
        for (int i = 0; i < turns; ++i) {
            for (size_t byte = 0; cold && byte < COLD; byte += 64) other[byte] = (char)i;
            const double start = now_us();
            gsparc_query(field, place, values, doubt ? &variance : NULL, doubt ? &unknown : NULL, scratch);
            times[i] = now_us() - start;
            place[0] += (i % 2 ? -1e-3f : 1e-3f);
        }
        qsort(times, turns, sizeof *times, ascending);
        printf("%s, %s: p50 %.1f us, p99 %.1f us\n", cold ? "cold" : "warm", doubt ? "with variance" : "mean alone", times[turns / 2], times[turns * 99 / 100]);
    }
    free(times), free((void*)other), free(values), free(scratch), gsparc_free(field);
    return status;
}
