// A library of the kernels in the file KERNELS, with a function that launches them.
// FHASH_KERNELS lists them as FHASH_KERNEL(name), ...
#include "emulate.hpp"
#include KERNELS

#define FHASH_KERNEL(kernel) {#kernel, [](void** a) { return emulated::bound(kernel, a); }}

// Returns what emulated::launch does; 2 for an unknown kernel.
extern "C" int launch(
    const char* name, unsigned blocks, unsigned threads, std::size_t bytes, int order,
    void** arguments) {
    using Bind = std::function<void()> (*)(void**);
    static const std::pair<const char*, Bind> kernels[] = {FHASH_KERNELS};
    for (const auto& [known, bind] : kernels)
        if (!std::strcmp(known, name))
            return emulated::launch(blocks, threads, bytes, order, bind(arguments));
    return 2;
}
