#include "prior_neighbors.hpp"

#include <algorithm>
#include <limits>

#include "deterministic_math.hpp"
#include "thread_pool.hpp"

namespace holdfast {

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
// The share s of a point that counts in its own neighbourhood.
constexpr double own_share = 0.05;
// Distances that differ by rounding alone are equal.
constexpr double tolerance = 1.0 + 0x1p-40;
constexpr std::size_t block_size = 16;
// Nanoseconds for a distance and its part in the selection of the k nearest.
constexpr double cost_of_a_pair = 2.0;

double mass_around(double others, double own) {
    return (others + own_share * own) / (1.0 - (1.0 - own_share) * own);
}

}  // namespace

PriorNeighbors::PriorNeighbors(const double* points, std::size_t count, std::size_t dimension,
                               const double* prior, std::uint32_t neighbors,
                               const NearestNeighborConstants& constants, int threads)
    : count_(count), inverse_mass_(count), blocks_((count + block_size - 1) / block_size) {
    std::vector<double> coordinates(count * dimension);
    std::size_t present = 0;
    for (std::size_t n = 0; n < count; ++n) {
        if (prior[n] > 0.0) ++present;
        for (std::size_t c = 0; c < dimension; ++c) {
            coordinates[c * count + n] = points[n * dimension + c];
        }
    }
    const double d = static_cast<double>(dimension);
    if (present == 1) {  // known to within the resolution
        entropy_ = constants.log_ball_volume + d * log(constants.resolution);
        for (Block& block : blocks_) block.ends.resize(block_size);
        for (std::size_t n = 0; n < count; ++n) inverse_mass_[n] = prior[n] > 0.0 ? 1.0 : 0.0;
        return;
    }
    const std::size_t k = std::min<std::size_t>(neighbors, present - 1);
    const double least = constants.resolution * constants.resolution;
    std::vector<double> terms(count);
    const double work = cost_of_a_pair * static_cast<double>(count) * static_cast<double>(count);
    parallel_for(blocks_.size(), threads_for(work, blocks_.size(), threads), [&](std::size_t at) {
        Block& block = blocks_[at];
        std::vector<double> distances(count), nearest(k);
        for (std::size_t n = at * block_size; n < std::min((at + 1) * block_size, count); ++n) {
            if (prior[n] > 0.0) {
                std::fill(distances.begin(), distances.end(), 0.0);
                for (std::size_t c = 0; c < dimension; ++c) {
                    const double* column = &coordinates[c * count];
                    for (std::size_t j = 0; j < count; ++j) {
                        const double difference = column[j] - column[n];
                        distances[j] += difference * difference;
                    }
                }
                distances[n] = infinity;
                for (std::size_t j = 0; j < count && present < count; ++j) {
                    if (!(prior[j] > 0.0)) distances[j] = infinity;
                }
                std::size_t within = 0;
                for (std::size_t j = 0; j < count; ++j) within += distances[j] <= least * tolerance;
                const bool resolved = within < k;
                if (resolved) {
                    std::partial_sort_copy(distances.begin(), distances.end(), nearest.begin(),
                                           nearest.end());
                }
                const double radius = (resolved ? nearest[k - 1] : least) * tolerance;
                double mass = 0.0;
                const std::size_t first = block.members.size();
                for (std::size_t j = 0; j < count; ++j) {
                    if (distances[j] > radius) continue;
                    block.members.push_back(static_cast<std::uint32_t>(j));
                    mass += prior[j];
                }
                const std::size_t q = resolved ? k : block.members.size() - first;
                // Rounding may leave nothing for the others, or less than their own sum.
                const double rest = 1.0 - prior[n];
                const double share = mass < rest ? mass / rest : 1.0;
                terms[n] = prior[n] * (-log(share) + constants.log_ball_volume +
                                       0.5 * d * log(radius) + constants.bias_correction[q]);
                inverse_mass_[n] = 1.0 / mass_around(mass, prior[n]);
            }
            block.ends.push_back(static_cast<std::uint32_t>(block.members.size()));
        }
    });
    for (const double term : terms) entropy_ += term;
}

void PriorNeighbors::entropies(const double* weights, std::size_t number, double* out) const {
    // Point by point, the posteriors beside each other.
    std::vector<double> columns(count_ * prior_lanes), ratios(count_ * prior_lanes);
    for (std::size_t p = 0; p < number; ++p) {
        for (std::size_t n = 0; n < count_; ++n) {
            columns[n * prior_lanes + p] = weights[p * count_ + n];
        }
    }
    std::size_t n = 0;
    for (const Block& block : blocks_) {
        std::size_t begin = 0;
        for (std::size_t i = 0; i < block.ends.size() && n < count_; ++i, ++n) {
            double others[prior_lanes] = {};
            bool present = false;
            for (std::size_t p = 0; p < prior_lanes; ++p) {
                present |= columns[n * prior_lanes + p] > 0.0;
            }
            for (std::size_t at = present ? begin : block.ends[i]; at < block.ends[i]; ++at) {
                const double* column = &columns[block.members[at] * prior_lanes];
                for (std::size_t p = 0; p < prior_lanes; ++p) others[p] += column[p];
            }
            begin = block.ends[i];
            for (std::size_t p = 0; p < prior_lanes; ++p) {
                const double own = columns[n * prior_lanes + p];
                ratios[n * prior_lanes + p] =
                    own > 0.0 ? mass_around(others[p], own) * inverse_mass_[n] : 1.0;
            }
        }
    }
    vector_kernels().log(ratios.data(), ratios.data(), ratios.size());
    double gained[prior_lanes] = {};
    for (std::size_t row = 0; row < count_; ++row) {
        for (std::size_t p = 0; p < prior_lanes; ++p) {
            gained[p] += columns[row * prior_lanes + p] * ratios[row * prior_lanes + p];
        }
    }
    for (std::size_t p = 0; p < number; ++p) out[p] = entropy_ - gained[p];
}

std::size_t PriorNeighbors::members() const {
    std::size_t total = 0;
    for (const Block& block : blocks_) total += block.members.size();
    return total;
}

}  // namespace holdfast
