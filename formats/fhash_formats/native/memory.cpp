// Memory of the shared library's containers: huge pages for large arrays, where Linux has them.
//
// A tile's arrays have some MiB each and live for milliseconds; by small pages the kernel takes a
// twentieth of an encoder's time to hand them out. numpy asks for huge pages in the same way. The
// operators are the library's own (exports.map): a program keeps its own ones.
#if defined(__linux__)
#include <sys/mman.h>

#include <cstdint>
#include <cstdlib>
#include <new>

namespace {

constexpr std::size_t LARGE = std::size_t{4} << 20, PAGE = 4096;

void* taken(std::size_t size) {
    void* const memory = std::malloc(size ? size : 1);
    if (memory && size >= LARGE) {
        const std::size_t before = PAGE - reinterpret_cast<std::uintptr_t>(memory) % PAGE;
        madvise(static_cast<char*>(memory) + before, size - before, MADV_HUGEPAGE);
    }
    return memory;
}

}  // namespace

void* operator new(std::size_t size) {
    void* const memory = taken(size);
    if (!memory) throw std::bad_alloc();
    return memory;
}
void* operator new(std::size_t size, const std::nothrow_t&) noexcept { return taken(size); }
void operator delete(void* memory) noexcept { std::free(memory); }
void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }
void operator delete(void* memory, const std::nothrow_t&) noexcept { std::free(memory); }
#endif
