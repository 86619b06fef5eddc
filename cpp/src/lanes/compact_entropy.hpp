// The entropy of one posterior with few points, pair by pair (one compilation per instruction set).

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// Keeps `smallest[0..kept)`, the least values seen so far in ascending order, at most `wanted`.
HOLDFAST_INLINE void insert_smallest(double* smallest, std::uint32_t& kept, std::uint32_t wanted,
                                     double value) {
    std::uint32_t at = kept < wanted ? kept++ : wanted - 1;
    while (at > 0 && smallest[at - 1] > value) {
        smallest[at] = smallest[at - 1];
        --at;
    }
    smallest[at] = value;
}

/// Distances that differ by rounding alone are equal: a radius reaches this much further (squared).
/// Otherwise points on a grid would be in or out of a ball by the accident of their last bit.
inline constexpr double tie_tolerance = 1.0 + 0x1p-40;

/// The term of one point: w (-log(m / (1 - w)) + log c_d + d log r + log q - psi(q)).
HOLDFAST_INLINE double nearest_term(double weight, double mass, double log_radius,
                                    std::size_t dimension, std::uint32_t within,
                                    const NearestNeighborConstants& constants) {
    return weight * (constants.log_ball_volume + static_cast<double>(dimension) * log_radius -
                     log_of(mass / (1.0 - weight)) + constants.bias_correction[within]);
}

/// The k of the settings, unless it is changed: its least values stay in registers.
inline constexpr std::uint32_t usual_neighbors = 5;

/// Of rows of eight values, `count` at least k, the k-th least in each column, and in `within` how
/// many are up to a limit. `kept` has room for k rows.
template <std::uint32_t known>
static Lanes kth_least(const double* rows, std::size_t count, std::uint32_t k, double* kept,
                       double limit, Lanes& within) {
    Lanes smallest[known == 0 ? 1 : known];
    for (Lanes& each : smallest) each = splat(__builtin_inf());
    for (std::uint32_t i = 0; known == 0 && i < k; ++i) store(kept + i * lane_count, smallest[0]);
    within = Lanes{};
    for (std::size_t n = 0; n < count; ++n) {
        Lanes value = load(rows + n * lane_count);
        within += select(value <= limit, splat(1.0), Lanes{});
        if constexpr (known != 0) {
            for (Lanes& each : smallest) order(each, value);
        } else {
            for (std::uint32_t i = 0; i < k; ++i) {
                Lanes each = load(kept + i * lane_count);
                order(each, value);
                store(kept + i * lane_count, each);
            }
        }
    }
    if constexpr (known != 0) return smallest[known - 1];
    return load(kept + (k - 1) * lane_count);
}

HOLDFAST_INLINE Lanes kth_least(const double* rows, std::size_t count, std::uint32_t k,
                                double* kept, double limit, Lanes& within) {
    if (k == usual_neighbors)
        return kth_least<usual_neighbors>(rows, count, k, kept, limit, within);
    return kth_least<0>(rows, count, k, kept, limit, within);
}

/// Row n: the squared distances of eight points, from the `query`-th on, to point n. A point's own
/// is infinite, as are those beyond the last point.
static void compact_distances(const CompactPosterior& posterior, std::size_t query,
                              double* squared) {
    const Lanes far = splat(__builtin_inf());
    for (std::size_t n = 0; n < posterior.count; ++n) {
        Lanes distance{};
        for (std::size_t c = 0; c < posterior.dimension; ++c) {
            const double* x = posterior.coordinates + c * posterior.stride;
            const Lanes difference = load(x + query) - x[n];
            distance += difference * difference;
        }
        store(squared + n * lane_count, distance);
    }
    for (std::size_t n = posterior.count; n < posterior.stride; ++n) {
        store(squared + n * lane_count, far);
    }
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        squared[(query + lane) * lane_count + lane] = __builtin_inf();
    }
}

/// Eight points beside each other, each with its distances to all points.
static double compact_nearest(const CompactPosterior& posterior, std::uint32_t neighbors,
                              const NearestNeighborConstants& constants, std::uint64_t* visits) {
    const std::size_t count = posterior.count;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double log_resolution = log_of(constants.resolution);
    double* const squared = posterior.scratch;
    double* const kept = squared + posterior.stride * lane_count;
    double entropy = 0.0;
    for (std::size_t query = 0; query < count; query += lane_count) {
        compact_distances(posterior, query, squared);
        Lanes within;
        const Lanes furthest =
            kth_least(squared, count, neighbors, kept, resolution_squared, within);
        const IntLanes resolved = within >= static_cast<double>(neighbors);
        const Lanes reached = furthest * tie_tolerance;
        const Lanes radius_squared = select(resolved, splat(resolution_squared), reached);
        // Eight partial sums, as if eight points were added at a time.
        Lanes partial[lane_count] = {};
        for (std::size_t n = 0; n < count; n += lane_count) {
            for (std::size_t i = 0; i < lane_count; ++i) {
                partial[i] += select(load(squared + (n + i) * lane_count) <= radius_squared,
                                     splat(posterior.weights[n + i]), Lanes{});
            }
        }
        const Lanes mass = sum_of_each(partial);
        const Lanes weight = load(posterior.weights + query);
        const Lanes log_radius =
            select(resolved, splat(log_resolution), 0.5 * log_of(radius_squared));
        Lanes correction{};
        const std::size_t used = count - query < lane_count ? count - query : lane_count;
        for (std::size_t lane = 0; lane < used; ++lane) {
            const auto number = static_cast<std::uint32_t>(within[lane]);
            correction[lane] = constants.bias_correction[number < neighbors ? neighbors : number];
        }
        const Lanes terms = weight * (constants.log_ball_volume +
                                      static_cast<double>(posterior.dimension) * log_radius -
                                      log_of(mass / (1.0 - weight)) + correction);
        for (std::size_t lane = 0; lane < used; ++lane) entropy += terms[lane];
    }
    *visits += count * count;
    return entropy;
}

/// - sum_i w_i log sum_j w_j exp(-exponent |u_i - u_j|^2)
static double compact_mixture(const CompactPosterior& posterior, double exponent,
                              std::uint64_t* visits) {
    const std::size_t count = posterior.count;
    double entropy = 0.0;
    for (std::size_t n = 0; n < count; ++n) {
        Lanes total{};
        for (std::size_t i = 0; i < count; i += lane_count) {
            Lanes distance{};
            for (std::size_t c = 0; c < posterior.dimension; ++c) {
                const double* x = posterior.coordinates + c * posterior.stride;
                const Lanes difference = load(x + i) - x[n];
                distance += difference * difference;
            }
            total += load(posterior.weights + i) * exp_of(-exponent * distance);
        }
        entropy -= posterior.weights[n] * log_of(sum_of(total));
    }
    *visits += count * count;
    return entropy;
}

}  // namespace holdfast::inline HOLDFAST_ISA
