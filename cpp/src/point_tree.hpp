// A k-d tree over points, laid out for scanning eight points at a time.
//
// Built once for a set of points and shared by every posterior over them: posteriors differ in
// their weights, not in where their points are. Leaves hold 16 consecutive slots; the tree says
// which leaves are wholly inside a ball, wholly outside, or worth looking into (Moore, "Efficient
// memory-based learning for robot control", 1991, and the multiresolution sums of Gray and Moore,
// NIPS 2000).

#pragma once

#include <cstddef>
#include <cstdint>

#include "kept_memory.hpp"

namespace holdfast {

inline constexpr std::size_t leaf_size = 16;
/// A tree of no more leaves has the points in their own order: among so few everything is near
/// everything.
inline constexpr std::size_t unsorted_leaves = 4;
inline constexpr std::size_t max_dimension = 64;
inline constexpr std::uint32_t no_point = 0xffffffffu;

struct TreeNode {
    std::uint32_t first_leaf;  // the node covers leaves [first_leaf, last_leaf)
    std::uint32_t last_leaf;
    std::uint32_t left;   // index of the left child, 0 in a leaf (0 is the root, nobody's child)
    std::uint32_t right;  // children come after their parent, so a backward pass sees them first
};

/// The tree as plain pointers, for the inner loops.
struct TreeView {
    std::size_t count;
    std::size_t dimension;
    std::size_t leaves;
    const double* coordinates;
    const TreeNode* nodes;
    const double* low;
    const double* high;
};

class PointTree {
  public:
    /// @param points row-major, `count` rows of `dimension` finite coordinates; count >= 1
    PointTree(const double* points, std::size_t count, std::size_t dimension);

    TreeView view() const {
        return {count,        dimension,  leaves,     coordinates.data(),
                nodes.data(), low.data(), high.data()};
    }

    std::size_t count;
    std::size_t dimension;
    std::size_t leaves;
    /// Point in each slot; `no_point` in the slots that fill up the last leaf.
    KeptVector<std::uint32_t> order;
    /// coordinates[(leaf * dimension + c) * leaf_size + slot]; +infinity in unused slots.
    KeptVector<double> coordinates;
    KeptVector<TreeNode> nodes;
    /// low[node * dimension + c] <= coordinate c of every point of the node <= high[...].
    KeptVector<double> low, high;

  private:
    KeptVector<double> keys_;
    KeptVector<std::uint32_t> rest_;

    std::uint32_t build(const double* points, std::uint32_t first_leaf, std::uint32_t last_leaf);
};

}  // namespace holdfast
