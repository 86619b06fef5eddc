// Distances between points and nodes of the tree, eight at a time (one compilation per instruction
// set).
//
// Bounds of boxes are computed with the same operations in the same order as distances of points.
// Rounding is monotone, so a box that is found inside (outside) has only points that would be found
// inside (outside).

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::inline HOLDFAST_ISA {

inline constexpr std::size_t stack_size = 128;  // deeper than any balanced tree of 2^32 points

/// Least and greatest squared distance between two boxes.
HOLDFAST_INLINE void box_distances(std::size_t dimension, const double* a_low, const double* a_high,
                                   const double* b_low, const double* b_high, double& least,
                                   double& greatest) {
    least = 0.0;
    greatest = 0.0;
    for (std::size_t c = 0; c < dimension; ++c) {
        const double gap_1 = b_low[c] - a_high[c], gap_2 = a_low[c] - b_high[c];
        double gap = gap_1 > gap_2 ? gap_1 : gap_2;
        if (gap < 0.0) gap = 0.0;
        const double span_1 = b_high[c] - a_low[c], span_2 = a_high[c] - b_low[c];
        const double span = span_1 > span_2 ? span_1 : span_2;
        least += gap * gap;
        greatest += span * span;
    }
}

/// Least squared distance from one point to the box of a node.
HOLDFAST_INLINE double point_to_box(const TreeView& tree, const double* point, std::size_t node) {
    double least = 0.0;
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        const double gap_1 = tree.low[node * tree.dimension + c] - point[c];
        const double gap_2 = point[c] - tree.high[node * tree.dimension + c];
        double gap = gap_1 > gap_2 ? gap_1 : gap_2;
        if (gap < 0.0) gap = 0.0;
        least += gap * gap;
    }
    return least;
}

inline constexpr std::size_t query_vectors = leaf_size / lane_count;

/// Least and greatest squared distance from eight points of a leaf to the box of a node.
struct PointDistances {
    Lanes least, greatest;

    /// Adds a coordinate, in which the box lies between two numbers.
    HOLDFAST_INLINE void add(const Lanes& x, double low, double high) {
        const Lanes from_low = x - low;
        const Lanes to_high = high - x;
        Lanes span = from_low, gap = -to_high;
        const IntLanes upper = to_high > from_low;
        span = select(upper, to_high, span);
        gap = select(upper, -from_low, gap);
        gap = select(gap > 0.0, gap, Lanes{});
        least += gap * gap;
        greatest += span * span;
    }
};

/// From eight points of a leaf with these coordinates, [dimension][leaf_size].
HOLDFAST_INLINE PointDistances point_distances(const TreeView& tree, const double* coordinates,
                                               std::size_t v, std::size_t node) {
    PointDistances result{};
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        result.add(load(coordinates + c * leaf_size + v * lane_count),
                   tree.low[node * tree.dimension + c], tree.high[node * tree.dimension + c]);
    }
    return result;
}

/// Squared distances from a point to eight slots of a leaf.
HOLDFAST_INLINE Lanes leaf_distances(const TreeView& tree, const double* point, std::size_t leaf,
                                     std::size_t block) {
    Lanes distance{};
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        const Lanes difference =
            load(tree.coordinates + (leaf * tree.dimension + c) * leaf_size + block * lane_count) -
            point[c];
        distance += difference * difference;
    }
    return distance;
}

/// A leaf whose points are the centres of the balls and lists that are asked for: one of the tree,
/// or of a sample of its points.
struct QueryLeaf {
    std::size_t used;
    const double* coordinates;  // [dimension][leaf_size]
    const double* low;          // of the box around the points
    const double* high;
    std::uint32_t slots[leaf_size];  // in the tree
    double factors[leaf_size];       // by which the terms are multiplied
    double points[leaf_size][max_dimension];
};

HOLDFAST_INLINE void open_leaf(const TreeView& tree, const SampleView& sample, std::size_t leaf,
                               QueryLeaf& query) {
    const std::size_t first = leaf * leaf_size;
    const bool sampled = sample.count != 0;
    const std::size_t left = (sampled ? sample.count : tree.count) - first;
    query.used = left < leaf_size ? left : leaf_size;
    query.coordinates = (sampled ? sample.coordinates : tree.coordinates) + first * tree.dimension;
    if (sampled) {
        query.low = sample.low + leaf * tree.dimension;
        query.high = sample.high + leaf * tree.dimension;
    } else {
        std::size_t at = 0;
        while (tree.nodes[at].left != 0) {
            const TreeNode& node = tree.nodes[at];
            at = leaf < tree.nodes[node.left].last_leaf ? node.left : node.right;
        }
        query.low = tree.low + at * tree.dimension;
        query.high = tree.high + at * tree.dimension;
    }
    for (std::size_t i = 0; i < query.used; ++i) {
        query.slots[i] = sampled ? sample.slots[first + i] : static_cast<std::uint32_t>(first + i);
        query.factors[i] = sampled ? sample.factors[first + i] : 1.0;
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            query.points[i][c] = query.coordinates[c * leaf_size + i];
        }
    }
}

/// Least and greatest squared distance between the points of a leaf and a node.
HOLDFAST_INLINE void box_distances(const TreeView& tree, const QueryLeaf& query, std::size_t node,
                                   double& least, double& greatest) {
    const std::size_t other = node * tree.dimension;
    box_distances(tree.dimension, query.low, query.high, tree.low + other, tree.high + other, least,
                  greatest);
}

/// The greatest squared distance between the corners of a leaf's box.
HOLDFAST_INLINE double squared_diameter(const TreeView& tree, const QueryLeaf& query) {
    double unused, diameter;
    box_distances(tree.dimension, query.low, query.high, query.low, query.high, unused, diameter);
    return diameter;
}

}  // namespace holdfast::inline HOLDFAST_ISA
