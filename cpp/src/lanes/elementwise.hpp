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

static void normals_array(const Stream& stream, std::uint64_t first, std::size_t count,
                          double* out) {
    std::uint64_t index = first;
    const std::uint64_t end = first + count;
    while (index < end) {
        // Eight blocks of two deviates at a time; the first and last block may be used in part.
        const std::uint64_t first_block = index >> 1;
        const std::uint64_t blocks = (end + 1) / 2 - first_block;
        const std::size_t used =
            blocks < lane_count ? static_cast<std::size_t>(blocks) : lane_count;
        Lanes radius_uniform{}, angle_uniform{};
        for (std::size_t lane = 0; lane < used; ++lane) {
            const PhiloxBlock block =
                philox(stream, static_cast<std::uint32_t>(first_block + lane));
            radius_uniform[lane] = unit_interval(block.words[0], block.words[1]);
            angle_uniform[lane] = unit_interval(block.words[2], block.words[3]);
        }
        Lanes even, odd;
        box_muller(radius_uniform, angle_uniform, even, odd);
        for (std::size_t lane = 0; lane < used && index < end; ++lane) {
            if ((index & 1) == 0) out[index++ - first] = even[lane];
            if (index < end) out[index++ - first] = odd[lane];
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
