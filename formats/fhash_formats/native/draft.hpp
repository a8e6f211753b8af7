// Settings of a tile while a search changes them (FORMAT.md, Settings).
#pragma once

#include "encode.hpp"

namespace fhash {
namespace {

constexpr int8_t TRELLIS_OFFSETS[OFFSET_COUNT] = {17, -10, -5, -3, -2, -1};

void put_number(Buffer& out, uint64_t bits) {
    for (int byte = 0; byte < 8; byte++) out.push_back((uint8_t)(bits >> 8 * byte));
}

void put_block(Buffer& out, const Buffer& block) {
    put_leb(out, block.size());
    out.insert(out.end(), block.begin(), block.end());
}

void put_real(Buffer& out, double number) {
    uint64_t bits;
    std::memcpy(&bits, &number, sizeof bits);
    put_number(out, bits);
}

// A transform, or a predictor in its place.
struct Form {
    uint8_t axes[4];              // kind times 16, plus depth
    std::array<Buffer, 4> bases;  // packed, of the axes that have one of their own
    const int* order = nullptr;   // of a predictor; null for a transform
    const int64_t* levels = nullptr;
};

// The numbers of settings that a search changes.
struct Draft {
    Form form;
    double step, center, low, high, quantum;
    bool real64, clip, trellis;
    Wide origin;
    int64_t whole_low, whole_high;  // ends of the range about an origin

    std::shared_ptr<const Settings> settings(fhash_context& context, const Shape& shape,
                                             fhash_error& error) const {
        Buffer packed;
        const bool whole = !origin.zero(), predicts = form.order != nullptr;
        packed.push_back((uint8_t)((real64 ? 1 : 0) | (clip ? 2 : 0) | (trellis ? 8 : 0) |
                                   (whole ? 16 : 0) | (predicts ? 128 : 0)));
        packed.insert(packed.end(), form.axes, form.axes + 4);
        for (const double number : {step, quantum, center}) put_real(packed, number);
        if (!whole)
            for (const double end : {low, high}) put_real(packed, end);
        if (whole) {
            put_number(packed, (uint64_t)whole_low);
            put_number(packed, (uint64_t)whole_high);
            put_number(packed, origin.bits);
            packed.push_back(origin.negative ? 255 : 0);
        }
        const int8_t* const offsets = trellis ? TRELLIS_OFFSETS : PLAIN_OFFSETS;
        const int8_t none[OFFSET_COUNT] = {0};
        const int8_t* const shifts = clip ? offsets : none;
        packed.insert(packed.end(), (const uint8_t*)shifts, (const uint8_t*)shifts + OFFSET_COUNT);
        for (const Buffer& basis : form.bases)
            if (!basis.empty()) put_block(packed, basis);
        if (predicts && !put_predictor(shape, packed, error)) return nullptr;
        return unpack_settings(context, packed.data(), packed.size(), error);
    }

    // A predictor by the mean of the two neighbours along the axis of a pass: weights that were
    // learned would take as long as coding the tile, and more bytes where fronts are sharp.
    bool put_predictor(const Shape& shape, Buffer& packed, fhash_error& error) const {
        Predictor predictor;
        put_real(packed, step);
        put_real(packed, center);
        int order = 0;
        for (size_t a = 0; a < 4; a++) {
            int64_t& level = predictor.levels[a] = 0;
            while (level < form.levels[a] && 1 << level < shape[a]) level++;
            packed.push_back((uint8_t)level);
            order |= form.order[a] << 2 * a;
        }
        packed.push_back((uint8_t)order);
        packed.push_back(0);
        make_passes(predictor, form.order, 0);
        const Shape taps = {1, 1, 1, (int64_t)predictor.taps.size() / 5};
        std::vector<int32_t> weights((size_t)taps[3], 0);
        Buffer block;
        if (!encode_integers(weights, taps, single_band(taps), {}, block, error)) return false;
        put_block(packed, block);
        return true;
    }
};

}  // namespace
}  // namespace fhash
