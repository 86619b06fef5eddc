// Algorithm 2: the expected entropy of the task actions after each sensing action.
//
// For every sensing action j and for i = 1..M: draw a particle from the belief, draw an observation
// z of it under j, reweight all particles by p(z | v_j, x), and take the entropy of the policy's
// actions under these weights. Sensing does not move the state, so the actions (`points`) are
// computed once by the caller; and the M draws use the same random numbers for every j, so that
// differences between sensing actions have less variance than the entropies themselves. The M
// particles are drawn by stratified sampling: one from each M-th of the cumulated weight.
//
// Source: Greigarn, Branicky and Cavusoglu, "Task-oriented active sensing via action entropy
// minimization", IEEE Access, 2019.

#pragma once

#include <cstddef>
#include <cstdint>

#include "entropy.hpp"
#include "philox.hpp"

namespace holdfast {

struct HypothesisInput {
    std::size_t count;                      // particles
    const double* weights;                  // [count], sum 1
    std::size_t sensing_actions;            // J
    const std::uint32_t* observation_size;  // [J]
    const double* predicted;                // all coordinates of all actions: [total][count]
    const double* variance;                 // [total], or [total][count] if varying
    bool varying_variance;
    std::size_t samples;  // M
    Stream stream;
    bool drop_negligible;          // weights of the posteriors
    const std::uint8_t* circular;  // null, or [total]: 1 where an observation is an angle
};

/// Entropies of the J x M hypothetical posteriors, row by row; NaN where an observation explains
/// nothing. All sets of points share the posteriors. With `unchanged` one more follows, that of the
/// belief as it is.
void hypothetical_entropies(const HypothesisInput& input, const PointSets& sets,
                            const EntropySettings& settings, bool unchanged, double* out,
                            EntropyCounts& counts);

/// Draws one particle from each `samples`-th of the cumulated weight: particles[samples].
void stratified(const double* weights, std::size_t count, std::size_t samples, const Stream& stream,
                std::int64_t* particles);

/// The posterior weights themselves: out[J][M][count]; for horizons above 1.
void hypothetical_weights(const HypothesisInput& input, double* out);

}  // namespace holdfast
