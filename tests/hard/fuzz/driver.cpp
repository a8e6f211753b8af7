// A coverage-guided fuzzer for compilers that count edges but have no fuzzer of their own, such as
// gcc with -fsanitize-coverage=trace-pc.
//
// driver CORPUS CURRENT SECONDS SEED runs LLVMFuzzerTestOneInput on the files in the folder CORPUS
// and on mutations of them. A mutation is kept if it passes a new edge, or an edge a new number of
// times. Before each run the input is written to the file CURRENT, where it is found after a crash.
// At the end the driver prints one line: executions, edges, inputs kept.
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>
#include <string>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

namespace {

const std::size_t MAP = 1 << 18;      // places for edges
const std::size_t MAX_SIZE = 1 << 14;  // bytes of an input
std::uint8_t passed[MAP];  // how often this run passed an edge
std::uint8_t seen[MAP];    // classes of these numbers in all runs, as bits
std::uintptr_t before = 0;

using Input = std::vector<std::uint8_t>;
std::mt19937_64 chance;

std::size_t below(std::size_t n) { return n ? chance() % n : 0; }

// The class of a number as one bit: 1, 2, 3, 4 to 7, 8 to 15, 16 to 31, 32 to 127, more; 0 for 0.
std::uint8_t class_of(std::uint8_t n) {
    if (n < 4) return static_cast<std::uint8_t>(n ? 1 << (n - 1) : 0);
    return n < 8 ? 8 : n < 16 ? 16 : n < 32 ? 32 : n < 128 ? 64 : 128;
}

// Adds this run to `seen`; whether it passed an edge a new number of times.
bool is_new() {
    bool fresh = false;
    for (std::size_t word = 0; word < MAP; word += 8) {
        std::uint64_t any;
        std::memcpy(&any, passed + word, 8);
        if (!any) continue;
        for (std::size_t i = word; i < word + 8; i++) {
            const std::uint8_t now = class_of(passed[i]);
            fresh |= (now & ~seen[i]) != 0;
            seen[i] |= now;
        }
    }
    return fresh;
}

// Numbers at the ends of types, infinities and NaN; their low bytes are written.
const std::uint64_t HARD_NUMBERS[] = {
    0,          1,          2,          7,          8,          15,
    16,         31,         32,         63,         64,         127,
    128,        255,        256,        4095,       4096,       32767,
    32768,      65535,      65536,      0x7fffffff, 0x80000000, 0xffffffff,
    0x7f800000, 0xff800000, 0x7fc00000, 0x7f7fffff,
    0x7ff0000000000000, 0x7ff8000000000000, 0x7fffffffffffffff, 0xffffffffffffffff};

void write_hard_number(Input& input) {
    const std::size_t width = std::size_t{1} << below(4);
    const std::uint64_t value = HARD_NUMBERS[below(sizeof HARD_NUMBERS / sizeof *HARD_NUMBERS)];
    if (input.size() >= width)
        std::memcpy(input.data() + below(input.size() - width + 1), &value, width);
}

// Inserts or removes some bytes.
void resize_at(Input& input, std::ptrdiff_t at, bool larger) {
    if (larger) {
        input.insert(input.begin() + at, 1 + below(8), static_cast<std::uint8_t>(chance()));
        return;
    }
    const std::size_t end = std::min(input.size(), static_cast<std::size_t>(at) + 1 + below(16));
    input.erase(input.begin() + at, input.begin() + static_cast<std::ptrdiff_t>(end));
}

// Continues the input with the end of another one, or copies a few bytes of it.
void splice_at(Input& input, std::size_t at, const std::vector<Input>& corpus, bool to_the_end) {
    const Input& other = corpus[below(corpus.size())];
    const std::size_t from = below(other.size());
    const auto start = other.begin() + static_cast<std::ptrdiff_t>(from);
    if (to_the_end) {
        input.resize(at);
        input.insert(input.end(), start, other.end());
        return;
    }
    const std::size_t n = std::min({other.size() - from, input.size() - at, 1 + below(32)});
    std::copy_n(start, n, input.begin() + static_cast<std::ptrdiff_t>(at));
}

void change_byte(std::uint8_t& byte, std::size_t kind) {
    if (kind == 0)
        byte ^= static_cast<std::uint8_t>(1 << below(8));
    else if (kind == 1)
        byte = static_cast<std::uint8_t>(chance());
    else
        byte = static_cast<std::uint8_t>(byte + below(71) - 35);
}

void mutate(Input& input, const std::vector<Input>& corpus) {
    for (std::size_t turns = std::size_t{1} << below(5); turns > 0; turns--) {
        const std::size_t at = below(input.size());
        const std::size_t kind = below(10);
        switch (kind) {
            case 0:
            case 1:
            case 2:
                if (!input.empty()) change_byte(input[at], kind);
                break;
            case 3: write_hard_number(input); break;
            case 4:
            case 5: resize_at(input, static_cast<std::ptrdiff_t>(at), kind == 4); break;
            case 6: input.resize(at); break;
            case 7:
            case 8: splice_at(input, at, corpus, kind == 7); break;
            default:
                for (std::size_t n = 1 + below(16); n > 0; n--)
                    input.push_back(static_cast<std::uint8_t>(chance()));
        }
    }
    if (input.size() > MAX_SIZE) input.resize(MAX_SIZE);
}

}  // namespace

extern "C" void __sanitizer_cov_trace_pc() {
    const std::uintptr_t here =
        reinterpret_cast<std::uintptr_t>(__builtin_return_address(0)) * 0x9e3779b97f4a7c15u >> 40;
    std::uint8_t& count = passed[(here ^ before) % MAP];
    count = static_cast<std::uint8_t>(count + (count < 255));
    before = here >> 1;
}

int main(int count, char** arguments) {
    if (count == 2) {  // one input, to repeat a crash
        std::ifstream file(arguments[1], std::ios::binary);
        const Input input{std::istreambuf_iterator<char>(file), {}};
        LLVMFuzzerTestOneInput(input.data(), input.size());
        return 0;
    }
    if (count != 5) return 2;
    const int file = open(arguments[2], O_RDWR | O_CREAT | O_TRUNC, 0600);
    if (file < 0 || ftruncate(file, MAX_SIZE + 8) != 0) return 2;
    auto* const current = static_cast<std::uint8_t*>(
        mmap(nullptr, MAX_SIZE + 8, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0));
    if (current == MAP_FAILED) return 2;
    chance.seed(std::strtoull(arguments[4], nullptr, 10));

    std::vector<Input> corpus;
    std::uint64_t executions = 0;
    const auto run = [&](const Input& input) {
        const std::uint64_t size = input.size();
        std::memcpy(current, &size, 8);
        std::copy(input.begin(), input.end(), current + 8);
        std::memset(passed, 0, MAP);
        before = 0;
        const itimerval patience = {{0, 0}, {20, 0}};
        // A hang ends as a crash. The limit is on processor time, since the machine may be shared.
        setitimer(ITIMER_PROF, &patience, nullptr);
        const Input exact(input);
        LLVMFuzzerTestOneInput(exact.data(), exact.size());
        executions++;
        return is_new();
    };
    std::vector<std::filesystem::path> files;
    for (const auto& entry : std::filesystem::directory_iterator(arguments[1]))
        files.push_back(entry.path());
    std::sort(files.begin(), files.end());
    for (const auto& path : files) {
        std::ifstream from(path, std::ios::binary);
        Input input{std::istreambuf_iterator<char>(from), {}};
        if (input.size() > MAX_SIZE) input.resize(MAX_SIZE);
        run(input);
        corpus.push_back(input);
    }
    if (corpus.empty()) return 2;
    const auto end = std::chrono::steady_clock::now() +
                     std::chrono::duration<double>(std::strtod(arguments[3], nullptr));
    while (std::chrono::steady_clock::now() < end) {
        // Every second input is a mutation of the inputs that were kept last.
        const std::size_t recent = std::min<std::size_t>(corpus.size(), 64);
        Input input =
            corpus[chance() % 2 ? corpus.size() - 1 - below(recent) : below(corpus.size())];
        mutate(input, corpus);
        if (run(input)) corpus.push_back(input);
    }
    const auto edges = MAP - static_cast<std::size_t>(std::count(seen, seen + MAP, 0));
    std::printf("%llu %zu %zu\n", static_cast<unsigned long long>(executions), edges,
                corpus.size() - files.size());
    return 0;
}
