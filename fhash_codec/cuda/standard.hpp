// What shared sources use of the standard library's headers, which NVRTC has none of.
#pragma once
using int16_t = short;
using int32_t = int;
using int64_t = long long;
using uint8_t = unsigned char;
using uint32_t = unsigned;

namespace std {
using ::int32_t;
using ::int64_t;
using ::uint32_t;

template <class T> struct numeric_limits;
template <> struct numeric_limits<float> {
    static float quiet_NaN() { return __int_as_float(0x7fffffff); }
};
inline void memcpy(void* to, const void* from, unsigned long long bytes) {
    ::memcpy(to, from, bytes);
}
}  // namespace std
