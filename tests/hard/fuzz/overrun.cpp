// A target for one function only. A test plants an overrun in it, which the fuzzer must find.
#include "exports.hpp"
#include "reader.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    Reader in(data, size);
    const std::int64_t n = 1 + in.word() % 100;
    std::vector<std::int32_t> whole = in.numbers<std::int32_t>(n);
    for (std::int32_t& value : whole) value /= 2;
    std::vector<float> values(whole.size());
    const double shifts[6] = {};
    fhash_dequantise_f32(whole.data(), n, 1.0, shifts, values.data());
    return 0;
}
