/* Writes a variable through the filter with netCDF's C library, and reads it: prints the sum. */
#include <netcdf.h>
#include <stdio.h>
#include <string.h>

enum { T = 3, Y = 20, X = 30 };

static int check(int status) {
    if (status) fprintf(stderr, "%s\n", nc_strerror(status));
    return status;
}

int main(int count, char** words) {
    static float values[T * Y * X];
    int file, dimensions[3], variable;
    const size_t chunks[3] = {2, Y, X};
    unsigned numbers[5] = {1, 0, 0, 0, 2};
    const double bound = 0.01;
    double sum = 0;
    if (count != 2) return 2;
    memcpy(numbers + 1, &bound, sizeof bound);
    for (int i = 0; i < T * Y * X; i++) values[i] = (float)(i % X * (i / X % Y)) / 64 + i / (X * Y);
    if (check(nc_create(words[1], NC_NETCDF4, &file)) ||
        check(nc_def_dim(file, "t", T, dimensions)) ||
        check(nc_def_dim(file, "y", Y, dimensions + 1)) ||
        check(nc_def_dim(file, "x", X, dimensions + 2)) ||
        check(nc_def_var(file, "v", NC_FLOAT, 3, dimensions, &variable)) ||
        check(nc_def_var_chunking(file, variable, NC_CHUNKED, chunks)) ||
        check(nc_def_var_filter(file, variable, 34274, 5, numbers)) ||
        check(nc_put_var_float(file, variable, values)) || check(nc_close(file)))
        return 1;
    memset(values, 0, sizeof values);
    if (check(nc_open(words[1], NC_NOWRITE, &file)) || check(nc_get_var_float(file, 0, values)))
        return 1;
    for (int i = 0; i < T * Y * X; i++) sum += values[i];
    printf("%.9g\n", sum);
    return check(nc_close(file));
}
