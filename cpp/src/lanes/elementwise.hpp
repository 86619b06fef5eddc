// Elementwise functions, draws and sums over arrays (one compilation per instruction set).

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::inline HOLDFAST_ISA {

template <class Function>
HOLDFAST_INLINE void map(const double* in, double* out, std::size_t count, Function function) {
    std::size_t i = 0;
    for (; i + lane_count <= count; i += lane_count) store(out + i, function(load(in + i)));
    if (i < count)
        store_partial(out + i, function(load_partial(in + i, count - i, 1.0)), count - i);
}

static void exp_array(const double* in, double* out, std::size_t count) {
    map(in, out, count, [](Lanes x) HOLDFAST_LAMBDA { return exp_of(x); });
}

static void log_array(const double* in, double* out, std::size_t count) {
    map(in, out, count, [](Lanes x) HOLDFAST_LAMBDA { return log_of(x); });
}

static void sin_array(const double* in, double* out, std::size_t count) {
    map(in, out, count, [](Lanes x) HOLDFAST_LAMBDA { return sine_cosine_of(x).sine; });
}

static void cos_array(const double* in, double* out, std::size_t count) {
    map(in, out, count, [](Lanes x) HOLDFAST_LAMBDA { return sine_cosine_of(x).cosine; });
}

/// Sum of count doubles: element i goes to partial sum i mod 8, and these are added in one order.
static double sum_array(const double* in, std::size_t count) {
    Lanes partial{};
    std::size_t i = 0;
    for (; i + lane_count <= count; i += lane_count) partial += load(in + i);
    if (i < count) partial += load_partial(in + i, count - i, 0.0);
    return sum_of(partial);
}

static double weighted_sum(const double* weights, const double* in, std::size_t count) {
    Lanes partial{};
    std::size_t i = 0;
    for (; i + lane_count <= count; i += lane_count) partial += load(weights + i) * load(in + i);
    if (i < count) {
        partial += load_partial(weights + i, count - i, 0.0) * load_partial(in + i, count - i, 0.0);
    }
    return sum_of(partial);
}

/// out[c] = sum over i of weights[i] * rows[i][c], each in the order of `sum_array`.
static void weighted_sums(const double* weights, const double* rows, std::size_t count,
                          std::size_t dimension, double* out) {
    for (std::size_t c = 0; c < dimension; ++c) {
        Lanes partial{};
        for (std::size_t i = 0; i < count; i += lane_count) {
            const std::size_t left = count - i < lane_count ? count - i : lane_count;
            Lanes w{}, x{};
            for (std::size_t lane = 0; lane < left; ++lane) {
                w[lane] = weights[i + lane];
                x[lane] = rows[(i + lane) * dimension + c];
            }
            partial += w * x;
        }
        out[c] = sum_of(partial);
    }
}

/// Blocks of eight streams, one in each lane. Only the low halves of the words count.
struct PhiloxLanes {
    IntLanes words[4];
};

HOLDFAST_INLINE PhiloxLanes philox_lanes(const Stream* const (&streams)[lane_count],
                                         const std::uint32_t (&blocks)[lane_count]) {
    std::int64_t in[6][lane_count];
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        const Stream& own = *streams[lane];
        const std::uint32_t words[6] = {blocks[lane], own.c1, own.c2, own.c3, own.key0, own.key1};
        for (std::size_t i = 0; i < 6; ++i) in[i][lane] = words[i];
    }
    IntLanes c0, c1, c2, c3, k0, k1;
    std::memcpy(&c0, in[0], sizeof c0);
    std::memcpy(&c1, in[1], sizeof c1);
    std::memcpy(&c2, in[2], sizeof c2);
    std::memcpy(&c3, in[3], sizeof c3);
    std::memcpy(&k0, in[4], sizeof k0);
    std::memcpy(&k1, in[5], sizeof k1);
    for (int round = 0; round < 10; ++round) {
        const IntLanes p0 = multiply_low_halves(c0, splat_int(0xD2511F53));
        const IntLanes p1 = multiply_low_halves(c2, splat_int(0xCD9E8D57));
        c0 = shift_right(p1, 32) ^ c1 ^ k0;
        c1 = p1;
        c2 = shift_right(p0, 32) ^ c3 ^ k1;
        c3 = p0;
        k0 = k0 + 0x9E3779B9;
        k1 = k1 + 0xBB67AE85;
    }
    return {{c0, c1, c2, c3}};
}

HOLDFAST_INLINE Lanes unit_interval(const IntLanes& high, const IntLanes& low) {
    // 53 bits as two numbers: the upper 21 times 2^32, and the lower 32. Their sum is exact.
    const IntLanes mantissa = shift_left(high & 0xffffffff, 21) | shift_right(low & 0xffffffff, 11);
    const IntLanes upper = shift_right(mantissa, 32) | 0x4530000000000000;
    const IntLanes lower = (mantissa & 0xffffffff) | 0x4330000000000000;
    return ((detail::from_bits<Lanes>(upper) - 0x1p84) +
            (detail::from_bits<Lanes>(lower) - 0x1p52)) *
           0x1p-53;
}

HOLDFAST_INLINE void normals_of(const PhiloxLanes& drawn, Lanes& even, Lanes& odd) {
    box_muller(unit_interval(drawn.words[0], drawn.words[1]),
               unit_interval(drawn.words[2], drawn.words[3]), even, odd);
}

/// Both draws of blocks [firsts[i], firsts[i] + each) of each of several streams, one stream below
/// the other.
static void normal_blocks(const Stream* streams, const std::uint32_t* firsts, std::size_t number,
                          std::size_t each, double* out) {
    const std::size_t total = number * each;
    std::size_t s = 0, b = 0;
    for (std::size_t begin = 0; begin < total; begin += lane_count) {
        const Stream* own[lane_count];
        std::uint32_t block[lane_count];
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            own[lane] = &streams[s];
            block[lane] = firsts[s] + static_cast<std::uint32_t>(b);
            if (begin + lane + 1 < total && ++b == each) {
                b = 0;
                ++s;
            }
        }
        Lanes even, odd;
        normals_of(philox_lanes(own, block), even, odd);
        for (std::size_t lane = 0; lane < lane_count && begin + lane < total; ++lane) {
            out[2 * (begin + lane)] = even[lane];
            out[2 * (begin + lane) + 1] = odd[lane];
        }
    }
}

static void normals_array(const Stream& stream, std::uint64_t first, std::size_t count,
                          double* out) {
    const auto first_block = static_cast<std::uint32_t>(first >> 1);
    const std::size_t before = first & 1;  // a draw of the first block that is not asked for
    const Stream* own[lane_count];
    for (const Stream*& each : own) each = &stream;
    for (std::size_t at = 0; at < before + count; at += 2 * lane_count) {
        std::uint32_t block[lane_count];
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            block[lane] = first_block + static_cast<std::uint32_t>(at / 2 + lane);
        }
        Lanes even, odd;
        normals_of(philox_lanes(own, block), even, odd);
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            // Before the first one this wraps to a large number.
            const std::size_t place = at + 2 * lane - before;
            if (place < count) out[place] = even[lane];
            if (place + 1 < count) out[place + 1] = odd[lane];
        }
    }
}

/// out[i] = substream numbers[i] of parents[i]. `out` may be `parents`.
static void substreams(const Stream* parents, const std::uint32_t* numbers, std::size_t count,
                       Stream* out) {
    for (std::size_t begin = 0; begin < count; begin += lane_count) {
        Stream deriving[lane_count];
        const Stream* own[lane_count];
        std::uint32_t block[lane_count];
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            const std::size_t i = begin + lane < count ? begin + lane : count - 1;
            deriving[lane] = parents[i];
            deriving[lane].c1 |= derivation_marker;
            own[lane] = &deriving[lane];
            block[lane] = numbers[i];
        }
        const PhiloxLanes derived = philox_lanes(own, block);
        std::int64_t key0[lane_count], key1[lane_count];
        std::memcpy(key0, &derived.words[0], sizeof key0);
        std::memcpy(key1, &derived.words[1], sizeof key1);
        for (std::size_t lane = 0; lane < lane_count && begin + lane < count; ++lane) {
            out[begin + lane] = {static_cast<std::uint32_t>(key0[lane]),
                                 static_cast<std::uint32_t>(key1[lane]), 0, 0, 0};
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
