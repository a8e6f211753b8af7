// Numbers from the bytes of one input; behind its end all numbers are 0.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

class Reader {
public:
    Reader(const std::uint8_t* data, std::size_t size) : at(data), left(size) {}

    std::uint8_t byte() { return left ? (left--, *at++) : 0; }
    std::uint16_t word() {
        const std::uint16_t low = byte();
        return static_cast<std::uint16_t>(low | byte() << 8);
    }
    // A number from low to high.
    std::int64_t within(std::int64_t low, std::int64_t high) {
        return low + byte() % (high - low + 1);
    }
    template <class T> T number() {
        std::uint8_t bytes[sizeof(T)];
        for (std::uint8_t& each : bytes) each = byte();
        T value;
        std::memcpy(&value, bytes, sizeof value);
        return value;
    }
    // A finite float, as Python passes them on.
    template <class T> T finite() {
        const T value = number<T>();
        return std::isfinite(value) ? value : T(0);
    }
    template <class T> std::vector<T> numbers(std::int64_t n) {
        std::vector<T> values(static_cast<std::size_t>(n));
        for (T& value : values) value = number<T>();
        return values;
    }
    // The remaining bytes in memory of their own, so that reading beyond their end is seen.
    std::vector<std::uint8_t> rest() {
        std::vector<std::uint8_t> bytes(at, at + left);
        left = 0;
        return bytes;
    }

private:
    const std::uint8_t* at;
    std::size_t left;
};
