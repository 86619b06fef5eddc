// Sums over balls of the resolution, for a row of posteriors at once (one compilation per
// instruction set).
//
// For points that are denser than the resolution. Where a whole node of the tree lies within the
// ball, its row of sums is added at once.

#pragma once

#include "tree_search.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// A row of sums over posteriors: weights, and numbers of points.
template <std::size_t vectors>
struct Row {
    Lanes mass[vectors];
    CountLanes within[vectors];

    HOLDFAST_INLINE void add(const double* weights, const std::uint32_t* counts) {
        for (std::size_t v = 0; v < vectors; ++v) {
            mass[v] += load(weights + v * lane_count);
            CountLanes more;
            std::memcpy(&more, counts + v * lane_count, sizeof more);
            within[v] += more;
        }
    }

    HOLDFAST_INLINE void add(const Row& other) {
        for (std::size_t v = 0; v < vectors; ++v) {
            mass[v] += other.mass[v];
            within[v] += other.within[v];
        }
    }
};

/// For each point of the leaf: weights and numbers of all points (itself too) within the
/// resolution.
template <std::size_t vectors>
static void sum_balls(const PosteriorGroup& group, const QueryLeaf& query, double radius_squared,
                      Row<vectors>* rows, std::uint64_t* visits) {
    constexpr std::size_t columns = vectors * lane_count;
    const TreeView& tree = group.tree;
    Row<vectors> shared{};  // from nodes that lie within the ball around every point of the leaf
    for (std::size_t i = 0; i < query.used; ++i) rows[i] = Row<vectors>{};
    std::uint32_t stack[stack_size];
    std::size_t depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
        const std::uint32_t at = stack[--depth];
        double least, greatest;
        box_distances(tree, query, at, least, greatest);
        if (least > radius_squared) continue;
        if (greatest <= radius_squared) {
            shared.add(group.node_weights + at * columns, group.node_counts + at * columns);
            ++*visits;
            continue;
        }
        const TreeNode& node = tree.nodes[at];
        if (node.left != 0) {
            stack[depth++] = node.right;
            stack[depth++] = node.left;
            continue;
        }
        // The same two questions for each point of the leaf on its own, eight at a time.
        unsigned inside = 0, reached = 0;
        for (std::size_t v = 0; v < query_vectors; ++v) {
            const PointDistances to_box = point_distances(tree, query.coordinates, v, at);
            inside |= bits_of(to_box.greatest <= radius_squared) << (v * lane_count);
            reached |= bits_of(to_box.least <= radius_squared) << (v * lane_count);
        }
        for (std::size_t i = 0; i < query.used; ++i) {
            if ((inside >> i & 1) != 0) {
                rows[i].add(group.node_weights + at * columns, group.node_counts + at * columns);
                ++*visits;
                continue;
            }
            if ((reached >> i & 1) == 0) continue;
            *visits += leaf_size;
            Row<vectors> row = rows[i];
            for (std::size_t block = 0; block < leaf_size / lane_count; ++block) {
                unsigned bits = bits_of(leaf_distances(tree, query.points[i], node.first_leaf,
                                                       block) <= radius_squared);
                const std::size_t base = node.first_leaf * leaf_size + block * lane_count;
                if (bits == 0xff) {
                    row.add(group.block_weights + base / lane_count * columns,
                            group.block_counts + base / lane_count * columns);
                    continue;
                }
                while (bits != 0) {
                    const std::size_t slot = base + static_cast<std::size_t>(__builtin_ctz(bits));
                    bits &= bits - 1;
                    row.add(group.weights + slot * columns, group.significant + slot * columns);
                }
            }
            rows[i] = row;
        }
    }
    for (std::size_t i = 0; i < query.used; ++i) rows[i].add(shared);
}

/// The terms of one point under every posterior from its ball's sums.
template <std::size_t vectors>
static void ball_terms(const PosteriorGroup& group, const QueryLeaf& query, std::size_t i,
                       const Row<vectors>& row, const NearestNeighborConstants& constants,
                       double* scratch, Lanes* terms, std::uint64_t* visits) {
    const std::size_t slot = query.slots[i];
    const double log_ball = constants.log_ball_volume + static_cast<double>(group.tree.dimension) *
                                                            log_of(constants.resolution);
    for (std::size_t v = 0; v < vectors; ++v) {
        const Lanes weight = load(group.weights + (slot * vectors + v) * lane_count);
        // The point itself is within every ball around it.
        const Lanes log_mass = log_of((row.mass[v] - weight) / (1.0 - weight));
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            if (!(weight[lane] > 0.0)) continue;
            const std::size_t column = v * lane_count + lane;
            const std::uint32_t count = row.within[v][lane] - 1;
            terms[v][lane] +=
                query.factors[i] *
                (count >= group.neighbors[column]
                     ? weight[lane] * (log_ball - log_mass[lane] + constants.bias_correction[count])
                     : searched_term(group, query.points[i], slot, column, constants, scratch,
                                     visits));
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
