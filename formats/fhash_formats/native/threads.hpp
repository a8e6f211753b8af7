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

#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace fhash {
using Mutex = std::mutex;
using Guard = std::lock_guard<std::mutex>;

// Runs `work`, which throws nothing, for each number from 0 to before `count`, each in a thread.
template <class Work> void together(int count, Work work) {
    std::vector<std::thread> threads;
    int i = 1;
    try {
        for (; i < count; i++) threads.emplace_back(work, i);
    } catch (const std::system_error&) {  // no further thread: this one does the rest
    }
    for (int rest = i; rest < count; rest++) work(rest);
    if (count > 0) work(0);
    for (std::thread& thread : threads) thread.join();
}
}  // namespace fhash

#endif
