// Failures of the public functions (fhash.h): a status and a text, without exceptions, which
// WebAssembly has not.
//
// A function that may fail takes `fhash_error& error` and returns whether it succeeded:
//     if (size > most) return fail(error, FHASH_ERROR_DAMAGED, "a tile of %zu bytes", size);
#pragma once

#include <cstdarg>
#include <cstdio>

#include "fhash.h"

#if defined(__GNUC__)
__attribute__((format(printf, 3, 4)))
#endif
inline bool fail(fhash_error& error, int32_t status, const char* form, ...) {
    error.status = status;
    va_list arguments;
    va_start(arguments, form);
    std::vsnprintf(error.text, sizeof error.text, form, arguments);
    va_end(arguments);
    return false;
}

// Runs `work`, which takes an error and says whether it succeeded; the status for the caller.
template <class Work> int32_t reported(fhash_error* given, Work work) {
    fhash_error own;
    fhash_error& error = given ? *given : own;
    error.status = FHASH_OK;
    error.text[0] = 0;
#if defined(__cpp_exceptions)
    try {
        work(error);
    } catch (...) {  // of the standard library alone: no memory
        fail(error, FHASH_ERROR_MEMORY, "no memory");
    }
#else
    work(error);
#endif
    return error.status;
}
