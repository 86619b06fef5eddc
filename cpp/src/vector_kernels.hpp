// The inner loops, compiled once for each instruction set and chosen at start-up.
//
// The files in lanes/ are compiled several times, each time in a namespace of its own and with
// another -m flag; this table holds the entry points of one such compilation. All of them give the
// same bits (tests/unit/test_kernel.py), only the speed differs.

#pragma once

#include <cstddef>
#include <cstdint>

#include "philox.hpp"
#include "point_tree.hpp"
#include "policies.hpp"

namespace holdfast {

/// The widest row of posteriors handled at once: 4 x 8.
inline constexpr std::size_t max_group_lanes = 32;
/// The most leaves that block_nearest takes at once.
inline constexpr std::size_t block_leaves = 16;

/// Everything that a hypothetical observation's posterior is made of.
struct PosteriorInput {
    std::size_t count;               // particles
    const double* log_weights;       // [count] log prior weights
    std::size_t observation_size;    // coordinates of the observation
    const double* predicted;         // [observation_size][count] expected observations
    const double* inverse_variance;  // [observation_size], or [observation_size][count]
    const double* log_normalizer;    // null, or [count]: sum over coordinates of log(variance) / 2
    const double* observation;       // [observation_size]
    bool drop_negligible;
};

/// A sample of a tree's points, whose terms stand for those of all: in leaves of 16, as the tree's.
struct SampleView {
    std::size_t count;          // 0: every point of the tree is asked for
    const double* coordinates;  // [leaves][dimension][16]
    const double* low;          // [leaves][dimension], of the box around a leaf's points
    const double* high;
    const std::uint32_t* slots;  // [count] where the tree has them
    const double* factors;       // [count] by which their weights are multiplied
};

/// Posteriors over the points of one tree, side by side: row = slot of the tree, column =
/// posterior.
struct PosteriorGroup {
    TreeView tree;
    SampleView sample;
    std::size_t members;               // posteriors; the other columns of a row are zero
    std::size_t vectors;               // Lanes in a row, 1 to 4
    const double* weights;             // [slots][vectors * 8], each column sums to 1
    const std::uint32_t* significant;  // [slots][vectors * 8], 1 where the weight is not zero
    const double* block_weights;       // [slots / 8][vectors * 8], sums of eight slots
    const std::uint32_t* block_counts;
    const double* node_weights;        // [nodes][vectors * 8], sums below each node
    const std::uint32_t* node_counts;  // [nodes][vectors * 8]
    const std::uint32_t* neighbors;    // [vectors * 8] the k of each column, 0 in unused columns
};

struct NearestNeighborConstants {
    double resolution;
    double log_ball_volume;         // log c_d
    const double* bias_correction;  // [q] log q - psi(q)
};

/// One posterior with few points: coordinates[c * stride + i], weights[i], i < count.
/// The stride is a multiple of 8; coordinates beyond count are +infinity, weights zero.
struct CompactPosterior {
    std::size_t count;
    std::size_t stride;
    std::size_t dimension;
    const double* coordinates;
    const double* weights;
    double* scratch;  // [stride + the k of the nearest neighbours][8]
};

/// The most points of few_nearest.
inline constexpr std::size_t few_points = 16 * leaf_size;

/// Points of a prior that are worked on together.
inline constexpr std::size_t prior_block_size = 32;

/// Points of a prior and posteriors over them, side by side (prior_neighbors.hpp).
struct PriorGroup {
    std::size_t count;   // points of positive prior weight
    std::size_t stride;  // a multiple of 8
    std::size_t dimension;
    std::size_t varying;         // coordinates that are not the same in all points, or one
    const double* coordinates;   // [varying][stride], +infinity beyond count
    const std::uint32_t* order;  // [count] the points, equal ones beside each other
    std::size_t vectors;         // Lanes in a row
    const double* weights;       // [vectors][count][8]: of the prior, then of the posteriors
    std::uint32_t neighbors;     // the k, 0 if there is one point
    NearestNeighborConstants constants;
};

/// A disc among `num_obstacles` rectangles of four limits each: x_min, y_min, x_max, y_max.
struct DiscShape {
    double radius_squared;
    const double* obstacles;
    std::size_t num_obstacles;
};

/// A rectangle among such obstacles.
struct RectangleShape {
    double half_width, half_height, bounding_radius;
    const double* obstacles;
    std::size_t num_obstacles;
};

/// A box among boxes of six limits each: the minima, then the maxima.
struct BoxShape {
    double half_size[3], bounding_radius;
    const double* obstacles;
    std::size_t num_obstacles;
};
/// Cross products of two edges that are shorter separate nothing (geometry_3d.hpp).
inline constexpr double shortest_axis_squared = 1e-16;

/// A body within a ball among boxes, to ask how far it is from them: of each the minima, then the
/// maxima.
struct RoundShape {
    double radius;
    const double* obstacles;
    std::size_t num_obstacles;
};

/// States whose policies are followed side by side without obstacles, for one step with noise.
/// Here and below coordinate c of state i is at [c * stride + i], and arrays have room for a
/// multiple of eight, with any valid stage where there is no state.
struct FreeWalk {
    std::size_t stride, count;
    double* states;
    std::int64_t* stages;
    const double* noise;
    double* values;
    double factor, price;  // of the reward; subtracted from the value if it `pays`
    bool pays, counts_steps;
    std::uint8_t* goals;  // whether the goal is reached
};

/// States that are followed without noise, at most way_stride, with which as the stride.
inline constexpr std::size_t way_stride = 32;
struct Way {
    std::size_t count;
    double *states, *actions, *next;
    std::int64_t* stages;
    double* room;  // how far they may move along each axis; less than zero: to be found
    RoundShape round;
};

/// What a policy says of many states.
template <class Policy, class Shape>
struct PolicyKernels {
    /// The stages that follow, and the actions executed in them.
    void (*decide)(const Policy&, const double* states, std::size_t stride, std::size_t count,
                   std::int64_t* stages, double* actions);
    /// The rewards, unless null, of actions that led to the states, and whether these are goals.
    void (*judge)(const Policy&, const Shape&, const double* states, const double* actions,
                  std::size_t stride, std::size_t count, double* rewards, std::uint8_t* goals);
    void (*walk)(const Policy&, const Shape&, const FreeWalk&);
    /// How far each of the states may move along each axis, and turn as it likes, without a
    /// collision. Zero or less tells nothing.
    void (*clearances)(const RoundShape&, const double* states, std::size_t stride,
                       std::size_t count, double* out);
    /// The next actions of those in the bits `moving`, and where these lead. Returns, as bits,
    /// those that are in collision there.
    std::uint32_t (*act)(const Policy&, const Shape&, const Way&, std::uint32_t moving);
    /// Makes the next state of those in the bits `moving` their state, with its stage. Returns
    /// which of them have changed.
    std::uint32_t (*arrive)(const Policy&, const Way&, std::uint32_t moving);
    /// The actions that the policy commands in all states, without the limits of a step.
    void (*command)(const Policy&, const Way&);
};

struct VectorKernels {
    const char* name;
    void (*exp)(const double* in, double* out, std::size_t count);
    void (*log)(const double* in, double* out, std::size_t count);
    void (*sin)(const double* in, double* out, std::size_t count);
    void (*cos)(const double* in, double* out, std::size_t count);
    void (*normals)(const Stream&, std::uint64_t first, std::size_t count, double* out);
    /// Both draws of `each` blocks from firsts[i] on of each of several streams: out[stream][2
    /// each].
    void (*normal_blocks)(const Stream* streams, const std::uint32_t* firsts, std::size_t number,
                          std::size_t each, double* out);
    /// out[i] = substream numbers[i] of parents[i].
    void (*substreams)(const Stream* parents, const std::uint32_t* numbers, std::size_t count,
                       Stream* out);
    /// Which of the states, [count][2], [count][3] or [count][6], are in collision: out[count].
    void (*discs_collide)(const DiscShape&, const double* states, std::size_t count,
                          std::uint8_t* out);
    void (*rectangles_collide)(const RectangleShape&, const double* states, std::size_t count,
                               std::uint8_t* out);
    void (*boxes_collide)(const BoxShape&, const double* states, std::size_t count,
                          std::uint8_t* out);
    PolicyKernels<PegPolicy2D, RectangleShape> peg_2d;
    PolicyKernels<PegPolicy3D, BoxShape> peg_3d;
    PolicyKernels<ViaPointPolicy, DiscShape> via_points;
    double (*sum)(const double* in, std::size_t count);
    /// Sum of weights[i] * in[i], in the order of `sum`, as each of the next.
    double (*weighted_sum)(const double* weights, const double* in, std::size_t count);
    void (*weighted_sums)(const double* weights, const double* rows, std::size_t count,
                          std::size_t dimension, double* out);
    /// Normalised posterior weights; returns how many are not zero, 0 if there is no posterior.
    std::size_t (*posterior)(const PosteriorInput&, double* weights);
    /// Normalises weights e^log_weights; those that underflow next to the largest are zero.
    std::size_t (*normalize)(const double* log_weights, std::size_t count, bool drop_negligible,
                             double* weights);
    double (*compact_nearest)(const CompactPosterior&, std::uint32_t neighbors,
                              const NearestNeighborConstants&, std::uint64_t* visits);
    /// The same for up to few_points points and eight neighbours, added as over a tree of their
    /// own; the stride is a multiple of leaf_size.
    double (*few_nearest)(const CompactPosterior&, std::uint32_t neighbors,
                          const NearestNeighborConstants&, std::uint64_t* visits);
    double (*compact_mixture)(const CompactPosterior&, double exponent, std::uint64_t* visits);
    /// Adds the terms of the points of one leaf: out[vectors * 8].
    /// `scratch` holds as many doubles as the largest k.
    void (*group_nearest)(const PosteriorGroup&, std::size_t leaf, const NearestNeighborConstants&,
                          double* scratch, double* out, std::uint64_t* visits);
    /// The same for `leaves` leaves from `first` on.
    void (*block_nearest)(const PosteriorGroup&, std::size_t first, std::size_t leaves,
                          const NearestNeighborConstants&, double* scratch, double* out,
                          std::uint64_t* visits);
    void (*group_mixture)(const PosteriorGroup&, std::size_t leaf, double exponent, double* out,
                          std::uint64_t* visits);
    /// The terms of the points [begin, end) of a prior; see lanes/prior_block.hpp.
    void (*prior_block)(const PriorGroup&, std::size_t begin, std::size_t end, double* scratch,
                        std::uint32_t* numbers, double* terms, double* gains);
};

inline const auto& kernels_of(const VectorKernels& all, const PegPolicy2D&) {
    return all.peg_2d;
}
inline const auto& kernels_of(const VectorKernels& all, const PegPolicy3D&) {
    return all.peg_3d;
}
inline const auto& kernels_of(const VectorKernels& all, const ViaPointPolicy&) {
    return all.via_points;
}

/// The best of the compiled sets that this processor runs; HOLDFAST_SIMD names another one.
const VectorKernels& vector_kernels();

}  // namespace holdfast
