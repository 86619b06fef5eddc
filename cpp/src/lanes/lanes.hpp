// Eight doubles at a time, without naming an instruction set.
//
// A value is one AVX-512 register, two AVX registers or four SSE or NEON registers, by what the
// file is compiled for; the code above it is the same. Every operation is element by element and
// IEEE-exact, and sums over elements are written out in a fixed order, so the bits are the same
// whatever the width.
//
// (One vector type of 64 bytes for all machines would be shorter; but compilers lower its
// comparisons and selections to scalar code where the registers are narrower.)

#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <immintrin.h>
#endif

// The inner loops define this as the namespace of their instruction set. The types below depend on
// the set, so they live in that namespace: no two compilations may share a name for different
// things.
#ifndef HOLDFAST_ISA
#define HOLDFAST_ISA isa_of_this_file
#endif

#define HOLDFAST_INLINE inline __attribute__((always_inline))

namespace holdfast {

inline constexpr std::size_t lane_count = 8;

inline namespace HOLDFAST_ISA {

#if defined(__AVX512DQ__)
inline constexpr std::size_t register_bytes = 64;
#elif defined(__AVX__)
inline constexpr std::size_t register_bytes = 32;
#else
inline constexpr std::size_t register_bytes = 16;
#endif
inline constexpr std::size_t registers = 64 / register_bytes;

using DoubleRegister = double __attribute__((vector_size(register_bytes)));
using IntRegister = std::int64_t __attribute__((vector_size(register_bytes)));
using UnsignedRegister = std::uint64_t __attribute__((vector_size(register_bytes)));
using CountLanes = std::uint32_t __attribute__((vector_size(32)));

// A loop over the registers, written out: compilers keep the parts of a structure in registers only
// if they see constant indices early.
#define HOLDFAST_EACH_REGISTER(statement) \
    {                                     \
        constexpr std::size_t r = 0;      \
        statement;                        \
    }                                     \
    if constexpr (registers > 1) {        \
        constexpr std::size_t r = 1;      \
        statement;                        \
    }                                     \
    if constexpr (registers > 2) {        \
        {                                 \
            constexpr std::size_t r = 2;  \
            statement;                    \
        }                                 \
        {                                 \
            constexpr std::size_t r = 3;  \
            statement;                    \
        }                                 \
    }

/// Eight 64-bit integers, or eight truth values (all bits or none).
struct IntLanes {
    IntRegister part[registers];
};

/// Eight doubles.
struct Lanes {
    DoubleRegister part[registers];

    HOLDFAST_INLINE double& operator[](std::size_t i) { return reinterpret_cast<double*>(part)[i]; }
    HOLDFAST_INLINE double operator[](std::size_t i) const {
        return reinterpret_cast<const double*>(part)[i];
    }
};

HOLDFAST_INLINE Lanes splat(double value) {
    Lanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = DoubleRegister{} + value)
    return result;
}

HOLDFAST_INLINE IntLanes splat_int(std::int64_t value) {
    IntLanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = IntRegister{} + value)
    return result;
}

#define HOLDFAST_LANES_OPERATOR(Result, Type, Scalar, fill, op)         \
    HOLDFAST_INLINE Result operator op(const Type& a, const Type& b) {  \
        Result result;                                                  \
        HOLDFAST_EACH_REGISTER(result.part[r] = a.part[r] op b.part[r]) \
        return result;                                                  \
    }                                                                   \
    HOLDFAST_INLINE Result operator op(const Type& a, Scalar b) {       \
        return a op fill(b);                                            \
    }                                                                   \
    HOLDFAST_INLINE Result operator op(Scalar a, const Type& b) {       \
        return fill(a) op b;                                            \
    }
HOLDFAST_LANES_OPERATOR(Lanes, Lanes, double, splat, +)
HOLDFAST_LANES_OPERATOR(Lanes, Lanes, double, splat, -)
HOLDFAST_LANES_OPERATOR(Lanes, Lanes, double, splat, *)
HOLDFAST_LANES_OPERATOR(Lanes, Lanes, double, splat, /)
HOLDFAST_LANES_OPERATOR(IntLanes, Lanes, double, splat, <)
HOLDFAST_LANES_OPERATOR(IntLanes, Lanes, double, splat, <=)
HOLDFAST_LANES_OPERATOR(IntLanes, Lanes, double, splat, >)
HOLDFAST_LANES_OPERATOR(IntLanes, Lanes, double, splat, >=)
HOLDFAST_LANES_OPERATOR(IntLanes, Lanes, double, splat, ==)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, +)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, -)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, &)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, |)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, ^)
HOLDFAST_LANES_OPERATOR(IntLanes, IntLanes, std::int64_t, splat_int, !=)
#undef HOLDFAST_LANES_OPERATOR

HOLDFAST_INLINE Lanes operator-(const Lanes& a) {
    Lanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = -a.part[r])
    return result;
}
HOLDFAST_INLINE Lanes& operator+=(Lanes& a, const Lanes& b) {
    return a = a + b;
}
HOLDFAST_INLINE Lanes& operator-=(Lanes& a, const Lanes& b) {
    return a = a - b;
}
HOLDFAST_INLINE IntLanes& operator|=(IntLanes& a, const IntLanes& b) {
    return a = a | b;
}

HOLDFAST_INLINE IntLanes shift_left(const IntLanes& a, int by) {
    IntLanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = a.part[r] << by)
    return result;
}
HOLDFAST_INLINE std::int64_t shift_left(std::int64_t a, int by) {
    return a << by;
}

/// Shift of the bit pattern: zeros come in from the left.
HOLDFAST_INLINE IntLanes shift_right(const IntLanes& a, int by) {
    IntLanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = reinterpret_cast<IntRegister>(
                               reinterpret_cast<UnsignedRegister>(a.part[r]) >> by))
    return result;
}
HOLDFAST_INLINE std::int64_t shift_right(std::int64_t a, int by) {
    return static_cast<std::int64_t>(static_cast<std::uint64_t>(a) >> by);
}

/// The products of the low halves, without sign.
HOLDFAST_INLINE IntLanes multiply_low_halves(const IntLanes& a, const IntLanes& b) {
    IntLanes result;
#if defined(__AVX512DQ__)
    result.part[0] = reinterpret_cast<IntRegister>(_mm512_mul_epu32(
        reinterpret_cast<__m512i>(a.part[0]), reinterpret_cast<__m512i>(b.part[0])));
#elif defined(__AVX2__)
    HOLDFAST_EACH_REGISTER(
        result.part[r] = reinterpret_cast<IntRegister>(_mm256_mul_epu32(
            reinterpret_cast<__m256i>(a.part[r]), reinterpret_cast<__m256i>(b.part[r]))))
#elif defined(__SSE2__) && !defined(__AVX__)
    HOLDFAST_EACH_REGISTER(
        result.part[r] = reinterpret_cast<IntRegister>(_mm_mul_epu32(
            reinterpret_cast<__m128i>(a.part[r]), reinterpret_cast<__m128i>(b.part[r]))))
#else
    constexpr std::uint64_t low = 0xffffffffu;
    HOLDFAST_EACH_REGISTER(result.part[r] = reinterpret_cast<IntRegister>(
                               (reinterpret_cast<UnsignedRegister>(a.part[r]) & low) *
                               (reinterpret_cast<UnsignedRegister>(b.part[r]) & low)))
#endif
    return result;
}

HOLDFAST_INLINE Lanes load(const double* from) {
    constexpr std::size_t width = lane_count / registers;
    Lanes result;
    HOLDFAST_EACH_REGISTER(
        __builtin_memcpy(&result.part[r], from + r * width, sizeof(DoubleRegister)))
    return result;
}

HOLDFAST_INLINE void store(double* to, const Lanes& lanes) {
    constexpr std::size_t width = lane_count / registers;
    HOLDFAST_EACH_REGISTER(__builtin_memcpy(to + r * width, &lanes.part[r], sizeof(DoubleRegister)))
}

/// Loads `count` < 8 doubles and fills up with `filler`.
HOLDFAST_INLINE Lanes load_partial(const double* from, std::size_t count, double filler) {
    Lanes lanes = splat(filler);
    for (std::size_t i = 0; i < count; ++i) lanes[i] = from[i];
    return lanes;
}

HOLDFAST_INLINE void store_partial(double* to, const Lanes& lanes, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) to[i] = lanes[i];
}

HOLDFAST_INLINE Lanes select(const IntLanes& mask, const Lanes& yes, const Lanes& no) {
    Lanes result;
    HOLDFAST_EACH_REGISTER(result.part[r] = mask.part[r] ? yes.part[r] : no.part[r])
    return result;
}
HOLDFAST_INLINE double select(bool mask, double yes, double no) {
    return mask ? yes : no;
}

/// The lesser and the greater of two, element by element, where neither is NaN.
HOLDFAST_INLINE void order(Lanes& low, Lanes& high) {
    const Lanes a = low, b = high;
#if defined(__AVX512DQ__)
    low.part[0] = _mm512_min_pd(a.part[0], b.part[0]);
    high.part[0] = _mm512_max_pd(a.part[0], b.part[0]);
#elif defined(__AVX__)
    HOLDFAST_EACH_REGISTER(low.part[r] = _mm256_min_pd(a.part[r], b.part[r]))
    HOLDFAST_EACH_REGISTER(high.part[r] = _mm256_max_pd(a.part[r], b.part[r]))
#elif defined(__SSE2__)
    HOLDFAST_EACH_REGISTER(low.part[r] = _mm_min_pd(a.part[r], b.part[r]))
    HOLDFAST_EACH_REGISTER(high.part[r] = _mm_max_pd(a.part[r], b.part[r]))
#else
    const IntLanes less = a < b;
    low = select(less, a, b);
    high = select(less, b, a);
#endif
}

HOLDFAST_INLINE double square_root(double x) {
    return __builtin_sqrt(x);
}
HOLDFAST_INLINE Lanes square_root(const Lanes& x) {
    Lanes result;
#if defined(__AVX512DQ__)
    result.part[0] = _mm512_sqrt_pd(x.part[0]);
#elif defined(__AVX__)
    HOLDFAST_EACH_REGISTER(result.part[r] = _mm256_sqrt_pd(x.part[r]))
#elif defined(__SSE2__)
    HOLDFAST_EACH_REGISTER(result.part[r] = _mm_sqrt_pd(x.part[r]))
#else
    for (std::size_t i = 0; i < lane_count; ++i) result[i] = __builtin_sqrt(x[i]);
#endif
    return result;
}

/// Adds the eight elements in one fixed order: pairs at distance 4, then 2, then 1.
HOLDFAST_INLINE double sum_of(const Lanes& x) {
    const double a0 = x[0] + x[4], a1 = x[1] + x[5], a2 = x[2] + x[6], a3 = x[3] + x[7];
    return (a0 + a2) + (a1 + a3);
}

/// The same for eight sums beside each other, of which x[i] has the i-th elements.
HOLDFAST_INLINE Lanes sum_of_each(const Lanes (&x)[lane_count]) {
    const Lanes a0 = x[0] + x[4], a1 = x[1] + x[5], a2 = x[2] + x[6], a3 = x[3] + x[7];
    return (a0 + a2) + (a1 + a3);
}

HOLDFAST_INLINE double maximum_of(const Lanes& x) {
    double largest = x[0];
    for (std::size_t i = 1; i < lane_count; ++i) largest = x[i] > largest ? x[i] : largest;
    return largest;
}

/// One bit for each truth value.
HOLDFAST_INLINE unsigned bits_of(const IntLanes& mask) {
#if defined(__AVX512DQ__)
    return _mm512_movepi64_mask(reinterpret_cast<__m512i>(mask.part[0]));
#elif defined(__AVX__)
    return static_cast<unsigned>(_mm256_movemask_pd(reinterpret_cast<__m256d>(mask.part[0]))) |
           static_cast<unsigned>(_mm256_movemask_pd(reinterpret_cast<__m256d>(mask.part[1]))) << 4;
#elif defined(__SSE2__)
    unsigned bits = 0;
    HOLDFAST_EACH_REGISTER(
        bits |= static_cast<unsigned>(_mm_movemask_pd(reinterpret_cast<__m128d>(mask.part[r])))
                << (2 * r))
    return bits;
#else
    unsigned bits = 0;
    for (std::size_t i = 0; i < lane_count; ++i) {
        bits |= (reinterpret_cast<const std::int64_t*>(mask.part)[i] != 0 ? 1u : 0u) << i;
    }
    return bits;
#endif
}

/// The truth values whose bits these are.
HOLDFAST_INLINE IntLanes lanes_of(unsigned bits) {
    std::int64_t values[lane_count];
    for (std::size_t i = 0; i < lane_count; ++i) values[i] = -std::int64_t{bits >> i & 1u};
    IntLanes result;
    std::memcpy(&result, values, sizeof result);
    return result;
}

/// bits_of(a <= b), where the compiler would go by way of eight truth values.
HOLDFAST_INLINE unsigned bits_at_most(const Lanes& a, const Lanes& b) {
#if defined(__AVX512DQ__)
    return _mm512_cmp_pd_mask(a.part[0], b.part[0], _CMP_LE_OQ);
#else
    return bits_of(a <= b);
#endif
}

#undef HOLDFAST_EACH_REGISTER

}  // namespace HOLDFAST_ISA
}  // namespace holdfast
