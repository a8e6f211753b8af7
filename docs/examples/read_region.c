/* Reads a region of the first variable of a .fhz file: docs/c-library.md shows how to link. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include <fhash.h>

/* Ends the program where a call failed. */
static void check(int32_t status, const fhash_error* error) {
    if (status == FHASH_OK) return;
    fprintf(stderr, "%s\n", error->text);
    exit(1);
}

int main(int count, char** words) {
    fhash_error error;
    fhash_file* file = NULL;
    fhash_variable variable;
    variable.size = sizeof variable;
    if (count != 2) return fprintf(stderr, "usage: read_region RUN.fhz\n"), 2;
    fhash_context* context = fhash_context_create(0, 2); /* no limit of memory, two threads */
    check(fhash_open_path(context, words[1], &file, &error), &error);
    check(fhash_variable_get(file, 0, &variable, &error), &error);
    const int64_t* shape = variable.shape;
    printf("%s (%lld, %lld, %lld, %lld) %s\n", variable.name, (long long)shape[0],
           (long long)shape[1], (long long)shape[2], (long long)shape[3], variable.units);

    /* the first half of each axis, at the middle of the steps, which may lie between two */
    const double step = (double)(shape[0] - 1) / 2;
    int64_t region[6] = {0, (shape[1] + 1) / 2, 0, (shape[2] + 1) / 2, 0, (shape[3] + 1) / 2};
    const size_t vertices = (size_t)(region[1] * region[3] * region[5]);
    float* values = malloc(vertices * sizeof *values);
    if (!values) return 1;
    check(fhash_read(file, 0, step, region, 0, FHASH_FLOAT32, values, &error), &error);

    double sum = 0, counted = 0; /* missing values, and those outside the features, are NaN */
    for (size_t i = 0; i < vertices; i++) {
        if (!isnan(values[i])) sum += values[i], counted++;
    }
    printf("last %.9g mean %.12g of %.0f\n", values[vertices - 1], sum / counted, counted);
    free(values);
    fhash_close(file);
    fhash_context_destroy(context);
    return 0;
}
