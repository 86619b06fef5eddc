#include "point_tree.hpp"

#include <algorithm>
#include <limits>

namespace holdfast {

namespace {
constexpr std::size_t unsorted_leaves = 4;
}

PointTree::PointTree(const double* points, std::size_t count_, std::size_t dimension_)
    : count(count_), dimension(dimension_), leaves((count_ + leaf_size - 1) / leaf_size) {
    order.resize(leaves * leaf_size, no_point);
    for (std::size_t i = 0; i < count; ++i) order[i] = static_cast<std::uint32_t>(i);
    nodes.reserve(2 * leaves);
    low.reserve(2 * leaves * dimension);
    high.reserve(2 * leaves * dimension);
    build(points, 0, static_cast<std::uint32_t>(leaves));

    coordinates.resize(leaves * dimension * leaf_size);
    for (std::size_t leaf = 0; leaf < leaves; ++leaf) {
        for (std::size_t c = 0; c < dimension; ++c) {
            double* to = &coordinates[(leaf * dimension + c) * leaf_size];
            for (std::size_t slot = 0; slot < leaf_size; ++slot) {
                const std::uint32_t point = order[leaf * leaf_size + slot];
                to[slot] = point == no_point ? std::numeric_limits<double>::infinity()
                                             : points[point * dimension + c];
            }
        }
    }
}

std::uint32_t PointTree::build(const double* points, std::uint32_t first_leaf,
                               std::uint32_t last_leaf) {
    const auto node = static_cast<std::uint32_t>(nodes.size());
    const auto begin = order.begin() + static_cast<std::ptrdiff_t>(first_leaf * leaf_size);
    const auto end = order.begin() + static_cast<std::ptrdiff_t>(
                                         std::min<std::size_t>(last_leaf * leaf_size, count));
    nodes.push_back({first_leaf, last_leaf, 0, 0});
    low.resize(low.size() + dimension, std::numeric_limits<double>::infinity());
    high.resize(high.size() + dimension, -std::numeric_limits<double>::infinity());
    double* lowest = &low[node * dimension];
    double* highest = &high[node * dimension];
    for (auto point = begin; point != end; ++point) {
        for (std::size_t c = 0; c < dimension; ++c) {
            const double x = points[*point * dimension + c];
            lowest[c] = std::min(lowest[c], x);
            highest[c] = std::max(highest[c], x);
        }
    }
    if (last_leaf - first_leaf == 1) {
        // Within a leaf the order of a partition is the library's own; sorting makes it ours.
        std::sort(begin, end);
        return node;
    }
    std::size_t widest = 0;
    for (std::size_t c = 1; c < dimension; ++c) {
        if (highest[c] - lowest[c] > highest[widest] - lowest[widest]) widest = c;
    }
    const std::uint32_t middle = first_leaf + (last_leaf - first_leaf) / 2;
    // Among so few points everything is near everything: their order is as good as any.
    if (leaves > unsorted_leaves) {
        // Ties broken by index make the two halves, as sets, the same with every standard library.
        std::nth_element(begin, order.begin() + static_cast<std::ptrdiff_t>(middle * leaf_size),
                         end, [&](std::uint32_t a, std::uint32_t b) {
                             const double xa = points[a * dimension + widest];
                             const double xb = points[b * dimension + widest];
                             return xa != xb ? xa < xb : a < b;
                         });
    }
    const std::uint32_t left = build(points, first_leaf, middle);
    const std::uint32_t right = build(points, middle, last_leaf);
    nodes[node].left = left;
    nodes[node].right = right;
    return node;
}

}  // namespace holdfast
