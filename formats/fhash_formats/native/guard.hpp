// Failures of memory as a return value: no exception may leave the library.
//
// An exception is caught in the function that is cloned for several machines (FHASH_CLONES) and not
// in its caller: gcc 12 assumes that a call of such a function throws nothing, and an exception
// from it would end the process.
#pragma once

#include "core.hpp"

#if defined(__cpp_exceptions)
#include <new>
#include <stdexcept>
#endif

namespace {

const std::int64_t NO_MEMORY = -2;

// The result of `work`, or NO_MEMORY where it ran out of memory. Without exceptions (WebAssembly)
// the instance ends there, and whoever called it makes another one.
template <class Work> FHASH_INLINE std::int64_t guarded(Work work) {
#if defined(__cpp_exceptions)
    try {
        return work();
    } catch (const std::bad_alloc&) {
        return NO_MEMORY;
    } catch (const std::length_error&) {
        return NO_MEMORY;
    }
#else
    return work();
#endif
}

}  // namespace
