#include "zip.hpp"

#include <algorithm>
#include <cstring>

#include "inflate.hpp"
#include "json.hpp"
#include "third_party/zlib/zlib.h"

namespace fhash {

namespace {

constexpr uint64_t TAIL = 64 << 10;              // bytes that are read first
constexpr uint64_t FAR_TAIL = 16 << 10;          // the same of a file whose reads are announced
constexpr uint64_t MAX_DIRECTORY = 1 << 28;      // bytes of the directory
constexpr uint64_t MAX_MEMBER = uint64_t(1) << 31;
constexpr uint64_t MAX_INFLATED = 16 << 20;    // bytes of an inflated member
constexpr size_t MAX_NAME = 512;
constexpr size_t COMMENT = 79;                   // bytes of the comment of this format
constexpr uint64_t MAX_16 = 0xFFFF, MAX_32 = 0xFFFFFFFF;
constexpr size_t ENTRY = 46, END = 22, END_64 = 56, LOCATOR_64 = 20;

void put(Buffer& bytes, uint64_t value, int count) {
    for (int i = 0; i < count; i++) bytes.push_back(uint8_t(value >> 8 * i));
}

void put_name(Buffer& bytes, const std::string& name) {
    bytes.insert(bytes.end(), name.begin(), name.end());
}

// What local headers and entries have in common: version, flags, method, time, sizes, lengths.
void put_fields(Buffer& bytes, const Member& member, int version, uint64_t extra) {
    put(bytes, version, 2);
    put(bytes, 0, 2);
    put(bytes, member.full_size < 0 ? 0 : 8, 2);
    put(bytes, 0, 2);
    put(bytes, 0x21, 2);
    put(bytes, member.crc, 4);
    put(bytes, member.size, 4);
    put(bytes, member.full_size < 0 ? member.size : member.full_size, 4);
    put(bytes, member.name.size(), 2);
    put(bytes, extra, 2);
}

Buffer local_header(const Member& member) {
    Buffer bytes;
    put(bytes, 0x04034b50, 4);
    put_fields(bytes, member, 20, 0);
    put_name(bytes, member.name);
    return bytes;
}

Buffer directory_entry(const Member& member) {
    const bool far = member.offset >= MAX_32;
    const int version = far ? 45 : 20;
    Buffer bytes;
    put(bytes, 0x02014b50, 4);
    put(bytes, version | 3 << 8, 2);
    put_fields(bytes, member, version, far ? 12 : 0);
    put(bytes, 0, 2 + 2 + 2);
    put(bytes, 0x81A40000, 4);
    put(bytes, far ? MAX_32 : member.offset, 4);
    put_name(bytes, member.name);
    if (far) {
        put(bytes, 1 | 8 << 16, 4);
        put(bytes, member.offset, 8);
    }
    return bytes;
}

struct End {
    uint64_t count = 0, size = 0, offset = 0;  // of the directory
};

Buffer end_records(const End& end) {
    Buffer bytes;
    if (end.count >= MAX_16 || end.size >= MAX_32 || end.offset >= MAX_32) {
        put(bytes, 0x06064b50, 4);
        put(bytes, END_64 - 12, 8);
        put(bytes, 45 | 45 << 16, 4);
        put(bytes, 0, 8);
        put(bytes, end.count, 8);
        put(bytes, end.count, 8);
        put(bytes, end.size, 8);
        put(bytes, end.offset, 8);
        put(bytes, 0x07064b50, 4);
        put(bytes, 0, 4);
        put(bytes, end.offset + end.size, 8);
        put(bytes, 1, 4);
    }
    put(bytes, 0x06054b50, 4);
    put(bytes, 0, 4);
    put(bytes, std::min(end.count, MAX_16), 2);
    put(bytes, std::min(end.count, MAX_16), 2);
    put(bytes, std::min(end.size, MAX_32), 4);
    put(bytes, std::min(end.offset, MAX_32), 4);
    put(bytes, COMMENT, 2);
    return bytes;
}

bool is_digit(uint8_t letter) { return letter >= '0' && letter <= '9'; }
bool is_hex(uint8_t letter) { return is_digit(letter) || (letter >= 'a' && letter <= 'f'); }

// Whether the file ends in the comment of a container; `start` is its offset in the tail.
bool find_comment(const Buffer& tail, size_t& start, int& major) {
    for (size_t digits = 1; digits <= 4; digits++) {
        const size_t length = 6 + digits + 8 + 64;
        if (length > tail.size()) return false;
        const uint8_t* at = tail.data() + tail.size() - length;
        const uint8_t* number = at + 6;
        if (std::memcmp(at, "fhash ", 6) || std::memcmp(number + digits, " sha256=", 8)) continue;
        if (!std::all_of(number, number + digits, is_digit)) continue;
        if (!std::all_of(number + digits + 8, number + digits + 8 + 64, is_hex)) continue;
        start = tail.size() - length;
        major = 0;
        for (size_t i = 0; i < digits; i++) major = 10 * major + (number[i] - '0');
        return true;
    }
    return false;
}

// Entries, bytes and offset of the directory, from the end records before the comment.
bool read_end(const Source& source, uint64_t comment_at, End& end, fhash_error& error) {
    if (comment_at < END) return fail(error, FHASH_ERROR_DAMAGED, "the ZIP end record is missing");
    uint8_t record[END_64];
    if (!source.read(comment_at - END, END, record, error)) return false;
    if (from_little(record, 4) != 0x06054b50 || from_little(record + 20, 2) != COMMENT)
        return fail(error, FHASH_ERROR_DAMAGED, "the ZIP end record is damaged");
    end = {from_little(record + 10, 2), from_little(record + 12, 4), from_little(record + 16, 4)};
    uint64_t records_at = comment_at - END;
    if (end.count == MAX_16 || end.size == MAX_32 || end.offset == MAX_32) {
        if (records_at < LOCATOR_64 + END_64)
            return fail(error, FHASH_ERROR_DAMAGED, "the ZIP64 end record is missing");
        records_at -= LOCATOR_64 + END_64;
        if (!source.read(records_at, END_64, record, error)) return false;
        if (from_little(record, 4) != 0x06064b50)
            return fail(error, FHASH_ERROR_DAMAGED, "the ZIP64 end record is damaged");
        const uint8_t* const fields = record + 32;
        end = {from_little(fields, 8), from_little(fields + 8, 8), from_little(fields + 16, 8)};
    }
    if (end.size > MAX_DIRECTORY || end.offset > records_at ||
        end.offset + end.size != records_at)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the ZIP directory does not end where its end record begins");
    return true;
}

// Whether bytes are a member's name: `part(/part)*`, a part like [A-Za-z0-9_-][A-Za-z0-9._-]*.
bool is_name(const uint8_t* name, size_t size) {
    if (size > MAX_NAME) return false;
    bool first = true;
    for (size_t i = 0; i < size; i++) {
        const uint8_t letter = name[i];
        const bool plain = is_digit(letter) || letter == '_' || letter == '-' ||
                           (letter >= 'A' && letter <= 'Z') || (letter >= 'a' && letter <= 'z');
        if (!plain && (first || (letter != '.' && letter != '/'))) return false;
        first = letter == '/';
    }
    return !first;
}

// The member whose entry begins at `at`, which it moves behind the entry. The entry must be the
// one that a writer makes of the member.
bool parse_entry(const uint8_t*& at, const uint8_t* stop, Member& member, fhash_error& error) {
    const size_t left = size_t(stop - at);
    if (left < ENTRY || from_little(at, 4) != 0x02014b50)
        return fail(error, FHASH_ERROR_DAMAGED, "the ZIP directory has a damaged entry");
    const size_t name_size = from_little(at + 28, 2);
    if (left - ENTRY < name_size || !is_name(at + ENTRY, name_size))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the ZIP directory has a name that is not allowed");
    member.name.assign(reinterpret_cast<const char*>(at + ENTRY), name_size);
    const uint64_t method = from_little(at + 10, 2), full = from_little(at + 24, 4);
    member.crc = uint32_t(from_little(at + 16, 4));
    member.size = from_little(at + 20, 4);
    member.full_size = method == 8 ? int64_t(full) : -1;
    member.offset = from_little(at + 42, 4);
    if (method == 8) {
        if (!is_document(member.name) || member.size >= full || full > MAX_INFLATED)
            return fail(error, FHASH_ERROR_DAMAGED, "member %s may not be deflated so",
                        member.name.c_str());
    } else if (method || member.size != full || member.size > MAX_MEMBER) {
        return fail(error, FHASH_ERROR_DAMAGED, "member %s has sizes that are not allowed",
                    member.name.c_str());
    }
    if (member.offset == MAX_32 && from_little(at + 30, 2) == 12 && left - ENTRY - name_size >= 12)
        member.offset = from_little(at + ENTRY + name_size + 4, 8);
    const Buffer made = directory_entry(member);
    if (left < made.size() || std::memcmp(at, made.data(), made.size()))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "member %s has fields in its directory entry that the format does not allow",
                    member.name.c_str());
    at += made.size();
    return true;
}

bool parse_entries(const Buffer& bytes, const End& end, Directory& found, fhash_error& error) {
    const uint8_t* at = bytes.data();
    const uint8_t* stop = at + end.size;
    uint64_t position = 0;
    while (at < stop) {
        Member member;
        if (!parse_entry(at, stop, member, error)) return false;
        // An offset near 2^64 may not wrap around.
        if (member.offset != position || member.end() > end.offset)
            return fail(error, FHASH_ERROR_DAMAGED, "member %s overlaps another or leaves a gap",
                        member.name.c_str());
        if (!found.numbers.emplace(member.name, uint32_t(found.members.size())).second)
            return fail(error, FHASH_ERROR_DAMAGED, "member %s is there twice",
                        member.name.c_str());
        position = member.end();
        found.members.push_back(std::move(member));
    }
    if (found.members.size() != end.count || position != end.offset)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the ZIP directory has other entries than are declared");
    return true;
}

}  // namespace

bool Source::read_tail(fhash_error& error) {
    const uint64_t length = std::min(size, announced ? FAR_TAIL : TAIL);
    Buffer bytes;
    if (!read(size - length, length, bytes, error)) return false;
    tail = std::move(bytes);
    tail_at = size - length;
    return true;
}

bool Source::read(uint64_t offset, uint64_t length, uint8_t* bytes, fhash_error& error) const {
    if (offset > size || length > size - offset)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "%llu bytes at offset %llu are outside the file of %llu bytes",
                    (unsigned long long)length, (unsigned long long)offset,
                    (unsigned long long)size);
    if (!tail.empty() && offset + length > tail_at) {
        const uint64_t before = offset < tail_at ? tail_at - offset : 0;
        std::memcpy(bytes + before, tail.data() + (offset + before - tail_at), length - before);
        length = before;
    }
    if (length && function(user, offset, length, bytes) != 0)
        return fail(error, FHASH_ERROR_READ, "%llu bytes at offset %llu cannot be read",
                    (unsigned long long)length, (unsigned long long)offset);
    return true;
}

bool Source::read(uint64_t offset, uint64_t length, Buffer& bytes, fhash_error& error) const {
    if (offset > size || length > size - offset) return read(offset, length, nullptr, error);
    if (!may_use(*context, length, error)) return false;
    bytes.resize(size_t(length));
    return read(offset, length, bytes.data(), error);
}

bool is_document(const std::string& name) {
    static const std::string DOCUMENT = "zarr.json";
    const size_t start = name.rfind('/');
    return name.compare(start == std::string::npos ? 0 : start + 1, std::string::npos, DOCUMENT) ==
           0;
}

uint32_t crc_32(const uint8_t* data, size_t size, uint32_t begun) {
    return uint32_t(crc32_z(begun, data, size));
}

uint64_t entry_size(const Member& member) { return directory_entry(member).size(); }

const Member* Directory::find(const std::string& name) const {
    const auto found = numbers.find(name);
    return found == numbers.end() ? nullptr : &members[found->second];
}

bool refuse_version(int major, fhash_error& error) {
    return fail(error, FHASH_ERROR_UNSUPPORTED,
                "the file is of format %d.x; this version reads format %d.x: %s", major, MAJOR,
                major > MAJOR ? "upgrade" : "encode the source again");
}

bool read_directory(Source& source, Directory& found, fhash_error& error) {
    if (!source.read_tail(error)) return false;
    size_t start = 0;
    int major = 0;
    if (!find_comment(source.tail, start, major))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "not an fhash container, or one that was cut short: no fhash signature at its "
                    "end");
    if (major != MAJOR) return refuse_version(major, error);
    const uint64_t comment_at = source.tail_at + start;
    End end;
    Buffer directory;
    if (!read_end(source, comment_at, end, error)) return false;
    // An entry takes several times its bytes, unpacked.
    if (!may_use(*source.context, 5 * end.size, error)) return false;
    if (!source.read(end.offset, comment_at - end.offset, directory, error)) return false;
    uint8_t digest[32];
    sha256(directory.data(), directory.size(), digest);
    for (int i = 0; i < 32; i++) std::snprintf(found.digest + 2 * i, 3, "%02x", digest[i]);
    if (std::memcmp(found.digest, source.tail.data() + source.tail.size() - 64, 64))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the ZIP directory is damaged: its SHA-256 differs from that in the comment");
    const Buffer records = end_records(end);
    if (directory.size() - end.size != records.size() ||
        std::memcmp(directory.data() + end.size, records.data(), records.size()))
        return fail(error, FHASH_ERROR_DAMAGED,
                    "the end record of the ZIP directory contradicts itself");
    return parse_entries(directory, end, found, error);
}

bool check_header(const Member& member, const uint8_t* stored, fhash_error& error) {
    const Buffer header = local_header(member);
    return !std::memcmp(stored, header.data(), header.size()) ||
           fail(error, FHASH_ERROR_DAMAGED, "member %s: its header differs from the directory",
                member.name.c_str());
}

bool check_member(const Member& member, const uint8_t* stored, fhash_error& error) {
    if (!check_header(member, stored, error)) return false;
    const uint8_t* const data = stored + (member.data_offset() - member.offset);
    if (member.full_size < 0 && crc_32(data, size_t(member.size)) != member.crc)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "member %s: its CRC-32 differs, the data are damaged", member.name.c_str());
    return true;
}

bool open_member(const Member& member, const uint8_t* stored, Buffer& data, fhash_error& error) {
    if (!check_member(member, stored, error)) return false;
    const uint8_t* start = stored + (member.data_offset() - member.offset);
    if (member.full_size < 0) {
        data.assign(start, start + member.size);
        return true;
    }
    data.resize(size_t(member.full_size));
    if (!inflate_exact(start, size_t(member.size), false, data.data(), data.size(), error))
        return fail_in(error, "member " + member.name);
    if (crc_32(data.data(), data.size()) != member.crc)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "member %s: its CRC-32 differs, the data are damaged", member.name.c_str());
    return true;
}

namespace {

const uint32_t ROUNDS[64] = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2,
};

uint32_t turned(uint32_t value, int bits) { return value >> bits | value << (32 - bits); }

void add_block(uint32_t state[8], const uint8_t* block) {
    uint32_t w[64], s[8];
    for (int i = 0; i < 16; i++)
        w[i] = uint32_t(block[4 * i]) << 24 | uint32_t(block[4 * i + 1]) << 16 |
               uint32_t(block[4 * i + 2]) << 8 | block[4 * i + 3];
    for (int i = 16; i < 64; i++) {
        const uint32_t a = w[i - 15], b = w[i - 2];
        w[i] = w[i - 16] + (turned(a, 7) ^ turned(a, 18) ^ a >> 3) + w[i - 7] +
               (turned(b, 17) ^ turned(b, 19) ^ b >> 10);
    }
    std::copy(state, state + 8, s);
    for (int i = 0; i < 64; i++) {
        const uint32_t first = s[7] + (turned(s[4], 6) ^ turned(s[4], 11) ^ turned(s[4], 25)) +
                               ((s[4] & s[5]) ^ (~s[4] & s[6])) + ROUNDS[i] + w[i];
        const uint32_t second = (turned(s[0], 2) ^ turned(s[0], 13) ^ turned(s[0], 22)) +
                                ((s[0] & s[1]) ^ (s[0] & s[2]) ^ (s[1] & s[2]));
        std::copy_backward(s, s + 7, s + 8);
        s[4] += first;
        s[0] = first + second;
    }
    for (int i = 0; i < 8; i++) state[i] += s[i];
}

}  // namespace

void sha256(const uint8_t* data, size_t size, uint8_t digest[32]) {
    uint32_t state[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                         0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    for (size_t at = 0; at + 64 <= size; at += 64) add_block(state, data + at);
    uint8_t rest[128] = {};
    const size_t left = size % 64, room = left < 56 ? 64 : 128;
    if (left) std::memcpy(rest, data + size - left, left);
    rest[left] = 0x80;
    for (int i = 0; i < 8; i++) rest[room - 1 - i] = uint8_t(uint64_t(size) * 8 >> 8 * i);
    for (size_t at = 0; at < room; at += 64) add_block(state, rest + at);
    for (int i = 0; i < 32; i++) digest[i] = uint8_t(state[i / 4] >> (24 - 8 * (i % 4)));
}

}  // namespace fhash
