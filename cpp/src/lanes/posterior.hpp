// The posterior after a hypothetical observation (one compilation per instruction set).
//
// Bayes: w_n' = w_n p(z | v, x_n) / sum, computed from logarithms so that nothing underflows as a whole.
// Weights below `negligible` times the largest are set to zero: they are below any effect on the
// entropy, and a particle of weight 1e-200 must not count as a neighbour.

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::HOLDFAST_ISA {

/// In place: log weights (in `weights`) to normalised weights; returns the number of non-zero ones.
static std::size_t normalize_in_place(double* weights, std::size_t count, double largest,
                                      double log_negligible) {
    // NaN compares false; -infinity everywhere means that no particle can have made the observation.
    if (!(largest > -1.7976931348623157e308 && largest < 1.7976931348623157e308)) return 0;
    Lanes total{};
    std::size_t survivors = 0;
    for (std::size_t i = 0; i < count; i += lane_count) {
        const std::size_t left = count - i < lane_count ? count - i : lane_count;
        const Lanes relative =
            (left == lane_count ? load(weights + i) : load_partial(weights + i, left, -1e300)) - largest;
        const IntLanes kept = relative >= log_negligible;
        const Lanes weight = select(kept, exp_of(relative), Lanes{});
        survivors += static_cast<std::size_t>(__builtin_popcount(bits_of(kept)));
        total += weight;
        if (left == lane_count) {
            store(weights + i, weight);
        } else {
            store_partial(weights + i, weight, left);
        }
    }
    const double inverse = 1.0 / sum_of(total);
    if (!(inverse > 0.0)) return 0;  // a NaN among the log weights
    std::size_t i = 0;
    for (; i + lane_count <= count; i += lane_count) store(weights + i, load(weights + i) * inverse);
    for (; i < count; ++i) weights[i] = weights[i] * inverse;
    return survivors;
}

static std::size_t normalize(const double* log_weights, std::size_t count, double log_negligible,
                             double* weights) {
    double largest = log_weights[0];
    for (std::size_t i = 0; i < count; ++i) {
        // Written so that a NaN anywhere ends up in `largest`.
        if (!(log_weights[i] <= largest)) largest = log_weights[i];
        if (largest != largest) return 0;
        weights[i] = log_weights[i];
    }
    return normalize_in_place(weights, count, largest, log_negligible);
}

/// log w_n - sum over c of (z_c - h_c(x_n))^2 / (2 R_c) + log R_c / 2, then normalised.
static std::size_t posterior(const PosteriorInput& in, double* weights) {
    const bool varying = in.log_normalizer != nullptr;
    Lanes largest = splat(-__builtin_inf());
    for (std::size_t i = 0; i < in.count; i += lane_count) {
        const std::size_t left = in.count - i < lane_count ? in.count - i : lane_count;
        const auto fetch = [&](const double* from, double filler) HOLDFAST_LAMBDA {
            return left == lane_count ? load(from + i) : load_partial(from + i, left, filler);
        };
        Lanes exponent{};
        for (std::size_t c = 0; c < in.observation_size; ++c) {
            const Lanes difference = splat(in.observation[c]) - fetch(in.predicted + c * in.count, 0.0);
            const Lanes inverse = varying ? fetch(in.inverse_variance + c * in.count, 1.0)
                                          : splat(in.inverse_variance[c]);
            exponent += difference * difference * inverse;
        }
        Lanes log_weight = fetch(in.log_weights, -__builtin_inf()) - 0.5 * exponent;
        if (varying) log_weight -= fetch(in.log_normalizer, 0.0);
        largest = select(log_weight > largest, log_weight, largest);
        if (left == lane_count) {
            store(weights + i, log_weight);
        } else {
            store_partial(weights + i, log_weight, left);
        }
    }
    return normalize_in_place(weights, in.count, maximum_of(largest), in.log_negligible);
}

}  // namespace holdfast::HOLDFAST_ISA
