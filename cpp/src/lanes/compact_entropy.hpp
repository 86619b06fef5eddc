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

/// Of one point: -log(m / (1 - w)) + log c_d + d log r + log q - psi(q).
HOLDFAST_INLINE double nearest_value(double weight, double mass, double log_radius,
                                     std::size_t dimension, std::uint32_t within,
                                     const NearestNeighborConstants& constants) {
    return constants.log_ball_volume + static_cast<double>(dimension) * log_radius -
           log_of(mass / (1.0 - weight)) + constants.bias_correction[within];
}

/// Its term: w times that.
HOLDFAST_INLINE double nearest_term(double weight, double mass, double log_radius,
                                    std::size_t dimension, std::uint32_t within,
                                    const NearestNeighborConstants& constants) {
    return weight * nearest_value(weight, mass, log_radius, dimension, within, constants);
}

static double compact_nearest(const CompactPosterior& posterior, std::uint32_t neighbors,
                              const NearestNeighborConstants& constants, std::uint64_t* visits) {
    const std::size_t count = posterior.count;
    const std::size_t blocks = (count + lane_count - 1) / lane_count;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double log_resolution = log_of(constants.resolution);
    double* squared = posterior.scratch;
    double* smallest = squared + posterior.stride;
    double entropy = 0.0;
    for (std::size_t n = 0; n < count; ++n) {
        Lanes mass{};
        std::uint32_t within = 0;
        for (std::size_t b = 0; b < blocks; ++b) {
            Lanes distance{};
            for (std::size_t c = 0; c < posterior.dimension; ++c) {
                const double* x = posterior.coordinates + c * posterior.stride;
                const Lanes difference = load(x + b * lane_count) - x[n];
                distance += difference * difference;
            }
            store(squared + b * lane_count, distance);
        }
        squared[n] = __builtin_inf();  // a point is no neighbour of its own
        for (std::size_t b = 0; b < blocks; ++b) {
            const IntLanes inside = load(squared + b * lane_count) <= resolution_squared;
            within += static_cast<std::uint32_t>(__builtin_popcount(bits_of(inside)));
            mass += select(inside, load(posterior.weights + b * lane_count), Lanes{});
        }
        double log_radius = log_resolution;
        if (within < neighbors) {
            std::uint32_t kept = 0;
            for (std::size_t b = 0; b < blocks; ++b) {
                const Lanes distance = load(squared + b * lane_count);
                const double limit = kept < neighbors ? __builtin_inf() : smallest[neighbors - 1];
                unsigned bits = bits_of(distance < limit);
                while (bits != 0) {
                    const unsigned lane = static_cast<unsigned>(__builtin_ctz(bits));
                    bits &= bits - 1;
                    const double value = squared[b * lane_count + lane];
                    if (kept < neighbors || value < smallest[neighbors - 1]) {
                        insert_smallest(smallest, kept, neighbors, value);
                    }
                }
            }
            const double radius_squared = smallest[neighbors - 1] * tie_tolerance;
            mass = Lanes{};
            for (std::size_t b = 0; b < blocks; ++b) {
                mass += select(load(squared + b * lane_count) <= radius_squared,
                               load(posterior.weights + b * lane_count), Lanes{});
            }
            within = neighbors;
            log_radius = 0.5 * log_of(radius_squared);
        }
        entropy += nearest_term(posterior.weights[n], sum_of(mass), log_radius, posterior.dimension,
                                within, constants);
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
