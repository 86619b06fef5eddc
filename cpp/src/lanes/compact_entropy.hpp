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

/// For each n the squared distances of eight points, from the `query`-th on, to point n; a point's
/// own is infinite. Returns those to the k-th neighbours, and in `within` how many are within the
/// resolution. A k that is known beforehand, not 0, keeps the least distances in registers.
template <std::uint32_t known>
static Lanes compact_distances(const CompactPosterior& posterior, std::size_t query,
                               std::uint32_t neighbors, double resolution_squared, Lanes& within) {
    double* const squared = posterior.scratch;
    double* const kept = squared + posterior.stride * lane_count;
    const Lanes far = splat(__builtin_inf());
    Lanes smallest[known == 0 ? 1 : known];
    for (Lanes& each : smallest) each = far;
    for (std::uint32_t i = 0; known == 0 && i < neighbors; ++i) store(kept + i * lane_count, far);
    for (std::size_t n = posterior.count; n % lane_count != 0; ++n) {
        store(squared + n * lane_count, far);
    }
    within = Lanes{};
    for (std::size_t n = 0; n < posterior.count; ++n) {
        Lanes distance{};
        for (std::size_t c = 0; c < posterior.dimension; ++c) {
            const double* x = posterior.coordinates + c * posterior.stride;
            const Lanes difference = load(x + query) - x[n];
            distance += difference * difference;
        }
        if (n - query < lane_count) distance[n - query] = __builtin_inf();
        store(squared + n * lane_count, distance);
        within += select(distance <= resolution_squared, splat(1.0), Lanes{});
        if constexpr (known != 0) {
            for (Lanes& each : smallest) order(each, distance);
        } else {
            for (std::uint32_t i = 0; i < neighbors; ++i) {
                Lanes each = load(kept + i * lane_count);
                order(each, distance);
                store(kept + i * lane_count, each);
            }
        }
    }
    return known != 0 ? smallest[known == 0 ? 0 : known - 1]
                      : load(kept + (neighbors - 1) * lane_count);
}

/// The k of the settings, unless it is changed.
inline constexpr std::uint32_t usual_neighbors = 5;

/// Eight points beside each other, each with its distances to all points.
static double compact_nearest(const CompactPosterior& posterior, std::uint32_t neighbors,
                              const NearestNeighborConstants& constants, std::uint64_t* visits) {
    const std::size_t count = posterior.count;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double log_resolution = log_of(constants.resolution);
    const double* const squared = posterior.scratch;
    double entropy = 0.0;
    for (std::size_t query = 0; query < count; query += lane_count) {
        Lanes within;
        const Lanes furthest =
            neighbors == usual_neighbors
                ? compact_distances<usual_neighbors>(posterior, query, neighbors,
                                                     resolution_squared, within)
                : compact_distances<0>(posterior, query, neighbors, resolution_squared, within);
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
