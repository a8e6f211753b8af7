// A program whose operator new is not malloc: memory of one must not be freed by the other.
#include <fhash.h>

#include <cstdio>
#include <cstdlib>
#include <new>
#include <vector>

#if !SANITIZED
void* operator new(std::size_t size) { return (char*)std::malloc(size + 64) + 64; }
void operator delete(void* memory) noexcept {
    if (memory) std::free((char*)memory - 64);
}
void operator delete(void* memory, std::size_t) noexcept { operator delete(memory); }
#endif

int main(int, char** words) {
    fhash_error error;
    fhash_file* file = nullptr;
    fhash_context* const context = fhash_context_create(0, 2);
    fhash_variable variable = {sizeof variable};
    const int opened = fhash_open_path(context, words[1], &file, &error) ||
                       fhash_variable_get(file, 0, &variable, &error);
    if (opened) return std::printf("%s\n", error.text), 1;
    std::vector<double> values(
        (size_t)(variable.shape[1] * variable.shape[2] * variable.shape[3]));
    if (fhash_read(file, 0, 0, nullptr, 0, FHASH_FLOAT64, values.data(), &error))
        return std::printf("%s\n", error.text), 1;
    fhash_close(file);
    if (!fhash_open_path(context, "/nothing/there", &file, &error)) return 1;
    fhash_context_destroy(context);
    std::puts("done");
}
