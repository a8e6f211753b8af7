// Training and evaluation of the paper's network by bricks: the functions that Python calls. The
// kernels are those of brick_kernels.hpp, compiled for each path in a file of its own.
#include "bricks.hpp"

#include <atomic>
#include <exception>
#include <thread>
#include <vector>

#include "gaps.hpp"

namespace {

bool is_sound(const FhashBricks& b) {
    return b.embedding > 0 && (b.own == 0 || b.own == b.embedding) && b.levels >= 0 &&
           b.hidden >= 0 && b.hidden <= 2 && b.threads > 0 &&
           (!b.hidden || (b.width > 0 && b.width <= FHASH_WIDEST)) && vertices_of(b) > 0;
}

// Do the share of a thread in a part.
int64_t share(const FhashBricks& b, int64_t part, int64_t thread) {
#if defined(FHASH_TARGETS)
    if (b.path == FHASH_PATH_V4) return fhash_bricks_run_v4(b, part, thread);
    if (b.path == FHASH_PATH_V3) return fhash_bricks_run_v3(b, part, thread);
#endif
#if defined(FHASH_VECTORS)
    return fhash_bricks_run_v1(b, part, thread);
#else
    return FHASH_NO_PATH;
#endif
}

// A place where threads wait for each other between two parts.
class Meeting {
    static constexpr int SPINS = 20000;  // before a thread that waits gives its processor away
    std::atomic<int64_t> guests{INT64_MAX}, here{0}, over{0};

 public:
    // Say how many threads meet. The one that says so comes after it to each meeting.
    void invite(int64_t count) { guests = count; }

    // Return when all threads have come. There may be fewer processors than threads.
    void wait() {
        const int64_t number = over;
        if (++here == guests) {
            here = 0;
            over = number + 1;
        }
        for (int spin = 0; over == number; spin++)
            if (spin > SPINS) std::this_thread::yield();
    }
};

}  // namespace

// Numbers of memory that a thread needs, or a negative number for a task that cannot be done.
FHASH_EXPORT int64_t fhash_bricks_work(const FhashBricks* task) {
    if (!has_path(task->path)) return FHASH_NO_PATH;
    if (!is_sound(*task)) return -1;
#if defined(FHASH_TARGETS)
    if (task->path == FHASH_PATH_V4) return fhash_bricks_work_v4(*task);
    if (task->path == FHASH_PATH_V3) return fhash_bricks_work_v3(*task);
#endif
#if defined(FHASH_VECTORS)
    return fhash_bricks_work_v1(*task);
#else
    return FHASH_NO_PATH;
#endif
}

// Sum the missed steps (`FhashGaps`) up to the steps first .. last, one after the other.
FHASH_EXPORT int64_t fhash_bricks_gaps(const FhashBricks* task, int64_t first, int64_t last) {
    for (int64_t step = first; step <= last; step++) sweep(task->gaps, step);
    return 0;
}

// List the blocks whose numbers the chosen bricks need; return how many there are.
FHASH_EXPORT int64_t fhash_bricks_touch(const FhashBricks* task) {
    const FhashBricks& b = *task;
    int64_t touches = 0;
    for (int64_t i = 0; b.levels && i < b.count; i++) {
        const FhashLevel& l = b.level[0];
        const int32_t* place = b.bricks + 4 * b.chosen[i];
        const int64_t count = l.corners[3] * b.embedding;
        for_rows(b, l, place, [&](int64_t at) {
            for (int64_t block = at / FHASH_BLOCK; block <= (at + count - 1) / FHASH_BLOCK; block++)
                if (b.stamps[block] != b.step) {
                    b.stamps[block] = b.step;
                    b.touched[touches++] = block;
                }
        });
    }
    return touches;
}

// Do the parts first .. last, one after the other, by all threads of the task.
//
// The threads live for this call alone: to make one takes some 20 microseconds, where a step takes
// milliseconds. Shares of threads that cannot be made are done by the caller, with the same bits.
FHASH_EXPORT int64_t fhash_bricks_run(const FhashBricks* task, int64_t first, int64_t last) {
    const FhashBricks& b = *task;
    std::atomic<int64_t> result{0};
    Meeting meeting;
    const auto work = [&](int64_t begin, int64_t end) {
        for (int64_t part = first; part <= last; part++) {
            if (part > first) meeting.wait();
            for (int64_t thread = begin; thread < end; thread++)
                if (const int64_t failed = share(b, part, thread)) result = failed;
        }
    };
    std::vector<std::thread> others;
    try {
        others.reserve(b.threads);
        while ((int64_t)others.size() + 1 < b.threads)
            others.emplace_back(work, (int64_t)others.size(), (int64_t)others.size() + 1);
    } catch (const std::exception&) {
    }
    meeting.invite((int64_t)others.size() + 1);
    work((int64_t)others.size(), b.threads);
    for (std::thread& other : others) other.join();
    return result;
}
