// Encoder of the fast coder (fast.hpp), and its prices.
//
// With PRICE nothing is written: the bytes are those that it would take, and by these transforms
// are compared.
#pragma once

#include "fast.hpp"

namespace {

enum Mode { PRICE, CHOOSE, ENCODE };  // CHOOSE encodes magnitudes chosen by rate and error

// A symbol by its context and itself.
FHASH_INLINE int in_context(int context, int symbol) { return context * TOKENS + symbol; }
const int SYMBOLS = (CONTEXTS + 1) * TOKENS;
const float SMALLEST = 0.5F;  // value that may become an integer other than 0

// Bits in the order in which they are read, the lowest of a byte first.
struct BitsOut {
    std::vector<uint8_t> bytes;
    uint64_t now = 0;
    int used = 0;

    void put(uint64_t value, int count) {  // at most 32
        now |= value << used;
        for (used += count; used >= 8; used -= 8, now >>= 8) bytes.push_back((uint8_t)now);
    }
    void finish() {
        if (used) bytes.push_back((uint8_t)now);
        now = 0;
        used = 0;
    }
};

struct Task {
    int32_t* q;           // null where prices are asked for
    const float* values;  // where integers are chosen: those that they stand for
    float scale;          // of the values: 1 / step
    double weight;        // squared steps that a bit is worth
    const int64_t* shape;
    const int32_t* table;
    size_t bands;
    const Prior& prior;
};

template <Mode MODE>
using FlagWriter = typename std::conditional<MODE == PRICE, Counter, Encoder>::type;

template <Mode MODE> struct Writer : Lattice<Writer<MODE>, FlagWriter<MODE>> {
    using Base = Lattice<Writer<MODE>, FlagWriter<MODE>>;
    using Base::row, Base::all_rows, Base::place_of;

    static const bool CHOOSES = MODE == PRICE || MODE == CHOOSE;
    const Task& task;
    uint32_t counts[SYMBOLS][LANES] = {};  // by lane, so that none waits for the one before
    int64_t raw = 0;                       // bits beside
    double squares = 0;
    BitsOut out;
    std::vector<Shorts> steps;  // what the lanes code at one time: symbols in their contexts
    float lower[CONTEXTS + 1][TOKENS] = {};  // of a magnitude: below it, one less is cheaper
    float zero_of_two[CONTEXTS + 1] = {};    // below it a 2 is worth less than its bits
    std::vector<float> largest;  // value in each block of the band
    float least_far;             // value that is worth a symbol where all around is 0
    Floats rests = {};           // sums of the squared errors of a row
    Ints given[2];               // of the block, by parity: values, as bits of floats, or integers

    Writer(const Task& of, FlagWriter<MODE> flag_coder)
        : Base(of.shape, of.prior, of.bands, flag_coder), task(of) {}

    FHASH_INLINE void run_all() {
        if (CHOOSES) weigh();
        Base::run();
        end_row();
    }

    // Bits of the tokens by the defaults of the prior, so that magnitudes can be chosen.
    void weigh() {
        for (int context = 0; context <= NOTHING; context++) {
            const int choice = context < OF_SIGNS ? task.prior.defaults[context] : 0;
            const uint16_t* const slots = task.prior.slots[choice];
            const int level = context % LEVELS;
            float bits[DIRECT];
            for (int token = 0; token < DIRECT; token++)
                bits[token] = PRECISION - std::log2((float)max<int>(slots[token], 1)) + (token > 0);
            for (int token = 0; token < TOKENS; token++) {
                const bool raw_too = token == 0 || token >= DIRECT || low_bits(level) > 0;
                const float more = raw_too ? 0.0F : bits[token] - bits[token - 1];
                lower[context][token] = (float)(task.weight / 2) * max(more, 0.0F) - 0.5F;
            }
            const bool raw_too = low_bits(level) > 0;
            const float more = bits[2] - bits[0];
            zero_of_two[context] = raw_too ? 0.0F : 1 + (float)(task.weight / 4) * more;
        }
    }

    // Values of a block, or its integers, and zeros behind the end of a row.
    template <class Each> FHASH_INLINE void values_of(int64_t place, int room, Each each) const {
        static_assert(sizeof(float) == sizeof(int32_t), "either is a lane");
        const char* from = CHOOSES ? reinterpret_cast<const char*>(task.values + place)
                                   : reinterpret_cast<const char*>(task.q + place);
        Ints kept[2] = {};
        if (room < BLOCK) {
            std::memcpy(kept, from, sizeof(float) * (size_t)room);
            from = reinterpret_cast<const char*>(kept);
        }
        each(loaded<Ints>(from), loaded<Ints>(from + sizeof(Ints)));
    }
    // Their magnitudes, in steps.
    FHASH_INLINE Floats sizes_of(Ints values) const {
        if (!CHOOSES) return floats(values < 0 ? -values : values);
        const Floats scaled = (Floats)values * task.scale;
        return (Floats)((Ints)scaled & 0x7fffffff);
    }

    // Find out whether a band has integers, and how large they are.
    FHASH_INLINE void look_at(Band& band) {
        const int blocks = band.blocks;
        least_far = CHOOSES ? 1 + lower[Base::group_of(band.kind) * 2 * LEVELS][1] : SMALLEST;
        const int64_t rows = (int64_t)band.size[0] * band.size[1] * band.size[2];
        largest.resize((size_t)(rows * blocks));
        float* at = largest.data();
        int64_t count = 0;
        double total = 0, error = 0;
        all_rows(band, [&](int t, int z, int y) FHASH_LAMBDA {
            const int64_t place = place_of(band, t, z, y);
            Ints large = {};
            Floats totals = {}, squared = {};
            for (int k = 0; k < blocks; k++) {
                const int room = min(band.size[3] - BLOCK * k, BLOCK);
                values_of(place + BLOCK * k, room, [&](Ints a, Ints b) FHASH_LAMBDA {
                    const Floats first = sizes_of(a), second = sizes_of(b);
                    // Floats that are not negative have the order of their bits.
                    const Ints larger = most((Ints)first, (Ints)second);
                    int32_t bits = 0;
                    for (int i = 0; i < LANES; i++) bits = max(bits, larger[i]);
                    std::memcpy(at++, &bits, sizeof bits);
                    squared += first * first + second * second;
                    large -= (first >= SMALLEST) + (second >= SMALLEST);
                    totals += (Floats)((Ints)first & (first >= SMALLEST));
                    totals += (Floats)((Ints)second & (second >= SMALLEST));
                });
            }
            count += sum(large);
            for (int i = 0; i < LANES; i++) {
                total += totals[i];
                error += squared[i];
            }
        });
        band.any = count > 0;
        if (!band.any) squares += error;
        const double many = (double)MANY * (double)count;
        while (total > many * (1 << band.shift) && band.shift < MAX_SHIFT) band.shift++;
    }

    // Whether some values of the row are worth a symbol. Else they are zeros.
    FHASH_INLINE int some_in_row() {
        const float* const of = largest.data() + row.number * row.blocks;
        for (int k = 0; k < row.blocks; k++)
            if (of[k] >= least_far) return 1;
        for (int k = 0; k < row.blocks; k++) leave_out(k);
        end_row();
        return 0;
    }
    // The same of a block. is_near: whether there are others than zeros around it.
    FHASH_INLINE int some_in_block(int number, bool is_near) {
        const float of = largest[(size_t)(row.number * row.blocks + number)];
        if (of >= (is_near ? SMALLEST : least_far)) return 1;
        leave_out(number);
        return 0;
    }

    // Count the errors of a block of zeros.
    FHASH_INLINE void leave_out(int number) {
        if (!CHOOSES) return;
        const int64_t first = (int64_t)BLOCK * number;
        const int room = (int)min<int64_t>(row.length - first, BLOCK);
        values_of(row.place + first, room, [&](Ints a, Ints b) FHASH_LAMBDA {
            const Floats one = sizes_of(a), other = sizes_of(b);
            rests += one * one + other * other;
        });
    }
    // Add the errors of a row, which are summed in single precision.
    FHASH_INLINE void end_row() {
        for (int i = 0; i < LANES; i++) squares += rests[i];
        rests = Floats{};
    }

    FHASH_INLINE void begin_block(int number) {
        const int64_t first = (int64_t)BLOCK * number;
        const int room = (int)min<int64_t>(row.length - first, BLOCK);
        values_of(row.place + first, room, [&](Ints a, Ints b) FHASH_LAMBDA {
            given[0] = evens(a, b);
            given[1] = odds(a, b);
        });
    }
    FHASH_INLINE void end_block(const Half& even, const Half& odd, int number, int room) {
        if constexpr (MODE == CHOOSE) Base::keep_integers(task.q, even, odd, number, room);
    }

    // The magnitudes next to some sizes, or one less, or zero: what costs least.
    FHASH_INLINE Ints choose(Floats sizes, Ints contexts) {
        sizes = sizes < 1e9F ? sizes : Floats{} + 1e9F;  // also for NaN
        const Ints nearest = __builtin_convertvector(sizes + 0.5F, Ints);
        Ints chosen = nearest;
        if (any(nearest)) {
            const Ints at = contexts * TOKENS + least(nearest, all(LAST));
            Floats edges;
            for (int i = 0; i < LANES; i++) edges[i] = lower[0][at[i]];
            chosen += sizes < floats(nearest) + edges;
            const Ints twos = chosen == 2;
            if (any(twos)) {
                for (int i = 0; i < LANES; i++) edges[i] = zero_of_two[contexts[i]];
                chosen &= ~(twos & (sizes < edges));
            }
        }
        const Floats rest = sizes - floats(chosen);
        rests += rest * rest;
        return chosen;
    }

    FHASH_INLINE void code_half(Half& half, int parity) {
        const Ints values = given[parity];
        if (CHOOSES) half.magnitudes = choose(sizes_of(values), half.contexts);
        else half.magnitudes = values < 0 ? -values : values;
        const Ints tokens = tokens_of(half.magnitudes >> half.low);
        write_step(half.contexts, tokens);
        if (any(half.low | (tokens >= DIRECT)))
            for (int i = 0; i < LANES; i++)
                if (half.low[i] || tokens[i] >= DIRECT)
                    write_magnitude(half.magnitudes[i], tokens[i], half.low[i]);
        half.signs = Ints{};
        if (!any(half.magnitudes)) return;
        const Ints there = half.magnitudes != 0, negative = (values >> 31) & 1;
        half.signs = (1 - 2 * negative) & there;
        write_step(there ? half.odds : all(NOTHING), (half.foretold ^ negative) & there);
    }

    FHASH_INLINE void write_step(Ints contexts, Ints symbols) {
        const Shorts step = __builtin_convertvector(contexts * TOKENS + symbols, Shorts);
        for (int i = 0; i < LANES; i++) counts[step[i]][i]++;
        if (MODE != PRICE) steps.push_back(step);
    }

    FHASH_INLINE void write_magnitude(int magnitude, int token, int low) {
        const int high = magnitude >> low;
        int bits = low;
        if (token >= DIRECT) bits += token - DIRECT + 1;
        if (token == LAST) {
            const uint32_t rest = (uint32_t)(high - FIRST[LAST]) + (1u << LAST_BITS);
            const int length = significant(rest) - 1;
            bits += 2 * (length - LAST_BITS) + 1;
            if (MODE != PRICE) {
                out.put(1ull << (length - LAST_BITS), length - LAST_BITS + 1);
                out.put(rest & ((1u << length) - 1), length);
            }
        } else if (MODE != PRICE && token >= DIRECT) {
            out.put((uint64_t)(high - FIRST[token]), token - DIRECT + 1);
        }
        if (MODE != PRICE) out.put((uint64_t)magnitude & ((1ull << low) - 1), low);
        raw += bits;
    }
};

// The distribution of each context that takes the fewest bits for what was counted. Their bits.
double choose_distributions(const uint32_t (*counts)[LANES], const Prior& prior, uint8_t* chosen) {
    std::vector<float> bits((size_t)CERTAIN * TOKENS);
    for (int d = 0; d < CERTAIN; d++)
        for (int token = 0; token < TOKENS; token++) {
            const int slots = prior.slots[d][token];
            bits[(size_t)d * TOKENS + token] = slots ? PRECISION - std::log2((float)slots) : 1e6F;
        }
    double total = 0;
    for (int context = 0; context < CONTEXTS; context++) {
        const int first = context < OF_SIGNS ? 0 : CHOICES;
        double numbers[TOKENS], any = 0, least = 0;
        for (int token = 0; token < TOKENS; token++) {
            int64_t sum = 0;
            for (int i = 0; i < LANES; i++) sum += counts[in_context(context, token)][i];
            numbers[token] = (double)sum;
            any += numbers[token];
        }
        chosen[context] = prior.defaults[context];
        if (any == 0) continue;
        for (int pass = -1; pass < CHOICES; pass++) {
            const int choice = pass < 0 ? prior.defaults[context] : pass;
            double sum = pass < 0 ? 0 : CHOICE_BITS;
            const float* const of = &bits[(size_t)(first + choice) * TOKENS];
            for (int token = 0; token < TOKENS; token++) sum += numbers[token] * (double)of[token];
            if (pass >= 0 && sum >= least) continue;
            least = sum;
            chosen[context] = (uint8_t)choice;
        }
        total += least;
    }
    return total;
}

// The words of the lanes: the steps are coded backwards, so that they are read forwards.
FHASH_INLINE void write_words(const std::vector<Shorts>& steps, const Prior& prior,
                              const uint8_t* chosen, std::vector<uint8_t>& bytes) {
    // x / slots is x * inverse >> 43, for all states x below slots << 21.
    struct Symbol {
        uint64_t inverse;
        uint32_t slots, first;
    };
    const int INVERSE_BITS = 43;
    if (steps.empty()) return;
    std::vector<Symbol> symbols((size_t)SYMBOLS);
    for (int context = 0; context <= NOTHING; context++) {
        const int first_choice = context < OF_SIGNS ? 0 : CHOICES;
        const int d = context == NOTHING ? CERTAIN : chosen[context] + first_choice;
        uint32_t first = 0;
        for (int token = 0; token < TOKENS; token++) {
            const uint32_t slots = max<uint32_t>(prior.slots[d][token], 1);
            const uint64_t inverse = ((1ull << INVERSE_BITS) + slots - 1) / slots;
            symbols[(size_t)in_context(context, token)] = {inverse, slots, first};
            first += prior.slots[d][token];
        }
    }
    std::vector<uint8_t> words(2 * LANES * steps.size() + 4 * LANES);
    uint8_t* at = words.data() + words.size();
    uint32_t state[LANES];
    for (uint32_t& x : state) x = LEAST_STATE;
    for (size_t n = steps.size(); n-- > 0;)
        for (int i = LANES; i-- > 0;) {
            const Symbol& of = symbols[steps[n][i]];
            uint32_t x = state[i];
            at[-2] = (uint8_t)x;
            at[-1] = (uint8_t)(x >> 8);
            const bool full = x >= (uint64_t)of.slots << (32 - PRECISION);
            at -= full ? 2 : 0;
            x = full ? x >> 16 : x;
            const uint32_t times = (uint32_t)(x * of.inverse >> INVERSE_BITS);
            state[i] = (times << PRECISION) + (x - times * of.slots) + of.first;
        }
    for (int i = LANES; i-- > 0;)
        for (int byte = 3; byte >= 0; byte--) *--at = (uint8_t)(state[i] >> (8 * byte));
    bytes.insert(bytes.end(), at, words.data() + words.size());
}

void put_section(std::vector<uint8_t>& to, const std::vector<uint8_t>& section) {
    uint64_t size = section.size();
    for (; size > 127; size >>= 7) to.push_back((uint8_t)(size | 128));
    to.push_back((uint8_t)size);
    to.insert(to.end(), section.begin(), section.end());
}

template <Mode MODE>
FHASH_INLINE int64_t write(const Task& task, std::vector<uint8_t>& bytes, double* results) {
    std::vector<uint8_t> flag_bytes;
    FlagWriter<MODE> flag_coder;
    if constexpr (MODE != PRICE) flag_coder.out = &flag_bytes;
    const auto writer = std::make_unique<Writer<MODE>>(task, flag_coder);
    if (!read_bands(task.table, task.shape, writer->bands)) return -1;
    writer->run_all();
    uint8_t chosen[CONTEXTS];
    results[0] = choose_distributions(writer->counts, task.prior, chosen) + (double)writer->raw;
    results[1] = writer->squares;
    if constexpr (MODE == PRICE) results[0] += (double)writer->range.bits / 2048;
    results[0] /= 8;
    if constexpr (MODE == PRICE) return 0;
    else writer->range.finish();
    BitsOut choices;
    for (int context = 0; context < CONTEXTS; context++) {
        const bool other = chosen[context] != task.prior.defaults[context];
        choices.put(other, 1);
        if (other) choices.put(chosen[context], CHOICE_BITS);
    }
    choices.finish();
    writer->out.finish();
    std::vector<uint8_t>& raw = writer->out.bytes;
    raw.insert(raw.begin(), choices.bytes.begin(), choices.bytes.end());
    while (!raw.empty() && !raw.back()) raw.pop_back();  // the decoder reads zeros past the end
    put_section(bytes, flag_bytes);
    put_section(bytes, raw);
    write_words(writer->steps, task.prior, chosen, bytes);
    return 0;
}

}  // namespace

// See fast.cpp.
int64_t FHASH_FAST(encode)(int32_t* q, const float* values, double scale, double weight,
                           const int64_t* shape, const int32_t* table, int64_t count,
                           const uint16_t* slots, const uint8_t* defaults, uint8_t* data,
                           int64_t capacity, double* results) {
    return guarded([&]() -> int64_t {
        const Prior prior = {reinterpret_cast<const uint16_t(*)[TOKENS]>(slots), defaults, nullptr};
        const Task task = {q,     values, (float)scale,  weight,
                           shape, table,  (size_t)count, prior};
        std::vector<uint8_t> bytes;
        const int64_t code = !q ? write<PRICE>(task, bytes, results)
                             : values ? write<CHOOSE>(task, bytes, results)
                                      : write<ENCODE>(task, bytes, results);
        if (code < 0) return code;
        if ((int64_t)bytes.size() <= capacity && !bytes.empty())
            std::memcpy(data, bytes.data(), bytes.size());
        return (int64_t)bytes.size();
    });
}
