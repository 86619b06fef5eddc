// exp, log, sin, cos, arctan2 and arcsin with the same bits on every machine.
//
// A C library may choose its algorithm by processor and may round differently from the next one.
// These functions use only + - * / and integer operations, all exact in IEEE 754, in one order, on
// one double or on eight at a time (the template argument): both give the same bits. The method is
// the textbook one: reduce the argument by a multiple of log 2 or pi/2 that is split in parts so
// that the subtraction is exact (Cody and Waite, 1980), then sum the Taylor series, which is short
// on the reduced range. Errors are below 2 units in the last place on the stated ranges.
//
// The split constants are those of Sun's fdlibm (1993).

#pragma once

#include <cstdint>

#include "lanes/lanes.hpp"

namespace holdfast {

inline namespace HOLDFAST_ISA {

namespace detail {

// Adding 1.5 * 2^52 rounds a double of moderate size to the nearest integer, and leaves that
// integer, offset by the bits of the constant, in the low bits of the sum.
inline constexpr double rounding_shift = 6755399441055744.0;
inline constexpr std::int64_t rounding_shift_bits = 0x4338000000000000;

template <class T>
struct IntegerOf;
template <>
struct IntegerOf<double> {
    using type = std::int64_t;
};
template <>
struct IntegerOf<Lanes> {
    using type = IntLanes;
};
template <class T>
using Integer = typename IntegerOf<T>::type;

HOLDFAST_INLINE std::int64_t bits(double x) {
    return __builtin_bit_cast(std::int64_t, x);
}
HOLDFAST_INLINE IntLanes bits(const Lanes& x) {
    return __builtin_bit_cast(IntLanes, x);
}

template <class T>
HOLDFAST_INLINE T from_bits(Integer<T> x) {
    return __builtin_bit_cast(T, x);
}

template <class T>
HOLDFAST_INLINE T constant(double x);
template <>
HOLDFAST_INLINE double constant<double>(double x) {
    return x;
}
template <>
HOLDFAST_INLINE Lanes constant<Lanes>(double x) {
    return splat(x);
}

/// c[0] + x c[1] + x^2 c[2] + ..., innermost first.
template <class T, std::size_t n>
HOLDFAST_INLINE T horner(T x, const double (&coefficients)[n]) {
    T sum = constant<T>(coefficients[n - 1]);
    for (std::size_t i = n - 1; i-- > 0;) sum = sum * x + coefficients[i];
    return sum;
}

template <class T>
struct SineCosine {
    T sine;
    T cosine;
};

}  // namespace detail

/// e^x. Zero below -707.7 (where e^x < 5e-308), infinite above 709.78.
template <class T>
HOLDFAST_INLINE T exp_of(T x) {
    constexpr double log2_e = 1.4426950408889634074;
    constexpr double log_2_high = 6.93147180369123816490e-01;
    constexpr double log_2_low = 1.90821492927058770002e-10;
    constexpr double inverse_factorials[] = {1.0,
                                             1.0,
                                             1.0 / 2,
                                             1.0 / 6,
                                             1.0 / 24,
                                             1.0 / 120,
                                             1.0 / 720,
                                             1.0 / 5040,
                                             1.0 / 40320,
                                             1.0 / 362880,
                                             1.0 / 3628800,
                                             1.0 / 39916800,
                                             1.0 / 479001600,
                                             1.0 / 6227020800};
    const T shifted = x * log2_e + detail::rounding_shift;
    const T n = shifted - detail::rounding_shift;
    const T r = (x - n * log_2_high) - n * log_2_low;
    // 2^(n-1) and then times 2, because 2^n itself overflows at the upper end of the range.
    const auto exponent = detail::bits(shifted) - detail::rounding_shift_bits + std::int64_t{1022};
    const T value = detail::horner(r, inverse_factorials) *
                    detail::from_bits<T>(shift_left(exponent, 52)) * 2.0;
    const T infinite = detail::constant<T>(__builtin_inf());
    const T bounded = select(x > 709.782712893384, infinite, value);
    return select(x < -707.7, detail::constant<T>(0.0), bounded);
}

/// The natural logarithm; -infinity at 0 and NaN below.
template <class T>
HOLDFAST_INLINE T log_of(T x) {
    constexpr double log_2_high = 6.93147180369123816490e-01;
    constexpr double log_2_low = 1.90821492927058770002e-10;
    constexpr double smallest_normal = 2.2250738585072014e-308;
    constexpr double two_to_54 = 18014398509481984.0;
    // log m = 2 artanh(s), s = (m - 1) / (m + 1): the series in s^2, without its first term 1.
    constexpr double series[] = {1.0 / 3,  1.0 / 5,  1.0 / 7,  1.0 / 9,  1.0 / 11,
                                 1.0 / 13, 1.0 / 15, 1.0 / 17, 1.0 / 19, 1.0 / 21};
    constexpr std::int64_t bits_of_root_half = 0x3fe6a09e667f3bcd;
    const auto subnormal = x < smallest_normal;
    const T scaled = select(subnormal, x * two_to_54, x);
    const auto pattern = detail::bits(scaled);
    // Biased by 1023 so that the shifted pattern is positive.
    const auto exponent =
        shift_right(pattern - (bits_of_root_half - (std::int64_t{1023} << 52)), 52) -
        std::int64_t{1023};
    const T m = detail::from_bits<T>(pattern - shift_left(exponent, 52));  // in [sqrt 1/2, sqrt 2)
    const T e = detail::from_bits<T>(exponent + detail::rounding_shift_bits) -
                detail::rounding_shift -
                select(subnormal, detail::constant<T>(54.0), detail::constant<T>(0.0));
    const T f = m - 1.0;
    const T s = f / (f + 2.0);
    const T s2 = s * s;
    const T twice = s + s;
    const T value =
        e * log_2_high + (twice + (twice * (s2 * detail::horner(s2, series)) + e * log_2_low));
    const T infinite = detail::constant<T>(__builtin_inf());
    const T nan = detail::constant<T>(__builtin_nan(""));
    T result = select(x < infinite, value, x);  // keeps +infinity and NaN
    result = select(x < 0.0, nan, result);
    return select(x == 0.0, -infinite, result);
}

/// Sine and cosine together, for |x| <= 1e6 to full accuracy; NaN above 2^30, where no angle has
/// a meaning any more.
template <class T>
HOLDFAST_INLINE detail::SineCosine<T> sine_cosine_of(T x) {
    constexpr double two_over_pi = 0.63661977236758134308;
    constexpr double half_pi_1 = 1.57079632673412561417e+00;
    constexpr double half_pi_2 = 6.07710050630396597660e-11;
    constexpr double half_pi_3 = 2.02226624879595063154e-21;
    constexpr double sine_series[] = {
        -1.0 / 6,        1.0 / 120,        -1.0 / 5040,          1.0 / 362880,
        -1.0 / 39916800, 1.0 / 6227020800, -1.0 / 1307674368000, 1.0 / 355687428096000};
    constexpr double cosine_series[] = {1.0,
                                        -1.0 / 2,
                                        1.0 / 24,
                                        -1.0 / 720,
                                        1.0 / 40320,
                                        -1.0 / 3628800,
                                        1.0 / 479001600,
                                        -1.0 / 87178291200,
                                        1.0 / 20922789888000,
                                        -1.0 / 6402373705728000};
    const T shifted = x * two_over_pi + detail::rounding_shift;
    const T n = shifted - detail::rounding_shift;
    // The first subtraction is exact; the rounding of the second is carried into the third.
    const T a = x - n * half_pi_1;
    const T b = n * half_pi_2;
    const T difference = a - b;
    const T r = difference - (n * half_pi_3 - ((a - difference) - b));
    const T r2 = r * r;
    const T sine = r + r * (r2 * detail::horner(r2, sine_series));
    const T cosine = detail::horner(r2, cosine_series);
    const auto quadrant = detail::bits(shifted);  // its two low bits are those of n
    const auto swap = (quadrant & std::int64_t{1}) != std::int64_t{0};
    const auto negate_sine = (quadrant & std::int64_t{2}) != std::int64_t{0};
    const auto negate_cosine = ((quadrant + std::int64_t{1}) & std::int64_t{2}) != std::int64_t{0};
    const T s = select(swap, cosine, sine);
    const T c = select(swap, sine, cosine);
    const T nan = detail::constant<T>(__builtin_nan(""));
    const T size = select(x < 0.0, -x, x);
    const auto sensible = size <= 1073741824.0;
    return {select(sensible, select(negate_sine, -s, s), nan),
            select(sensible, select(negate_cosine, -c, c), nan)};
}

inline double exp(double x) {
    return exp_of(x);
}
inline double log(double x) {
    return log_of(x);
}
inline double sin(double x) {
    return sine_cosine_of(x).sine;
}
inline double cos(double x) {
    return sine_cosine_of(x).cosine;
}
inline void sincos(double x, double& sine, double& cosine) {
    const auto both = sine_cosine_of(x);
    sine = both.sine;
    cosine = both.cosine;
}

/// The angle of the vector (x, y) in (-pi, pi]; 0 for the zero vector, NaN where an argument is.
///
/// The smaller size over the larger is a tangent of at most 45 degrees, and 45 degrees less leave
/// one of at most sqrt 2 - 1, whose series is short.
inline double arctan2(double y, double x) {
    constexpr double pi = 3.14159265358979323846;
    constexpr double pi_low = 1.2246467991473531772e-16;
    constexpr double tan_eighth = 0.41421356237309504880;
    constexpr double series[] = {-1.0 / 3,  1.0 / 5,   -1.0 / 7,  1.0 / 9,   -1.0 / 11,
                                 1.0 / 13,  -1.0 / 15, 1.0 / 17,  -1.0 / 19, 1.0 / 21,
                                 -1.0 / 23, 1.0 / 25,  -1.0 / 27, 1.0 / 29,  -1.0 / 31,
                                 1.0 / 33,  -1.0 / 35, 1.0 / 37,  -1.0 / 39, 1.0 / 41};
    const double width = x < 0.0 ? -x : x, height = y < 0.0 ? -y : y;
    const bool steep = width < height;
    const double smaller = steep ? width : height, larger = steep ? height : width;
    if (larger == 0.0) return 0.0;
    const bool beyond = smaller > larger * tan_eighth;
    const double t = beyond ? (smaller - larger) / (smaller + larger) : smaller / larger;
    const double t2 = t * t;
    const double rest = t * (t2 * detail::horner(t2, series));
    // 45 degrees are added in two parts.
    double angle = beyond ? 0.25 * pi + (t + (rest + 0.25 * pi_low)) : t + rest;
    if (steep) angle = 0.5 * pi - (angle - 0.5 * pi_low);
    if (x < 0.0) angle = pi - (angle - pi_low);
    return y < 0.0 ? -angle : angle;
}

/// An angle brought near zero: less the nearest whole number of turns.
inline double wrapped(double angle) {
    constexpr double turn = 6.28318530717958647693;
    const double turns = (angle * (1.0 / turn) + detail::rounding_shift) - detail::rounding_shift;
    return angle - turns * turn;
}

/// The angle in [-pi/2, pi/2] whose sine is x, by Newton's iteration on the sine; NaN for |x| > 1.
///
/// For constants of a problem, not for inner loops. |x| near 1 goes through the half angle, where
/// the sine is steep.
inline double arcsin(double x) {
    constexpr double half_pi = 1.57079632679489661923;
    if (!(x >= -1.0 && x <= 1.0)) return __builtin_nan("");
    const double size = x < 0.0 ? -x : x;
    if (size > 0.7) {
        const double half = arcsin(__builtin_sqrt(0.5 * (1.0 - size)));
        const double angle = half_pi - 2.0 * half;
        return x < 0.0 ? -angle : angle;
    }
    double angle = x;
    for (int iteration = 0; iteration < 6; ++iteration) {
        const auto both = sine_cosine_of(angle);
        angle = angle - (both.sine - x) / both.cosine;
    }
    return angle;
}

}  // namespace HOLDFAST_ISA
}  // namespace holdfast
