// One point under one posterior, by searching the tree (one compilation per instruction set).
//
// Right for every point, and the slowest way: for what balls and lists do not settle.

#pragma once

#include "compact_entropy.hpp"
#include "tree_distances.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// Squared distance to the k-th nearest other point that column `column` gives weight.
static double kth_distance(const PosteriorGroup& group, const double* point, std::size_t own_slot,
                           std::size_t column, std::uint32_t neighbors, double* smallest,
                           std::uint64_t* visits) {
    const TreeView& tree = group.tree;
    const std::size_t columns = group.vectors * lane_count;
    struct Pending {
        std::uint32_t node;
        double least;
    } stack[stack_size];
    std::size_t depth = 0;
    std::uint32_t kept = 0;
    stack[depth++] = {0, 0.0};
    while (depth > 0) {
        const Pending pending = stack[--depth];
        if (kept == neighbors && pending.least > smallest[neighbors - 1]) continue;
        const TreeNode& node = tree.nodes[pending.node];
        if (node.left != 0) {
            std::uint32_t near = node.left, far = node.right;
            double near_least = point_to_box(tree, point, near);
            double far_least = point_to_box(tree, point, far);
            if (far_least < near_least) {
                const std::uint32_t n = near;
                near = far;
                far = n;
                const double l = near_least;
                near_least = far_least;
                far_least = l;
            }
            if (group.node_counts[far * columns + column] != 0) stack[depth++] = {far, far_least};
            if (group.node_counts[near * columns + column] != 0)
                stack[depth++] = {near, near_least};
            continue;
        }
        for (std::size_t block = 0; block < leaf_size / lane_count; ++block) {
            const double limit = kept < neighbors ? __builtin_inf() : smallest[neighbors - 1];
            const Lanes distance = leaf_distances(tree, point, node.first_leaf, block);
            unsigned bits = bits_of(distance < limit);
            while (bits != 0) {
                const unsigned lane = static_cast<unsigned>(__builtin_ctz(bits));
                bits &= bits - 1;
                const std::size_t slot = node.first_leaf * leaf_size + block * lane_count + lane;
                if (slot == own_slot || group.significant[slot * columns + column] == 0) continue;
                if (kept < neighbors || distance[lane] < smallest[neighbors - 1]) {
                    insert_smallest(smallest, kept, neighbors, distance[lane]);
                }
            }
        }
        *visits += leaf_size;
    }
    return smallest[neighbors - 1];
}

/// Weight and number of the other points that column `column` gives weight within a radius.
struct Within {
    double mass;
    std::uint32_t count;
};

static Within within_radius(const PosteriorGroup& group, const double* point, std::size_t own_slot,
                            std::size_t column, double radius_squared, std::uint64_t* visits) {
    const TreeView& tree = group.tree;
    const std::size_t columns = group.vectors * lane_count;
    std::uint32_t stack[stack_size];
    std::size_t depth = 0;
    Within found{0.0, 0};
    stack[depth++] = 0;
    while (depth > 0) {
        const std::uint32_t at = stack[--depth];
        if (group.node_counts[at * columns + column] == 0) continue;
        if (point_to_box(tree, point, at) > radius_squared) continue;
        const TreeNode& node = tree.nodes[at];
        if (node.left != 0) {
            stack[depth++] = node.right;
            stack[depth++] = node.left;
            continue;
        }
        for (std::size_t block = 0; block < leaf_size / lane_count; ++block) {
            unsigned bits =
                bits_of(leaf_distances(tree, point, node.first_leaf, block) <= radius_squared);
            while (bits != 0) {
                const unsigned lane = static_cast<unsigned>(__builtin_ctz(bits));
                bits &= bits - 1;
                const std::size_t slot = node.first_leaf * leaf_size + block * lane_count + lane;
                if (slot == own_slot) continue;
                found.mass += group.weights[slot * columns + column];
                found.count += group.significant[slot * columns + column];
            }
        }
        *visits += leaf_size;
    }
    return found;
}

/// One point under one posterior, by searching the tree: right for every point, and the slowest
/// way.
static double searched_term(const PosteriorGroup& group, const double* point, std::size_t slot,
                            std::size_t column, const NearestNeighborConstants& constants,
                            double* scratch, std::uint64_t* visits) {
    const std::uint32_t neighbors = group.neighbors[column];
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double weight = group.weights[slot * group.vectors * lane_count + column];
    double radius_squared = kth_distance(group, point, slot, column, neighbors, scratch, visits);
    const bool resolved = radius_squared > resolution_squared;
    radius_squared = resolved ? radius_squared * tie_tolerance : resolution_squared;
    const Within found = within_radius(group, point, slot, column, radius_squared, visits);
    return nearest_term(weight, found.mass, 0.5 * log_of(radius_squared), group.tree.dimension,
                        resolved ? neighbors : found.count, constants);
}

}  // namespace holdfast::inline HOLDFAST_ISA
