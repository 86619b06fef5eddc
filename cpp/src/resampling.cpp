#include "resampling.hpp"

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

}  // namespace holdfast
