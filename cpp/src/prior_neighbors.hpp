// Entropies of posteriors whose neighbourhoods are those of the prior.
//
// A sharp observation leaves few points. What the nearest-neighbour estimate makes of them is
// mostly bias, which depends on how many are left: on the sensing action. Here each point n has one
// neighbourhood for all posteriors, B_n: the other points within the distance to the k-th nearest
// of the prior, or within the resolution if that is larger. With w the prior's weights, W those of
// a posterior, and
//     m_n(W) = (sum_{j in B_n} W_j + s W_n) / (1 - (1 - s) W_n),
//     entropy = (nearest-neighbour entropy of the prior) - sum_n W_n log(m_n(W) / m_n(w)):
// the prior's entropy less the information gained, the Kullback-Leibler divergence of posterior
// from prior. Volumes are those of the prior and the same for all sensing actions, so they cannot
// favour any. The share s counts a little of the point itself, so that m_n is not zero where
// nothing else is left; a whole one would take few points for certainty, as a kernel density does.

#pragma once

#include <cstddef>
#include <vector>

#include "entropy.hpp"
#include "vector_kernels.hpp"

namespace holdfast {

/// Entropies out[set][posterior] of `number` posteriors, weights[number][count], of which each has
/// so many `survivors`. The prior, settings.prior: not negative, one of them positive, sum 1.
void prior_entropies(const PointSets& sets, const double* weights,
                     const std::vector<std::size_t>& survivors, std::size_t number,
                     const EntropySettings& settings, const NearestNeighborConstants& constants,
                     double* out);

}  // namespace holdfast
