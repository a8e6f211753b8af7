// Large arrays in huge pages, where Linux has them.
#pragma once

#include <cstddef>
#if defined(__linux__)
#include <sys/mman.h>

#include <cstdint>
#endif

namespace fhash {

// Sets the length of an empty array. A tile's arrays have some MiB each and live for milliseconds;
// by small pages the kernel takes a twentieth of an encoder's time to hand them out. numpy asks for
// huge pages in the same way.
template <class Array> void make_room(Array& array, std::size_t count) {
    array.reserve(count);
#if defined(__linux__)
    constexpr std::size_t large = std::size_t{4} << 20, page = 4096;
    const std::size_t size = count * sizeof(array[0]);
    if (size >= large) {
        char* const memory = (char*)array.data();
        const std::size_t before = page - reinterpret_cast<std::uintptr_t>(memory) % page;
        madvise(memory + before, size - before, MADV_HUGEPAGE);
    }
#endif
    array.resize(count);
}

}  // namespace fhash
