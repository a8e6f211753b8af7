// WebAssembly of one thread: what its C++ library leaves out. `make wasm` includes it before every
// source.
#pragma once

namespace std {
struct mutex {
    void lock() {}
    void unlock() {}
    bool try_lock() { return true; }
};
template <class Lock> struct lock_guard {
    explicit lock_guard(Lock&) {}
};
}  // namespace std
#include <mutex>
