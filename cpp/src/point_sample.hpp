// A sample of the points of a tree, whose terms stand for those of all.
//
// An entropy is a weighted mean of terms, one of each point. Of many points a sample gives it
// within a known error, at a cost that does not grow with their number times that of the points
// around them. A point comes in with a probability in proportion to its greatest weight under any
// of some posteriors, and counts in inverse proportion to it (Horvitz and Thompson, 1952); a
// posterior's entropy is the ratio of two such sums (Hajek, 1971). In the order of the tree each
// part of equal probability has one draw, at random: so the sample is spread over the points as
// their weights are, and neither the middle of a part nor its edge is preferred.
//
// The random numbers are the same for all samples, so equal points and weights have equal ones.

#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "vector_kernels.hpp"

namespace holdfast {

class PointSample {
  public:
    /// Draws about `size` points, or more if a posterior would have fewer than `fewest` of them.
    ///
    /// `greatest`: of the weights of each of the tree's points, by its number.
    PointSample(const PointTree& tree, const double* greatest, double size, double fewest);

    std::size_t leaves() const { return (slots_.size() + leaf_size - 1) / leaf_size; }

    SampleView view() const {
        return {slots_.size(), coordinates_.data(), low_.data(),
                high_.data(),  slots_.data(),       factors_.data()};
    }

  private:
    std::vector<std::uint32_t> slots_;
    std::vector<double> factors_, coordinates_, low_, high_;
};

}  // namespace holdfast
