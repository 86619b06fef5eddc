// Eight doubles at a time, without naming an instruction set.
//
// The compiler lowers a 64-byte vector to one AVX-512 register, two AVX registers or four SSE/NEON
// registers. Every operation on it is element by element and IEEE-exact, and sums over elements are
// written out in a fixed order, so the bits are the same whatever the width of the machine.

#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace holdfast {

inline constexpr std::size_t lane_count = 8;

using Lanes = double __attribute__((vector_size(64)));
using IntLanes = std::int64_t __attribute__((vector_size(64)));
using CountLanes = std::uint32_t __attribute__((vector_size(32)));

#define HOLDFAST_INLINE inline __attribute__((always_inline))

HOLDFAST_INLINE Lanes splat(double value) { return Lanes{} + value; }

HOLDFAST_INLINE Lanes load(const double* from) {
    Lanes lanes;
    std::memcpy(&lanes, from, sizeof lanes);
    return lanes;
}

HOLDFAST_INLINE void store(double* to, Lanes lanes) { std::memcpy(to, &lanes, sizeof lanes); }

/// Loads `count` < 8 doubles and fills up with `filler`.
HOLDFAST_INLINE Lanes load_partial(const double* from, std::size_t count, double filler) {
    Lanes lanes = splat(filler);
    for (std::size_t i = 0; i < count; ++i) lanes[i] = from[i];
    return lanes;
}

HOLDFAST_INLINE void store_partial(double* to, Lanes lanes, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) to[i] = lanes[i];
}

HOLDFAST_INLINE Lanes select(IntLanes mask, Lanes yes, Lanes no) { return mask ? yes : no; }
HOLDFAST_INLINE double select(bool mask, double yes, double no) { return mask ? yes : no; }

HOLDFAST_INLINE double square_root(double x) { return __builtin_sqrt(x); }
HOLDFAST_INLINE Lanes square_root(Lanes x) {
    double values[lane_count];
    store(values, x);
    for (std::size_t i = 0; i < lane_count; ++i) values[i] = __builtin_sqrt(values[i]);
    return load(values);
}

/// Adds the eight elements in one fixed order: pairs at distance 4, then 2, then 1.
HOLDFAST_INLINE double sum_of(Lanes x) {
    const double a0 = x[0] + x[4], a1 = x[1] + x[5], a2 = x[2] + x[6], a3 = x[3] + x[7];
    return (a0 + a2) + (a1 + a3);
}

HOLDFAST_INLINE double maximum_of(Lanes x) {
    double largest = x[0];
    for (std::size_t i = 1; i < lane_count; ++i) largest = x[i] > largest ? x[i] : largest;
    return largest;
}

/// One bit for each element of a comparison's result.
HOLDFAST_INLINE unsigned bits_of(IntLanes mask) {
#if defined(__AVX512DQ__)
    return _mm512_movepi64_mask(reinterpret_cast<__m512i>(mask));
#elif defined(__AVX__)
    __m256d halves[2];
    std::memcpy(halves, &mask, sizeof halves);
    return static_cast<unsigned>(_mm256_movemask_pd(halves[0])) |
           (static_cast<unsigned>(_mm256_movemask_pd(halves[1])) << 4);
#elif defined(__SSE2__)
    __m128d quarters[4];
    std::memcpy(quarters, &mask, sizeof quarters);
    return static_cast<unsigned>(_mm_movemask_pd(quarters[0])) |
           (static_cast<unsigned>(_mm_movemask_pd(quarters[1])) << 2) |
           (static_cast<unsigned>(_mm_movemask_pd(quarters[2])) << 4) |
           (static_cast<unsigned>(_mm_movemask_pd(quarters[3])) << 6);
#else
    unsigned bits = 0;
    for (std::size_t i = 0; i < lane_count; ++i) bits |= (mask[i] != 0 ? 1u : 0u) << i;
    return bits;
#endif
}

}  // namespace holdfast
