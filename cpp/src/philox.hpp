// Random numbers by name: Philox 4x32-10, a counter-based generator.
//
// A draw is a function of (stream, index) and of nothing else: there is no state that could fall
// out of step. The 64-bit key and three of the four counter words name the stream; the fourth word
// counts blocks of two doubles within it.
//
// Source: Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
// Normal deviates: Box and Muller, 1958.

#pragma once

#include <cstddef>
#include <cstdint>

#include "deterministic_math.hpp"

namespace holdfast {

/// Names one stream: key and the upper three counter words.
struct Stream {
    std::uint32_t key0, key1, c1, c2, c3;
};

struct PhiloxBlock {
    std::uint32_t words[4];
};

/// The marker of derived keys in the word of the purpose, which stays below it otherwise.
inline constexpr std::uint32_t derivation_marker = 0x80000000u;

// Inline functions may be compiled for several instruction sets: each has a name of its own.
inline namespace HOLDFAST_ISA {

HOLDFAST_INLINE PhiloxBlock philox(const Stream& stream, std::uint32_t block) {
    std::uint32_t c0 = block, c1 = stream.c1, c2 = stream.c2, c3 = stream.c3;
    std::uint32_t k0 = stream.key0, k1 = stream.key1;
    for (int round = 0; round < 10; ++round) {
        const std::uint64_t p0 = std::uint64_t{0xD2511F53u} * c0;
        const std::uint64_t p1 = std::uint64_t{0xCD9E8D57u} * c2;
        const auto high0 = static_cast<std::uint32_t>(p0 >> 32),
                   low0 = static_cast<std::uint32_t>(p0);
        const auto high1 = static_cast<std::uint32_t>(p1 >> 32),
                   low1 = static_cast<std::uint32_t>(p1);
        c0 = high1 ^ c1 ^ k0;
        c1 = low1;
        c2 = high0 ^ c3 ^ k1;
        c3 = low0;
        k0 += 0x9E3779B9u;
        k1 += 0xBB67AE85u;
    }
    return {{c0, c1, c2, c3}};
}

/// A double in [0, 1) with 53 random bits.
HOLDFAST_INLINE double unit_interval(std::uint32_t high, std::uint32_t low) {
    const std::uint64_t mantissa = (std::uint64_t{high} << 21) | (low >> 11);
    return static_cast<double>(mantissa) * 0x1p-53;
}

/// Draw number `index` of the stream, uniform on [0, 1).
inline double uniform(const Stream& stream, std::uint64_t index) {
    const PhiloxBlock block = philox(stream, static_cast<std::uint32_t>(index >> 1));
    return index & 1 ? unit_interval(block.words[2], block.words[3])
                     : unit_interval(block.words[0], block.words[1]);
}

/// Two independent standard normal deviates from two uniform ones.
template <class T>
HOLDFAST_INLINE void box_muller(T radius_uniform, T angle_uniform, T& first, T& second) {
    const T radius = square_root(-2.0 * log_of(1.0 - radius_uniform));
    const auto angle = sine_cosine_of(6.28318530717958647693 * angle_uniform);
    first = radius * angle.cosine;
    second = radius * angle.sine;
}

/// Draw number `index` of the stream, standard normal.
inline double normal(const Stream& stream, std::uint64_t index) {
    const PhiloxBlock block = philox(stream, static_cast<std::uint32_t>(index >> 1));
    double first, second;
    box_muller(unit_interval(block.words[0], block.words[1]),
               unit_interval(block.words[2], block.words[3]), first, second);
    return index & 1 ? second : first;
}

/// An independent stream named by `index` below this one.
///
/// Its key is a Philox output of this stream's key at a counter that no draw ever uses (the
/// marker), so draws of parent and child never share a block; two children share a key with
/// probability 2^-64.
HOLDFAST_INLINE Stream substream(const Stream& stream, std::uint32_t index) {
    const Stream deriving{stream.key0, stream.key1, stream.c1 | derivation_marker, stream.c2,
                          stream.c3};
    const PhiloxBlock block = philox(deriving, index);
    return {block.words[0], block.words[1], 0, 0, 0};
}

}  // namespace HOLDFAST_ISA

/// Draws number first, first + 1, ..., the same numbers as `normal` one by one, faster.
void normals(const Stream& stream, std::uint64_t first, std::size_t count, double* out);

void uniforms(const Stream& stream, std::uint64_t first, std::size_t count, double* out);

}  // namespace holdfast
