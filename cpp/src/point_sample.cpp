#include "point_sample.hpp"

#include <algorithm>
#include <limits>

#include "philox.hpp"

namespace holdfast {

PointSample::PointSample(const PointTree& tree, const double* greatest, double size,
                         double fewest) {
    double total = 0.0;
    for (std::size_t n = 0; n < tree.count; ++n) total += greatest[n];
    // The weights of a posterior sum to one, so at least so many of its points are expected.
    const double scale = std::max(size / total, fewest);
    const Stream draws{0, 0, 0, 0, 0};
    const auto place = [&](std::uint64_t draw) {
        return static_cast<double>(draw) + uniform(draws, draw);
    };
    std::uint64_t draw = 0;
    double next = place(draw), cumulated = 0.0;
    for (std::size_t slot = 0; slot < tree.count; ++slot) {
        const double probability = std::min(1.0, scale * greatest[tree.order[slot]]);
        cumulated += probability;
        double hits = 0.0;
        for (; cumulated > next; next = place(++draw)) hits += 1.0;
        if (hits == 0.0) continue;
        slots_.push_back(static_cast<std::uint32_t>(slot));
        factors_.push_back(hits / probability);
    }

    constexpr double infinity = std::numeric_limits<double>::infinity();
    const std::size_t dimension = tree.dimension;
    coordinates_.resize(leaves() * dimension * leaf_size, infinity);
    low_.resize(leaves() * dimension, infinity);
    high_.resize(leaves() * dimension, -infinity);
    for (std::size_t i = 0; i < slots_.size(); ++i) {
        for (std::size_t c = 0; c < dimension; ++c) {
            const std::size_t at = i / leaf_size * dimension + c;
            const std::size_t from = slots_[i] / leaf_size * dimension + c;
            const double x = tree.coordinates[from * leaf_size + slots_[i] % leaf_size];
            coordinates_[at * leaf_size + i % leaf_size] = x;
            low_[at] = std::min(low_[at], x);
            high_[at] = std::max(high_[at], x);
        }
    }
}

}  // namespace holdfast
