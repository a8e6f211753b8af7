// Memory that cannot be had as a return value: no exception may cross the border of the library.
//
// It is caught in the function that is cloned for several machines (FHASH_CLONES) and not by its caller: gcc 12 takes the call of such a
// function for one that throws nothing, and an exception from it ends the process.
#pragma once

#include <new>
#include <stdexcept>

#include "core.hpp"

namespace {

const std::int64_t NO_MEMORY = -2;

// What the work returns, or NO_MEMORY.
template <class Work> FHASH_INLINE std::int64_t guarded(Work work) {
    try {
        return work();
    } catch (const std::bad_alloc&) {
        return NO_MEMORY;
    } catch (const std::length_error&) {
        return NO_MEMORY;
    }
}

}  // namespace
