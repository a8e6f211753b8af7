/* A program without an HDF5 that others can see: it makes a dataset as HDF5 would. */
#include <stdint.h>
#include <stdio.h>

typedef struct {
    int version, number;
    unsigned encodes, decodes;
    const char* name;
    int (*can_apply)(int64_t, int64_t, int64_t);
    int (*set_local)(int64_t, int64_t, int64_t);
    size_t (*filter)(unsigned, size_t, const unsigned*, size_t, size_t*, void**);
} Filter;

const void* H5PLget_plugin_info(void);

int main(void) {
    const Filter* filter = H5PLget_plugin_info();
    puts(filter->set_local(1, 2, 3) < 0 ? "refused" : "taken");
    return 0;
}
