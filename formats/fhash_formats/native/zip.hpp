// Buffer of a file, and the members of its ZIP (FORMAT.md, ZIP), all of them checked.
#pragma once

#include <cstdint>
#include <string>
#include <unordered_map>
#include <vector>

#include "context.hpp"
#include "functions.h"

namespace fhash {

// A file that the caller's function reads. Its end is kept: small files are read once.
struct Source {
    const fhash_context* context = nullptr;
    fhash_read_function function = nullptr;
    fhash_announce_function announced = nullptr;  // or null: where every read costs the same
    void* user = nullptr;
    uint64_t size = 0;
    uint64_t tail_at = 0;  // offset of `tail`
    Buffer tail;

    // Tells that ranges will be read.
    void announce(const std::vector<uint64_t>& ranges) const {
        if (announced && !ranges.empty()) announced(user, ranges.data(), ranges.size() / 2);
    }
    bool read_tail(fhash_error& error);
    bool read(uint64_t offset, uint64_t length, uint8_t* bytes, fhash_error& error) const;
    // The same, where the bytes count against the context's memory.
    bool read(uint64_t offset, uint64_t length, Buffer& bytes, fhash_error& error) const;
};

// A file in the ZIP.
struct Member {
    std::string name;
    uint64_t offset = 0;     // of the local header
    uint64_t size = 0;       // bytes of the data in the ZIP
    uint32_t crc = 0;        // CRC-32 of the full data
    int64_t full_size = -1;  // bytes of the inflated data; -1 for data that are stored

    uint64_t data_offset() const { return offset + 30 + name.size(); }
    uint64_t end() const { return data_offset() + size; }
};

struct Directory {
    std::vector<Member> members;  // in the order of the file
    std::unordered_map<std::string, uint32_t> numbers;
    char digest[65] = {};  // SHA-256 of it, hexadecimal

    const Member* find(const std::string& name) const;
};

constexpr int MAJOR = 3;  // version of the format that is read
// Fails for another one.
bool refuse_version(int major, fhash_error& error);

bool read_directory(Source& source, Directory& found, fhash_error& error);

// The full data of a member, checked. `stored`: its local header, name and data.
bool open_member(const Member& member, const uint8_t* stored, Buffer& data, fhash_error& error);
// The same, where the data are not deflated: they begin at data_offset() - offset.
bool check_member(const Member& member, const uint8_t* stored, fhash_error& error);
// Checks the bytes before the data.
bool check_header(const Member& member, const uint8_t* stored, fhash_error& error);
// Bytes of a member's entry in the directory.
uint64_t entry_size(const Member& member);

// Whether a member is a metadata document, by its name.
bool is_document(const std::string& name);

// CRC-32 of bytes, behind others whose CRC-32 is `begun`.
uint32_t crc_32(const uint8_t* data, size_t size, uint32_t begun = 0);

// SHA-256 of some bytes.
void sha256(const uint8_t* data, size_t size, uint8_t digest[32]);

inline uint64_t from_little(const uint8_t* bytes, int count) {
    uint64_t value = 0;
    for (int i = count - 1; i >= 0; i--) value = value << 8 | bytes[i];
    return value;
}

}  // namespace fhash
