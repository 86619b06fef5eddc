// Differential entropy of weighted points, for many weightings of the same points at once.
//
// Nearest neighbour with a resolution: r_n is the distance to the k-th other point of non-zero
// weight, or the resolution if that is larger; q_n others lie within it, with the share m_n of the
// others' weight;
//     entropy = sum_n w_n (-log m_n + log c_d + d log r_n + log q_n - psi(q_n)),
// c_d the volume of the unit ball. On uniform weights and a small resolution it is the estimator of
// Kozachenko and Leonenko (1987) in the form of Kraskov, Stoegbauer and Grassberger (2004, eq. 20),
// with log(N - 1) where they have psi(N); with ties it stays finite.
//
// Gaussian mixture: every point is the mean of a Gaussian of covariance S; Kolchinsky and Tracey
// (2017) bound the mixture's entropy by
//     d/2 log(2 pi e) + 1/2 log |S| - sum_i w_i log sum_j w_j exp(-c (u_i - u_j)' S^-1 (u_i -
//     u_j)),
// c = 1/2 from above, 1/8 from below. The caller scales the points by S^-1/2.
//
// Prior neighbours: see prior_neighbors.hpp.
//
// Total variance: no entropy, but the trace of the weighted points' covariance, to compare with.

#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>

namespace holdfast {

// Points up to which no sample stands for all, and points in the sample for the groups of a batch.
// The estimate of what a decision costs uses them, too.
inline constexpr std::size_t initially_few_up_to = 16384;
inline constexpr double sample_of_groups = 2048.0;

enum class Estimator { nearest_neighbor, gaussian_mixture, total_variance, prior_neighbors };

struct EntropySettings {
    Estimator estimator;
    std::uint32_t neighbors;  // nearest neighbour: k >= 1
    double resolution;        // nearest neighbour: > 0
    double exponent;          // mixture: c > 0
    double offset;            // added to every entropy (the mixture's constant terms)
    int threads;              // 0: all
    const double* prior;      // prior neighbours: [count], sum 1; else unused
    bool sampled;             // of many points, a sample's terms stand for all (point_sample.hpp)
};

/// What was counted on the way, for benchmarks.
struct EntropyCounts {
    std::uint64_t likelihoods = 0;
    std::uint64_t visits = 0;
    // Posteriors by the way that their entropy took (see entropy.cpp).
    std::uint64_t pair_by_pair = 0;
    std::uint64_t own_tree = 0;
    std::uint64_t grouped = 0;
};

/// Whether an estimate looks at weights that are negligible (lanes/posterior.hpp) as well: a far
/// point of small weight says nothing about densities, but much about a variance.
inline bool drops_negligible(Estimator estimator) {
    return estimator != Estimator::total_variance;
}

/// Fills `weights[count]` with posterior `index`, normalised; returns the number of non-zero ones.
/// Called from several threads at once.
using PosteriorSource = std::function<std::size_t(std::size_t index, double* weights)>;

/// Sets of points that are weighted alike: point n of every set has the weight of particle n.
struct PointSets {
    const double* points;  // [number][count][dimension]
    std::size_t count;
    std::size_t dimension;
    std::size_t number;     // sets, at least 1
    const double* factors;  // [number]
};

/// Entropies of `posteriors` weightings: the sum over the sets, in their order, of factor times
/// entropy.
///
/// An entry is NaN where the source returned 0.
void entropies(const PointSets& sets, std::size_t posteriors, const PosteriorSource& source,
               const EntropySettings& settings, double* out, EntropyCounts& counts);

/// Sets up to how many points all terms are added, leaf by leaf; returns how many there were. For
/// tests.
std::size_t take_as_few_up_to(std::size_t points);

}  // namespace holdfast
