#include "inflate.hpp"

#define ZSTD_STATIC_LINKING_ONLY
#include "third_party/zlib/zlib.h"
#include "third_party/zstd/zstd.h"
#include "third_party/zstd/zstd_errors.h"

namespace fhash {

namespace {

// zlib counts in `uInt`: longer data are given in pieces.
constexpr size_t PIECE = size_t(1) << 30;
// Decoded bytes per byte of zstd data: a block of at most 128 KiB takes at least 4 (RFC 8878).
constexpr uint64_t ZSTD_MAX_RATIO = 32 << 10;

uInt piece(size_t left) { return uInt(left < PIECE ? left : PIECE); }

}  // namespace

bool inflate_exact(const uint8_t* data, size_t size, bool zlib_header, uint8_t* out, size_t count,
                   fhash_error& error) {
    z_stream stream = {};
    if (inflateInit2(&stream, zlib_header ? MAX_WBITS : -MAX_WBITS) != Z_OK)
        return fail(error, FHASH_ERROR_MEMORY, "no memory to inflate");
    uint8_t spare = 0;  // one byte more than `count` shows that there are too many
    size_t in = 0, made = 0;
    int state = Z_OK;
    while (state == Z_OK) {
        const uInt given = piece(size - in);
        const uInt room = made < count ? piece(count - made) : 1;
        stream.next_in = const_cast<Bytef*>(data + in);
        stream.avail_in = given;
        stream.next_out = made < count ? out + made : &spare;
        stream.avail_out = room;
        state = inflate(&stream, Z_NO_FLUSH);
        in += given - stream.avail_in;
        made += room - stream.avail_out;
        if (made > count) break;
    }
    inflateEnd(&stream);
    if (state == Z_MEM_ERROR) return fail(error, FHASH_ERROR_MEMORY, "no memory to inflate");
    if (state != Z_STREAM_END || made != count || in != size)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "deflated data are damaged: they do not inflate to the %zu bytes that are "
                    "declared",
                    count);
    return true;
}

bool deflate_level6(const uint8_t* data, size_t size, std::vector<uint8_t>& out) {
    z_stream stream = {};
    if (deflateInit(&stream, 6) != Z_OK) return false;
    out.resize(deflateBound(&stream, uLong(size)));
    size_t in = 0, made = 0;
    int state = Z_OK;
    while (state == Z_OK) {
        const uInt given = piece(size - in), room = piece(out.size() - made);
        stream.next_in = const_cast<Bytef*>(data + in);
        stream.avail_in = given;
        stream.next_out = out.data() + made;
        stream.avail_out = room;
        state = deflate(&stream, in + given == size ? Z_FINISH : Z_NO_FLUSH);
        in += given - stream.avail_in;
        made += room - stream.avail_out;
    }
    deflateEnd(&stream);
    out.resize(made);
    return state == Z_STREAM_END;
}

bool zstd_exact(const uint8_t* data, size_t size, uint64_t least, uint64_t most,
                std::vector<uint8_t>& out, fhash_error& error) {
    const unsigned long long declared = ZSTD_getFrameContentSize(data, size);
    if (declared == ZSTD_CONTENTSIZE_ERROR || ZSTD_isSkippableFrame(data, size))
        return fail(error, FHASH_ERROR_DAMAGED, "not a zstd frame");
    if (declared == ZSTD_CONTENTSIZE_UNKNOWN || declared < least || declared > most)
        return fail(error, FHASH_ERROR_DAMAGED, "zstd declares %llu bytes; the chunk has %llu",
                    declared, (unsigned long long)most);
    if (declared > ZSTD_MAX_RATIO * size)
        return fail(error, FHASH_ERROR_DAMAGED,
                    "zstd declares %llu bytes, which %zu bytes cannot hold", declared, size);
    if (ZSTD_findFrameCompressedSize(data, size) != size)
        return fail(error, FHASH_ERROR_DAMAGED, "zstd data are damaged: not one frame");
    out.resize(size_t(declared));
    const size_t made = ZSTD_decompress(out.data(), out.size(), data, size);
    if (ZSTD_isError(made) && ZSTD_getErrorCode(made) == ZSTD_error_memory_allocation)
        return fail(error, FHASH_ERROR_MEMORY, "no memory to decompress a chunk");
    if (ZSTD_isError(made) || made != declared)
        return fail(error, FHASH_ERROR_DAMAGED, "zstd data are damaged: %s",
                    ZSTD_isError(made) ? ZSTD_getErrorName(made) : "another number of bytes");
    return true;
}

}  // namespace fhash
