// Decoder of the fast coder (fast.hpp). Any bytes decode to some integers.
#pragma once

#include "fast.hpp"

namespace {

struct BitsIn {
    std::vector<uint8_t> bytes;  // with zeros behind the end
    uint64_t at = 0, end = 0;    // in bits
    bool damaged = false;

    BitsIn(const uint8_t* data, int64_t size)
        : bytes((size_t)size + 16, 0), end(8 * (uint64_t)size) {
        if (size) std::memcpy(bytes.data(), data, (size_t)size);
    }
    FHASH_INLINE uint64_t peek() {  // 57 bits at least
        at = min(at, end);
        const uint8_t* const p = bytes.data() + (at >> 3);
        uint64_t word = 0;
        for (int i = 0; i < 8; i++) word |= (uint64_t)p[i] << (8 * i);
        return word >> (at & 7);
    }
    FHASH_INLINE uint32_t take(int count) {  // at most 32
        const uint64_t value = peek() & ((1ull << count) - 1);
        at += (uint64_t)count;
        return (uint32_t)value;
    }
};

#if FHASH_TARGET == 3
// By a mask of lanes: how many of them come before each.
struct Order {
    uint8_t of[1 << LANES][LANES] = {};

    constexpr Order() {
        for (int mask = 0; mask < 1 << LANES; mask++)
            for (int i = 1; i < LANES; i++)
                of[mask][i] = (uint8_t)(of[mask][i - 1] + (mask >> (i - 1) & 1));
    }
};
constexpr Order order;  // nothing of this file may run when the library is loaded
#endif

struct Reader : Lattice<Reader, Decoder> {
    int32_t* const q;
    BitsIn in;
    Ints state = {};
    std::vector<uint8_t> words;
    const uint8_t *word = nullptr, *end = nullptr;
    int32_t lookups[CONTEXTS + 1];  // where the distribution of each context begins

    Reader(int32_t* to, const int64_t* of, const Prior& with, bool on_trellis, size_t count,
           Decoder flag_coder, BitsIn bits)
        : Lattice(of, with, on_trellis, on_trellis, count, flag_coder), q(to), in(bits) {}

    // What only an encoder knows.
    FHASH_INLINE void look_at(Band&) {}
    FHASH_INLINE int some_in_row() { return 0; }
    FHASH_INLINE int some_in_block(int, bool) { return 0; }

    // Begin to read the lanes.
    void begin(const uint8_t* data, int64_t size) {
        bool any_chosen = false;  // in the group of contexts
        for (int context = 0; context < CONTEXTS; context++) {
            uint32_t choice = prior.defaults[context];
            const bool used = is_used(context, trellis);
            if (used && context % LEVELS == 0) any_chosen = in.take(1) != 0;
            if (used && any_chosen && in.take(1)) choice = in.take(CHOICE_BITS);
            const uint32_t first = context < OF_SIGNS ? 0 : CHOICES;
            lookups[context] = (int32_t)((choice + first) << PRECISION);
        }
        lookups[NOTHING] = CERTAIN << PRECISION;
        in.at = (in.at + 7) & ~7ull;
        words.assign((size_t)size + 4 * LANES + 2 * LANES, 0);
        if (size) std::memcpy(words.data(), data, (size_t)size);
        word = words.data();
        for (int i = 0; i < LANES; i++)
            for (int shift = 0; shift < 32; shift += 8)
                state[i] |= (int32_t)((uint32_t)*word++ << shift);
        end = words.data() + max<int64_t>(size, 4 * LANES);
    }

    FHASH_INLINE void begin_block(int) {}
    FHASH_INLINE void end_block(const Half& even, const Half& odd, int number, int room) {
        keep_integers(q, even, odd, number, room);
    }

    FHASH_INLINE void code_half(Half& half, int) {
        const Ints tokens = read_step(half.contexts);
        half.magnitudes = tokens;
        if (any(half.low | (tokens >= DIRECT)))
            for (int i = 0; i < LANES; i++)
                if (half.low[i] || tokens[i] >= DIRECT)
                    half.magnitudes[i] = read_magnitude(tokens[i], half.low[i]);
        half.signs = Ints{};
        if (!any(half.magnitudes)) return;
        const Ints there = half.magnitudes != 0;
        const Ints negative = read_step(there ? half.odds : all(NOTHING)) ^ half.foretold;
        half.signs = (1 - 2 * negative) & there;
    }

    // The symbols of some contexts.
    FHASH_INLINE Ints read_step(Ints contexts) {
        Ints entries;
        const Ints slots = state & (int32_t)(SLOTS - 1);
        for (int i = 0; i < LANES; i++)
            entries[i] = (int32_t)prior.lookup[lookups[contexts[i]] | slots[i]];
        const Words of = (Words)entries, before = (Words)state;
        const Words after = (of >> 16) * (before >> PRECISION) + (of >> 4 & 0xfff);
        state = (Ints)after;
        read_words();
        return entries & (TOKENS - 1);
    }

    // Each lane that is low reads a word, in their order.
    FHASH_INLINE void read_words() {
        const Ints needs = (Words)state < LEAST_STATE;
#if FHASH_TARGET == 3
        const int mask = lanes_of(needs);
        const __m128i places_of = _mm_loadl_epi64((const __m128i*)order.of[mask]);
        const __m256i places = _mm256_cvtepu8_epi32(places_of);
        const __m256i ahead = _mm256_cvtepu16_epi32(_mm_loadu_si128((const __m128i*)word));
        const Ints next = (Ints)_mm256_permutevar8x32_epi32(ahead, places);
        const uint8_t* const at = word + 2 * __builtin_popcount((unsigned)mask);
#else
        const uint8_t* at = word;
        Ints next = state;
        for (int i = 0; i < LANES; i++) {
            next[i] = at[0] | at[1] << 8;
            at -= 2 * needs[i];
        }
#endif
        state = needs ? state << 16 | next : state;
        word = min(at, end);
    }

    FHASH_INLINE int read_magnitude(int token, int low) {
        uint64_t high = (uint64_t)token;
        if (token == LAST) {
            const uint64_t ahead = in.peek();
            int more = 0;
            while (more < MAX_LOW && !(ahead >> more & 1)) more++;
            const int length = min(more + LAST_BITS, 30);
            in.at += (uint64_t)more + 1;
            high = FIRST[LAST] + ((1ull << length) | in.take(length)) - (1u << LAST_BITS);
        } else if (token >= DIRECT) high = (uint64_t)FIRST[token] + in.take(token - DIRECT + 1);
        low = min(low, MAX_LOW);
        const uint64_t magnitude = high << low | in.take(low);
        const uint64_t largest = trellis ? MAX_INTEGER / 2 : MAX_INTEGER;
        if (magnitude > largest) in.damaged = true;
        return (int)min(magnitude, largest);
    }
};

// The section at the start of some bytes, which are then those after it. False where there is none.
bool take_section(const uint8_t*& data, int64_t& size, const uint8_t*& section, int64_t& length) {
    uint64_t number = 0;
    for (int shift = 0;; shift += 7) {
        if (!size || shift > 56) return false;
        const uint8_t byte = *data++;
        size--;
        number |= (uint64_t)(byte & 127) << shift;
        if (byte < 128) break;
    }
    if (number > (uint64_t)size) return false;
    section = data;
    length = (int64_t)number;
    data += number;
    size -= length;
    return true;
}

int64_t read(int32_t* q, bool trellis, const int64_t* shape, const int32_t* table,
                          int64_t count, const Prior& prior, const uint8_t* data, int64_t size) {
    const uint8_t *flags, *raw;
    int64_t flag_count, raw_count;
    if (!take_section(data, size, flags, flag_count) || !take_section(data, size, raw, raw_count))
        return -1;
    const Decoder flag_coder(flags, flag_count);
    const auto reader = std::make_unique<Reader>(q, shape, prior, trellis, (size_t)count,
                                                 flag_coder, BitsIn(raw, raw_count));
    if (!read_bands(table, shape, reader->bands)) return -1;
    reader->begin(data, size);
    reader->run();
    return reader->in.damaged ? -1 : 0;
}

}  // namespace
