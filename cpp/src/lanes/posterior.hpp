// The posterior after a hypothetical observation (one compilation per instruction set).
//
// Bayes: w_n' = w_n p(z | v, x_n) / sum, computed from logarithms so that nothing underflows as a
// whole.
//
// Negligible weights become zero: those below the largest of 1e-2, 1e-3, ..., 1e-6 times the
// greatest weight that leaves out at most 0.5 % of the sum (or below 1e-6 times it, if none does).
// A particle of weight 1e-200 must not count as a neighbour, and one of 1e-5 is hardly better; but
// where small weights together matter, they stay.

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// The sums of the weights below a threshold, as those of all are added.
static Lanes sum_below(const double* weights, std::size_t count, double threshold) {
    Lanes below{};
    for (std::size_t i = 0; i < count; i += lane_count) {
        const std::size_t left = count - i < lane_count ? count - i : lane_count;
        const Lanes weight =
            left == lane_count ? load(weights + i) : load_partial(weights + i, left, 0.0);
        below += select(weight < threshold, weight, Lanes{});
    }
    return below;
}

/// In place: log weights (in `weights`) to normalised weights; returns the number of non-zero ones.
static std::size_t normalize_in_place(double* weights, std::size_t count, double largest,
                                      bool drop_negligible) {
    // NaN compares false; -infinity everywhere means that no particle can have made the
    // observation.
    if (!(largest > -1.7976931348623157e308 && largest < 1.7976931348623157e308)) return 0;
    constexpr std::size_t steps = 5;
    // A hair less, so that weights that are such fractions themselves stay, however they are
    // rounded.
    constexpr double hair = 1.0 - 0x1p-40;
    constexpr double thresholds[steps] = {1e-2 * hair, 1e-3 * hair, 1e-4 * hair, 1e-5 * hair,
                                          1e-6 * hair};
    constexpr double may_be_lost = 0.005;
    Lanes total{}, below{};
    for (std::size_t i = 0; i < count; i += lane_count) {
        const std::size_t left = count - i < lane_count ? count - i : lane_count;
        const Lanes weight =
            exp_of((left == lane_count ? load(weights + i)
                                       : load_partial(weights + i, left, -__builtin_inf())) -
                   largest);
        total += weight;
        below += select(weight < thresholds[0], weight, Lanes{});
        if (left == lane_count) {
            store(weights + i, weight);
        } else {
            store_partial(weights + i, weight, left);
        }
    }
    double threshold = 0.0;
    if (drop_negligible) {
        const double limit = may_be_lost * sum_of(total);
        std::size_t step = 0;
        while (step + 1 < steps && sum_of(below) > limit) {
            below = sum_below(weights, count, thresholds[++step]);
        }
        threshold = thresholds[step];
    }
    std::size_t survivors = 0;
    total = Lanes{};
    for (std::size_t i = 0; i < count; i += lane_count) {
        const std::size_t left = count - i < lane_count ? count - i : lane_count;
        const Lanes weight =
            left == lane_count ? load(weights + i) : load_partial(weights + i, left, 0.0);
        const IntLanes kept = (weight >= threshold) & (weight > 0.0);
        const Lanes result = select(kept, weight, Lanes{});
        survivors += static_cast<std::size_t>(__builtin_popcount(bits_of(kept)));
        total += result;
        if (left == lane_count) {
            store(weights + i, result);
        } else {
            store_partial(weights + i, result, left);
        }
    }
    const double inverse = 1.0 / sum_of(total);
    if (!(inverse > 0.0)) return 0;  // a NaN among the log weights
    std::size_t i = 0;
    for (; i + lane_count <= count; i += lane_count)
        store(weights + i, load(weights + i) * inverse);
    for (; i < count; ++i) weights[i] = weights[i] * inverse;
    return survivors;
}

static std::size_t normalize(const double* log_weights, std::size_t count, bool drop_negligible,
                             double* weights) {
    double largest = log_weights[0];
    for (std::size_t i = 0; i < count; ++i) {
        // Written so that a NaN anywhere ends up in `largest`.
        if (!(log_weights[i] <= largest)) largest = log_weights[i];
        if (largest != largest) return 0;
        weights[i] = log_weights[i];
    }
    return normalize_in_place(weights, count, largest, drop_negligible);
}

/// log w_n - sum over c of ((z_c - h_c(x_n))^2 / (2 R_c) + log(R_c) / 2), then normalised.
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
            const Lanes difference =
                splat(in.observation[c]) - fetch(in.predicted + c * in.count, 0.0);
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
    return normalize_in_place(weights, in.count, maximum_of(largest), in.drop_negligible);
}

}  // namespace holdfast::inline HOLDFAST_ISA
