#include "belief_update.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "kept_memory.hpp"
#include "vector_kernels.hpp"

namespace holdfast {

namespace {

/// As holdfast.numerics.reproducible.wrapped.
double less_whole_turns(double angle) {
    constexpr double turn = 6.28318530717958647693;
    return angle - turn * std::rint(angle / turn);
}

}  // namespace

BeliefSizes sizes_of(const Particles& particles) {
    const auto& [count, dimension, states, weights] = particles;
    BeliefSizes sizes{1.0 / vector_kernels().weighted_sum(weights, weights, count), 1};
    for (std::size_t i = 1; i < count; ++i) {
        const double* own = states + i * dimension;
        bool differs = false;
        for (std::size_t c = 0; c < dimension; ++c) differs |= own[c] != (own - dimension)[c];
        sizes.distinct += differs;
    }
    return sizes;
}

double gaussian_log_likelihood(const Particles& particles, const GaussianObservation& in,
                               double* log_likelihood) {
    const std::size_t count = particles.count;
    double* distance = log_likelihood;  // they stand where the log-likelihoods will
    std::fill_n(distance, count, 0.0);
    // Each particle's, coordinate after coordinate: the order is part of the result.
    for (std::size_t c = 0; c < in.size; ++c) {
        const bool is_angle = std::count(in.circular.begin(), in.circular.end(), c) > 0;
        for (std::size_t i = 0; i < count; ++i) {
            const std::size_t at = i * in.size + c;
            double difference = in.observed[c] - in.mean[at];
            if (is_angle) difference = less_whole_turns(difference);
            distance[i] += difference * difference / in.variance[in.varies ? at : c];
        }
    }
    double nearest = std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i < count && nearest == nearest; ++i) {
        if (particles.weights[i] > 0.0 && !(distance[i] >= nearest)) nearest = distance[i];
    }
    for (std::size_t i = 0; i < count; ++i) log_likelihood[i] = -0.5 * distance[i];
    if (in.varies) {
        KeptVector<double> logs(count * in.size);
        vector_kernels().log(in.variance, logs.data(), logs.size());
        for (std::size_t i = 0; i < count; ++i) {
            const double* own = &logs[i * in.size];
            for (std::size_t c = 0; c < in.size; ++c) log_likelihood[i] -= 0.5 * own[c];
        }
    }
    return nearest;
}

std::size_t reweigh(const Particles& particles, double* log_likelihood) {
    const std::size_t count = particles.count;
    KeptVector<double> logs(count);
    vector_kernels().log(particles.weights, logs.data(), count);
    for (std::size_t i = 0; i < count; ++i) log_likelihood[i] += logs[i];
    return vector_kernels().normalize(log_likelihood, count, false, log_likelihood);
}

}  // namespace holdfast
