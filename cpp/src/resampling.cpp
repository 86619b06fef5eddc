#include "resampling.hpp"

#include <algorithm>

#include "kept_memory.hpp"

namespace holdfast {

void systematic_resample(const double* weights, std::size_t count, double offset,
                         std::int64_t* indices) {
    double total = 0.0;
    for (std::size_t n = 0; n < count; ++n) total += weights[n];
    double cumulated = 0.0;
    std::size_t n = 0, last_with_weight = 0;
    for (std::size_t j = 0; j < count; ++j) {
        const double tooth = (static_cast<double>(j) + offset) / static_cast<double>(count) * total;
        while (n < count && cumulated + weights[n] <= tooth) {
            if (weights[n] > 0.0) last_with_weight = n;
            cumulated += weights[n++];
        }
        indices[j] = static_cast<std::int64_t>(n < count ? n : last_with_weight);
    }
}

void resample(const Particles& particles, double offset, double* drawn) {
    const auto& [count, dimension, states, weights] = particles;
    KeptVector<std::int64_t> indices(count);
    systematic_resample(weights, count, offset, indices.data());
    for (const std::int64_t index : indices) {
        drawn = std::copy_n(states + static_cast<std::size_t>(index) * dimension, dimension, drawn);
    }
}

}  // namespace holdfast
