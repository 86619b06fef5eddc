// Systematic resampling: N evenly spaced teeth, with one random offset, through the cumulated
// weights.
//
// Source: Carpenter, Clifford and Fearnhead (1999); Thrun, Burgard and Fox, Probabilistic Robotics,
// table 4.4. Mind the division: the teeth are at (j + u) / N as real numbers. With an integer
// division all teeth fall on one particle, which is what the first implementation of this work did.

#pragma once

#include <cstddef>
#include <cstdint>

#include "belief_update.hpp"

namespace holdfast {

/// indices[j] = the particle under tooth (j + offset) / count; offset in [0, 1); the
/// weights need not sum to 1.
void systematic_resample(const double* weights, std::size_t count, double offset,
                         std::int64_t* indices);

/// The states of the particles under the teeth, [count][dimension].
void resample(const Particles& particles, double offset, double* drawn);

}  // namespace holdfast
