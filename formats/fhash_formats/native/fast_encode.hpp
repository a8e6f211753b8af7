// Encoder of the fast coder (fast.hpp), and its prices.
//
// With PRICE nothing is written: the bytes are those that it would take, and by these transforms
// are compared. On a trellis of two quantisers, GUESS finds the path through it for each lane, by
// the contexts that guessed integers have, and FOLLOW writes it. The mode is known at run time: a
// block of 16 vertices is so much work that asking for it costs nothing.
#pragma once

#include "fast.hpp"

namespace {

enum Mode { PRICE, CHOOSE, ENCODE, GUESS, FOLLOW };  // CHOOSE: by rate and error

// A symbol by its context and itself.
FHASH_INLINE int in_context(int context, int symbol) { return context * TOKENS + symbol; }
const int SYMBOLS = (CONTEXTS + 1) * TOKENS;
const float SMALLEST = 0.5F;  // value that may become an integer other than 0
// The index of a value on a trellis: 0 below the first one, else half of it and the other.
const float GUESSED_ZERO = 1.05F, GUESSED_MORE = 0.7F;

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

// Bits of each symbol by its distribution; too many where it has no slots.
struct SymbolBits {
    float of[TOKENS][CERTAIN];
    const uint8_t* const defaults;

    explicit SymbolBits(const Prior& prior) : defaults(prior.defaults) {
        for (int d = 0; d < CERTAIN; d++)
            for (int token = 0; token < TOKENS; token++) {
                const int slots = prior.slots[d][token];
                of[token][d] = slots ? PRECISION - std::log2((float)slots) : 1e6F;
            }
    }
    // Bits of an index in a context, by the defaults of the prior, with those of its sign.
    FHASH_INLINE float of_index(int context, int index, int token) const {
        const int beside = max(token - DIRECT + 1, 0);
        return of[token][defaults[context]] + (float)(beside + (index > 0));
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
    const SymbolBits& bits;
    bool trellis;
};

// What GUESS finds of a band.
struct Known {
    bool any = false;
    int shift = 0;
};

// The paths of the lanes through a trellis (Viterbi 1967): those of least squared error and bits to
// each of its states, and of each place that a path goes through what the way back needs.
struct Paths {
    static const int STATES = 8, RATES = 16;  // indices from the last one on have its bits
    static const int RENEWED = 256;           // places after which the least cost is subtracted
    struct Places {
        float sizes[LANES];        // in steps
        int32_t indices[LANES];    // of the path
        uint16_t contexts[LANES];  // those of the first quantiser
        uint8_t odd[STATES];       // lanes whose best path to a state comes by an odd index
        uint8_t zero[2];           // lanes where 0 is better than 2, by quantiser
    };
    std::vector<Places> places;
    std::vector<uint8_t> marks;  // by block of each band: whether the paths go through it
    std::vector<Known> bands;
    float rates[2 * MAGNITUDES * RATES];
    Floats cost[STATES];
    size_t taken = 0;  // places that were written

    explicit Paths(const Task& task) : bands(task.bands) {
        for (int index = 0; index < RATES; index++) {
            const int token = tokens_of(all(index))[0];
            for (int context = 0; context < 2 * MAGNITUDES; context++) {
                const bool raw = low_bits(context % LEVELS) > 0;
                const float bits = task.bits.of_index(MAGNITUDES + context, index, token);
                rates[context * RATES + index] = raw ? 0.0F : (float)task.weight * bits;
            }
        }
        for (Floats& of : cost) of = Floats{} + 1e9F;
        cost[0] = Floats{};
    }

    // Go on through places. has_rates: whether bits differ there, since none are left raw.
    FHASH_INLINE void extend(Floats sizes, Ints contexts, bool has_rates) {
        Places here;
        stored(here.sizes, sizes);
        stored(here.contexts, __builtin_convertvector(contexts, Shorts));
        const Ints inside = contexts != NOTHING;
        Floats costs[2][2];  // by quantiser, of the best even and of the best odd index
        for (int quantiser = 0; quantiser < 2; quantiser++) {
            const Floats moved = sizes + (float)quantiser;
            const Ints low = __builtin_convertvector(moved * 0.5F, Ints);
            const Floats above = moved - 2 * floats(low), below = 2.0F - above;
            const Floats error = low == 0 ? sizes : above;
            Floats at_low = error * error, at_high = below * below, at_zero = sizes * sizes;
            if (has_rates) {
                const Ints of = inside & (contexts - MAGNITUDES + quantiser * MAGNITUDES);
                const Ints first = of * RATES, index = first + least(low, all(RATES - 1));
                const Ints next_index = first + least(low + 1, all(RATES - 1));
                Floats rate_low, rate_high, rate_zero;
                for (int i = 0; i < LANES; i++) {
                    rate_low[i] = rates[index[i]];
                    rate_high[i] = rates[next_index[i]];
                    rate_zero[i] = rates[first[i]];
                }
                at_low += rate_low;
                at_high += rate_high;
                at_zero += rate_zero;
            }
            const Ints zero = (low == 1) & (at_zero <= at_high);
            here.zero[quantiser] = (uint8_t)lanes_of(zero);
            const Ints low_odd = -(low & 1);
            costs[quantiser][0] = low_odd ? (zero ? at_zero : at_high) : at_low;
            costs[quantiser][1] = low_odd ? at_low : at_high;
        }
        Floats next[STATES];
        Ints odd[STATES];
        for (int state = 0; state < STATES; state++) {
            const int q = state & 1;
            next[TRELLIS_NEXT[state][0]] = cost[state] + costs[q][0];
        }
        for (int state = 0; state < STATES; state++) {
            const int q = state & 1, to = TRELLIS_NEXT[state][1];
            const Floats by_odd = cost[state] + costs[q][1];
            odd[to] = by_odd < next[to];
            next[to] = odd[to] ? by_odd : next[to];
        }
        for (int state = 0; state < STATES; state++) {
            cost[state] = inside ? next[state] : cost[state];
            here.odd[state] = (uint8_t)lanes_of(odd[state]);
        }
        places.push_back(here);
        if (places.size() % RENEWED == 0) renew();
    }

    void renew() {
        Floats lowest = cost[0];
        for (const Floats& of : cost) lowest = of < lowest ? of : lowest;
        for (Floats& of : cost) of -= lowest;
    }

    // Go back along the best paths.
    void trace() {
        uint8_t before[STATES][2];
        for (int state = 0; state < STATES; state++)
            for (int odd = 0; odd < 2; odd++)
                before[TRELLIS_NEXT[state][odd]][odd] = (uint8_t)state;
        int state[LANES];
        for (int i = 0; i < LANES; i++) {
            state[i] = 0;
            for (int other = 1; other < STATES; other++)
                if (cost[other][i] < cost[state[i]][i]) state[i] = other;
        }
        for (size_t n = places.size(); n-- > 0;) {
            Places& at = places[n];
            for (int i = 0; i < LANES; i++) {
                at.indices[i] = 0;
                if (at.contexts[i] == NOTHING) continue;
                const int odd = at.odd[state[i]] >> i & 1;
                state[i] = before[state[i]][odd];
                const int quantiser = state[i] & 1;
                const int low = (int)((at.sizes[i] + (float)quantiser) * 0.5F);
                int index = low + ((low ^ odd) & 1);
                if (low == 1 && !odd && (at.zero[quantiser] >> i & 1)) index = 0;
                at.indices[i] = index;
            }
        }
    }
};

struct Writer : Lattice<Writer, FlagWriter> {
    using Base = Lattice<Writer, FlagWriter>;

    const Mode mode;
    const bool has_values = mode != ENCODE;
    const bool writes = mode != PRICE && mode != GUESS;
    const Task& task;
    Paths* const paths;
    uint32_t counts[SYMBOLS][LANES] = {};  // by lane, so that none waits for the one before
    int64_t raw = 0;                       // bits beside
    double squares = 0;
    BitsOut out;
    std::vector<Shorts> steps;             // of the lanes at one time: symbols in their contexts
    float lower[SYMBOLS] = {};             // of a magnitude: below it, one less is cheaper
    float zero_of_two[CONTEXTS + 1] = {};  // below it a 2 is worth less than its bits
    std::vector<float> largest;            // value in each block of the band
    float least_near, least_far;  // values that are worth a symbol; far: where all around is 0
    size_t marks = 0, marks_behind = 0;  // of the paths: those before the band, and with it
    Floats rests = {};  // sums of the squared errors of a row
    Ints given[2];      // of the block, by parity: values, as bits of floats, or integers

    Writer(const Task& of, Mode in, FlagWriter flag_coder, Paths* through)
        : Base(of.shape, of.prior, of.trellis, of.trellis && in != GUESS, of.bands, flag_coder),
          mode(in), task(of), paths(through) {}

    void run_all() {
        if (mode == PRICE || mode == CHOOSE) weigh();
        Base::run();
        end_row();
    }

    // Bits of the tokens by the defaults of the prior, so that magnitudes can be chosen.
    void weigh() {
        for (int context = 0; context < MAGNITUDES; context++) {
            const bool raw_too = low_bits(context % LEVELS) > 0;
            float bits[DIRECT];
            for (int token = 0; token < DIRECT; token++)
                bits[token] = task.bits.of_index(context, token, token);
            for (int token = 0; token < TOKENS; token++) {
                const bool direct = token > 0 && token < DIRECT && !raw_too;
                const float more = direct ? bits[token] - bits[token - 1] : 0.0F;
                lower[in_context(context, token)] =
                    (float)(task.weight / 2) * max(more, 0.0F) - 0.5F;
            }
            zero_of_two[context] =
                raw_too ? 0.0F : 1 + (float)(task.weight / 4) * (bits[2] - bits[0]);
        }
        for (int token = 0; token < TOKENS; token++) lower[in_context(NOTHING, token)] = -0.5F;
    }

    // The least values that are worth a symbol in a band.
    void weigh_band(int kind) {
        const int context = Base::group_of(kind) * 2 * CLASSES * LEVELS;
        least_near = mode == GUESS ? GUESSED_ZERO : SMALLEST;
        least_far = least_near;
        if (mode == PRICE || mode == CHOOSE) least_far = 1 + lower[in_context(context, 1)];
        if (mode == GUESS) {
            const float* const rates = paths->rates + context * Paths::RATES;
            least_far = max(1 + (rates[1] - rates[0]) / 4, least_near);
        }
    }

    // Values of a block, or its integers, and zeros behind the end of a row.
    template <class Each> FHASH_INLINE void values_of(int64_t place, int room, Each each) const {
        static_assert(sizeof(float) == sizeof(int32_t), "either is a lane");
        const char* from = has_values ? reinterpret_cast<const char*>(task.values + place)
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
        if (!has_values) return floats(values < 0 ? -values : values);
        const Floats scaled = (Floats)values * task.scale;
        return (Floats)((Ints)scaled & 0x7fffffff);
    }

    // Find out whether a band has integers, and how large they are.
    void look_at(Band& band) {
        const int blocks = band.blocks;
        if (mode == FOLLOW) {
            const Known known = paths->bands[(size_t)(&band - Base::bands.data())];
            band.any = known.any;
            band.shift = known.shift;
            marks = marks_behind;
            marks_behind += (size_t)band.size[0] * band.size[1] * band.size[2] * blocks;
            return;
        }
        weigh_band(band.kind);
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
                    large -= (first >= least_near) + (second >= least_near);
                    totals += (Floats)((Ints)first & (first >= least_near));
                    totals += (Floats)((Ints)second & (second >= least_near));
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
        // On a trellis an index is two steps.
        const double many = (double)MANY * (double)count * (mode == GUESS ? 2 : 1);
        while (total > many * (1 << band.shift) && band.shift < MAX_SHIFT) band.shift++;
        if (mode == GUESS) {
            paths->bands[(size_t)(&band - Base::bands.data())] = {band.any, band.shift};
            marks = paths->marks.size();
            paths->marks.resize(marks + (size_t)(rows * blocks));
        }
    }

    // Whether some values of the row are worth a symbol. Else they are zeros.
    FHASH_INLINE int some_in_row() {
        const int64_t first = row.number * row.blocks;
        for (int k = 0; k < row.blocks; k++) {
            if (mode == FOLLOW ? paths->marks[marks + (size_t)(first + k)] != 0
                               : largest[(size_t)(first + k)] >= least_far)
                return 1;
        }
        if (mode == FOLLOW || mode == GUESS) return 0;
        for (int k = 0; k < row.blocks; k++) leave_out(k);
        end_row();
        return 0;
    }
    // The same of a block. is_near: whether there are others than zeros around it.
    FHASH_INLINE int some_in_block(int number, bool is_near) {
        const size_t at = (size_t)(row.number * row.blocks + number);
        if (mode == FOLLOW) return paths->marks[marks + at];
        const int some = largest[at] >= (is_near ? least_near : least_far);
        if (mode == GUESS) paths->marks[marks + at] = (uint8_t)some;
        if (some || mode == GUESS) return some;
        leave_out(number);
        return 0;
    }

    // Count the errors of a block of zeros.
    FHASH_INLINE void leave_out(int number) {
        if (!has_values) return;
        values_of(row.place + BLOCK * number, room_in(number), [&](Ints a, Ints b) FHASH_LAMBDA {
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
        values_of(row.place + BLOCK * number, room_in(number), [&](Ints a, Ints b) FHASH_LAMBDA {
            given[0] = evens(a, b);
            given[1] = odds(a, b);
        });
    }
    FHASH_INLINE void end_block(const Half& even, const Half& odd, int number, int room) {
        if (mode == CHOOSE || mode == FOLLOW)
            Base::keep_integers(task.q, even, odd, number, room);
    }

    // The magnitudes next to some sizes, or one less, or zero: what costs least.
    FHASH_INLINE Ints choose(Floats sizes, Ints contexts) {
        sizes = sizes < 1e9F ? sizes : Floats{} + 1e9F;  // also for NaN
        const Ints nearest = __builtin_convertvector(sizes + 0.5F, Ints);
        Ints chosen = nearest;
        if (any(nearest)) {
            const Ints at = contexts * TOKENS + least(nearest, all(LAST));
            Floats edges;
            for (int i = 0; i < LANES; i++) edges[i] = lower[at[i]];
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
        if (mode == GUESS) {
            half.magnitudes = guess(half, sizes_of(values));
            half.signs = Ints{};
            return;
        }
        if (mode == FOLLOW)
            half.magnitudes = loaded<Ints>(paths->places[paths->taken++].indices);
        else if (has_values) half.magnitudes = choose(sizes_of(values), half.contexts);
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

    // The indices that some places are likely to have, whichever their quantisers are.
    FHASH_INLINE Ints guess(const Half& half, Floats sizes) {
        sizes = sizes < 1e9F ? sizes : Floats{} + 1e9F;
        paths->extend(sizes, half.contexts, row.shift == 0);
        const Ints indices = __builtin_convertvector(sizes * 0.5F + GUESSED_MORE, Ints);
        return most(indices, all(1)) & (sizes >= GUESSED_ZERO) & (half.contexts != NOTHING);
    }

    FHASH_INLINE void write_step(Ints contexts, Ints symbols) {
        const Shorts step = __builtin_convertvector(contexts * TOKENS + symbols, Shorts);
        for (int i = 0; i < LANES; i++) counts[step[i]][i]++;
        if (writes) steps.push_back(step);
    }

    FHASH_INLINE void write_magnitude(int magnitude, int token, int low) {
        const int high = magnitude >> low;
        int bits = low;
        if (token >= DIRECT) bits += token - DIRECT + 1;
        if (token == LAST) {
            const uint32_t rest = (uint32_t)(high - FIRST[LAST]) + (1u << LAST_BITS);
            const int length = significant(rest) - 1;
            bits += 2 * (length - LAST_BITS) + 1;
            if (writes) {
                out.put(1ull << (length - LAST_BITS), length - LAST_BITS + 1);
                out.put(rest & ((1u << length) - 1), length);
            }
        } else if (writes && token >= DIRECT) {
            out.put((uint64_t)(high - FIRST[token]), token - DIRECT + 1);
        }
        if (writes) out.put((uint64_t)magnitude & ((1ull << low) - 1), low);
        raw += bits;
    }
};

// The distribution of each context that takes the fewest bits for what was counted. Their bits.
double choose_distributions(const uint32_t (*counts)[LANES], const Task& task, double raw,
                            uint8_t* chosen) {
    const Prior& prior = task.prior;
    double total = raw, saved = 0, zeros = 0;
    for (int context = 0; context < CONTEXTS; context++) {
        chosen[context] = prior.defaults[context];
        if (!is_used(context, task.trellis)) continue;
        const int first = context < OF_SIGNS ? 0 : CHOICES, in_group = context % LEVELS;
        double sums[CHOICES] = {};
        for (int token = 0; token < TOKENS; token++) {
            const uint32_t* const of = counts[in_context(context, token)];
            int64_t number = 0;
            for (int i = 0; i < LANES; i++) number += of[i];
            if (!number) continue;
            const float* const bits = task.bits.of[token] + first;
            for (int n = 0; n < CHOICES; n++) sums[n] += (double)number * (double)bits[n];
        }
        const double usual = sums[chosen[context]];
        double least = usual;
        for (int n = 0; n < CHOICES; n++)
            if (sums[n] + CHOICE_BITS < least) {
                least = sums[n] + CHOICE_BITS;
                chosen[context] = (uint8_t)n;
            }
        // A group of contexts without a choice has one bit for all.
        saved = (in_group ? saved : 0) + usual - least;
        total += least;
        if (in_group < LEVELS - 1 && context < CONTEXTS - 1) continue;
        zeros += 1;
        if (saved > in_group + 1) total += zeros + in_group + 1, zeros = 0;
        else {
            total += saved;
            std::memcpy(chosen + context - in_group, prior.defaults + context - in_group,
                        (size_t)in_group + 1);
        }
    }
    return total + (raw > 0 ? zeros : 0);  // at the end of all they are not stored
}

// The words of the lanes: the steps are coded backwards, so that they are read forwards.
void write_words(const std::vector<Shorts>& steps, const Prior& prior,
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

int64_t write(Mode mode, const Task& task, std::vector<uint8_t>& bytes, double* results,
              Paths* paths = nullptr) {
    std::vector<uint8_t> flag_bytes;
    const FlagWriter flag_coder = {mode != PRICE && mode != GUESS, {&flag_bytes}, 0};
    const auto writer = std::make_unique<Writer>(task, mode, flag_coder, paths);
    if (!read_bands(task.table, task.shape, writer->bands)) return -1;
    writer->run_all();
    if (mode == GUESS) return 0;
    uint8_t chosen[CONTEXTS];
    results[0] = choose_distributions(writer->counts, task, (double)writer->raw, chosen);
    results[1] = writer->squares;
    results[0] += (double)writer->range.bits / 2048;
    results[0] /= 8;
    bool some = false;  // then there are states of lanes
    for (const Band& band : writer->bands) some |= band.any;
    results[0] += some ? 4 * LANES : 0;
    if (mode == PRICE) return 0;
    writer->range.encoder.finish();
    BitsOut choices;
    bool any_chosen = false;  // in the group
    for (int context = 0; context < CONTEXTS; context++) {
        if (!is_used(context, task.trellis)) continue;
        const uint8_t *const of = chosen + context, *const usual = task.prior.defaults + context;
        const int left = min(LEVELS, CONTEXTS - context);
        if (context % LEVELS == 0) any_chosen = std::memcmp(of, usual, (size_t)left) != 0;
        if (context % LEVELS == 0) choices.put(any_chosen, 1);
        if (!any_chosen) continue;
        choices.put(*of != *usual, 1);
        if (*of != *usual) choices.put(*of, CHOICE_BITS);
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

// Write the integers of the best paths through the trellis.
int64_t write_paths(const Task& task, std::vector<uint8_t>& bytes, double* results) {
    Paths paths(task);
    const int64_t code = write(GUESS, task, bytes, results, &paths);
    if (code < 0) return code;
    paths.trace();
    return write(FOLLOW, task, bytes, results, &paths);
}

}  // namespace
