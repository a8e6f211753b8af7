// A target for whole files: hostile bytes, whose checksums are mended, opened and read by fhash.h.
#include <algorithm>
#include <cstring>

#include "exports.hpp"
#include "reader.hpp"
#include "zip.hpp"

namespace {

using Bytes = std::vector<std::uint8_t>;

const std::size_t END = 22, COMMENT = 79;  // bytes of the end record and of its comment

std::int32_t read_bytes(void* user, std::uint64_t offset, std::uint64_t length, void* bytes) {
    const Bytes& file = *static_cast<const Bytes*>(user);
    if (offset > file.size() || length > file.size() - offset) return 1;
    std::memcpy(bytes, file.data() + offset, length);
    return 0;
}

std::size_t number(const Bytes& file, std::size_t at, int count) {
    return at + 8 > file.size() ? 0 : fhash::from_little(file.data() + at, count);
}

// Checksums of what is stored, and of the directory: else nothing behind them would be reached.
void mend(Bytes& file) {
    if (file.size() < END + COMMENT) return;
    const std::size_t end = file.size() - END - COMMENT;
    const std::size_t begin = std::min(number(file, end + 16, 4), end);
    for (std::size_t at = begin; at + 46 <= end;) {
        const std::size_t name = number(file, at + 28, 2), size = number(file, at + 20, 4);
        const std::size_t local = number(file, at + 42, 4), data = local + 30 + name;
        if (number(file, at + 10, 2) == 0 && data + size <= begin) {
            const std::uint32_t sum = fhash::crc_32(file.data() + data, size);
            for (std::size_t i = 0; i < 4; i++)
                file[at + 16 + i] = file[local + 14 + i] = std::uint8_t(sum >> 8 * i);
        }
        at += 46 + name + number(file, at + 30, 2) + number(file, at + 32, 2);
    }
    std::uint8_t digest[32];
    fhash::sha256(file.data() + begin, file.size() - COMMENT - begin, digest);
    for (std::size_t i = 0; i < 64; i++)
        file[file.size() - 64 + i] =
            std::uint8_t("0123456789abcdef"[digest[i / 2] >> (i % 2 ? 0 : 4) & 15]);
}

void look(fhash_file* file, std::int32_t number, std::uint8_t how) {
    fhash_variable variable;
    variable.size = sizeof variable;
    if (fhash_variable_get(file, number, &variable, nullptr)) return;
    std::int64_t region[6];
    std::size_t n = 1;
    for (int a = 0; a < 4; a++) {
        const std::int64_t length = variable.shape[a];
        if (length <= 1 << 16) {
            std::vector<double> positions(static_cast<std::size_t>(length));
            const char* attributes;
            fhash_coordinate(file, number, a, positions.data(), &attributes, nullptr);
        }
        if (a == 0) continue;
        region[2 * a - 2] = length / (2 + how % 3);
        region[2 * a - 1] = std::min(region[2 * a - 2] + 9, length);
        n *= static_cast<std::size_t>(region[2 * a - 1] - region[2 * a - 2]);
    }
    std::vector<double> values(n);
    const double last = static_cast<double>(variable.shape[0] - 1);
    fhash_read(file, number, how & 1 ? last / 2 : last, region, how >> 1 & 3,
               how & 8 ? FHASH_FLOAT64 : FHASH_FLOAT32, values.data(), nullptr);
    fhash_read(file, number, 0, region, 0, variable.type, values.data(), nullptr);
}

}  // namespace

void file(Reader& in) {
    static fhash_context* const context = fhash_context_create(1 << 26, 1);
    const std::uint8_t how = in.byte();
    Bytes bytes = in.rest();
    mend(bytes);
    fhash_file* opened;
    if (fhash_open(context, read_bytes, &bytes, bytes.size(), &opened, nullptr)) return;
    if (!fhash_header(opened)) __builtin_trap();
    for (std::int32_t i = 0; i < std::min(fhash_variables(opened), 3); i++) look(opened, i, how);
    fhash_close(opened);
}
