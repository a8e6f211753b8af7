// What calls share (fhash_context in fhash.h).
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "status.hpp"
#include "threads.hpp"

namespace fhash {
struct Settings;  // settings.hpp
}

struct fhash_context {
    uint64_t memory;  // bytes that a call may use beside the caller's arrays; 0 for no limit
    int32_t threads;
    fhash::Mutex lock;
    // Unpacked settings by their bytes, those used last in front.
    std::vector<std::pair<std::string, std::shared_ptr<const fhash::Settings>>> settings;
    // Norms of wavelets by kind, depth and length (plan.cpp).
    std::map<std::array<int64_t, 3>, std::shared_ptr<const std::vector<double>>> norms;
};

namespace fhash {

using Buffer = std::vector<uint8_t>;

// Whether a call may use so many bytes; fails otherwise.
inline bool may_use(const fhash_context& context, uint64_t bytes, fhash_error& error) {
    if (bytes > SIZE_MAX / 2) return fail(error, FHASH_ERROR_MEMORY, "no memory");
    if (context.memory == 0 || bytes <= context.memory) return true;
    return fail(error, FHASH_ERROR_MEMORY, "%llu bytes are needed, and %llu are allowed",
                (unsigned long long)bytes, (unsigned long long)context.memory);
}

}  // namespace fhash
