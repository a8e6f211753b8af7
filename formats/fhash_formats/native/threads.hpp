// Threads and locks, which WebAssembly has not.
#pragma once

#if defined(__wasm__)

namespace fhash {
struct Mutex {};
struct Guard {
    explicit Guard(Mutex&) {}
};
// Runs `work` for each number from 0 to before `count`.
template <class Work> void together(int count, Work work) {
    for (int i = 0; i < count; i++) work(i);
}
}  // namespace fhash

#else

#include <atomic>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

namespace fhash {
using Mutex = std::mutex;
using Guard = std::lock_guard<std::mutex>;

// Runs `work` for each number from 0 to before `count`, each in a thread. Throws std::bad_alloc
// where one of them has no memory.
template <class Work> void together(int count, Work work) {
    std::atomic<bool> failed{false};
    const auto run = [&](int number) {
        try {
            work(number);
        } catch (...) {  // of the standard library alone: no memory
            failed = true;
        }
    };
    std::vector<std::thread> threads;
    threads.reserve((size_t)count);
    int i = 1;
    try {
        for (; i < count; i++) threads.emplace_back(run, i);
    } catch (const std::system_error&) {  // no further thread: this one does the rest
    }
    for (int rest = i; rest < count; rest++) run(rest);
    run(0);
    for (std::thread& thread : threads) thread.join();
    if (failed) throw std::bad_alloc();
}
}  // namespace fhash

#endif
