// Bayes' rule on weighted particles, in one call of the kernel.
//
// An observation is folded in at every sensing step, by the robot and by the service, often with
// cold caches: there each function on the way costs microseconds, whatever it does. So likelihood,
// weights and the numbers that judge them come from one call.

#pragma once

#include <cstddef>
#include <vector>

namespace holdfast {

struct Particles {
    std::size_t count, dimension;
    const double* states;   // [count][dimension]
    const double* weights;  // [count]
};

/// What was observed with Gaussian noise, and what each particle predicts.
struct GaussianObservation {
    std::size_t size;                          // coordinates
    const double* observed;                    // [size]
    const double* mean;                        // [count][size]
    const double* variance;                    // [size], or [count][size]
    bool varies;                               // the variance, from particle to particle
    const std::vector<std::size_t>& circular;  // the coordinates that are angles
};

struct BeliefSizes {
    double effective;      // 1 / sum of squared weights
    std::size_t distinct;  // states that differ from the one before, and the first
};

BeliefSizes sizes_of(const Particles& particles);

/// Log-likelihoods up to a constant. Returns the least squared Mahalanobis distance among particles
/// of positive weight; NaN if one of theirs is.
double gaussian_log_likelihood(const Particles& particles, const GaussianObservation& observation,
                               double* log_likelihood);

/// Turns log-likelihoods, in place, into normalised posterior weights. Returns how many are not
/// zero: if none is, there is no posterior, and the values mean nothing.
std::size_t reweigh(const Particles& particles, double* log_likelihood);

}  // namespace holdfast
