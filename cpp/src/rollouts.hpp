// Rollouts of expected_return for the built-in problems.
//
// The returns of robots that act on a belief up to the goal, as
// holdfast/planning/expected_return.py has them for any problem. What NumPy cannot do is done here:
//
// - A step's noise has the name of the sample, whatever became of the others.
// - From where the state is known, the policy is followed with the noise of the true state and
//   without obstacles, which takes nanoseconds a step. Robots of a sample in one state have one
//   value. Without noise a robot would stand at the edge of a stage, and rounding decide.
// - A move that stays clear of obstacles asks for no collision.
//
// Before them come the beliefs, of any problem: J x M posteriors, each without the particle that is
// its own true state.
#pragma once

#include <cstddef>
#include <cstdint>

#include "philox.hpp"

namespace holdfast {

struct RolloutInput {
    std::size_t actions, samples, members;  // J, M, L
    const double* true_states;              // [M][d]
    const double* estimates;                // [J][M][d]
    const double* clouds;                   // [J][M][L][d]
    std::size_t stage;
    const double* standard_deviation;  // [d]
    double tolerance;
    // Steps from one sensing step to the next; at how many of them the state may become known.
    std::size_t interval, looks;
    std::size_t steps;
    double discount, price;
    bool counts_steps;  // -1 for each step instead of the reward
};

// Writes the returns, [J][M]. In step t of sample i the true state's noise is that of particle
// i (1 + L) in a `move` with substream t of the stream, that of member l of its clouds particle
// i (1 + L) + 1 + l.
template <class World, class Policy>
void roll_out(const World& world, const Policy& policy, const RolloutInput& input,
              const Stream& stream, int threads, double* returns);

/// Leaves out of each posterior, weights[J][M][count], its own true state `truths[M]`, unless its
/// weight is all but `negligible`, and normalises the others. Then `means` are [J][M][dimension]
/// and `clouds` [J][M][L][dimension]: one particle of each L-th of the cumulated weight, at a place
/// that a sample's draw of the stream names. False if a posterior gives its true state no weight.
bool beliefs_without_truth(std::size_t actions, std::size_t samples, std::size_t count,
                           std::size_t dimension, std::size_t members_each, const double* states,
                           const std::int64_t* truths, const Stream& stream, double negligible,
                           double* weights, double* means, double* clouds);

}  // namespace holdfast
