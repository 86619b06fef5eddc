#include "point_tree.hpp"

#include <algorithm>
#include <limits>

namespace holdfast {

namespace {

/// The n-th least of some values, which it puts into another order. Without a branch on a value:
/// that would be wrong half of the time.
double nth_of(double* values, std::size_t size, std::size_t n) {
    constexpr std::size_t few = 8;
    // Where the middle of three divides badly, the library goes on.
    for (int turns = 48; size > few && turns > 0; --turns) {
        const double a = values[0], b = values[size / 2], c = values[size - 1];
        const double middle = std::max(std::min(a, b), std::min(std::max(a, b), c));
        std::size_t less = 0, equal = 0;
        for (std::size_t i = 0; i < size; ++i) {
            less += values[i] < middle ? 1 : 0;
            equal += values[i] == middle ? 1 : 0;
        }
        if (n >= less && n < less + equal) return middle;
        const bool below = n < less;
        std::size_t kept = 0;
        for (std::size_t i = 0; i < size; ++i) {
            const double value = values[i];
            values[kept] = value;
            kept += (below ? value < middle : value > middle) ? 1 : 0;
        }
        n -= below ? 0 : less + equal;
        size = kept;
    }
    std::nth_element(values, values + n, values + size);
    return values[n];
}

}  // namespace

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
    for (std::size_t c = 0; c < dimension; ++c) {
        double least = lowest[c], greatest = highest[c];
        for (auto point = begin; point != end; ++point) {
            const double x = points[*point * dimension + c];
            least = std::min(least, x);
            greatest = std::max(greatest, x);
        }
        lowest[c] = least;
        highest[c] = greatest;
    }
    if (last_leaf - first_leaf == 1) return node;
    std::size_t widest = 0;
    for (std::size_t c = 1; c < dimension; ++c) {
        if (highest[c] - lowest[c] > highest[widest] - lowest[widest]) widest = c;
    }
    const std::uint32_t middle = first_leaf + (last_leaf - first_leaf) / 2;
    if (leaves > unsorted_leaves) {
        // Of equal coordinates the lower numbers go left. Both halves keep the order of numbers.
        const std::size_t half = (middle - first_leaf) * leaf_size;
        const auto size = static_cast<std::size_t>(end - begin);
        keys_.resize(2 * size);
        rest_.resize(size);
        for (std::size_t i = 0; i < size; ++i) {
            keys_[i] = keys_[size + i] = points[begin[i] * dimension + widest];
        }
        const double* keys = keys_.data() + size;
        const double limit = nth_of(keys_.data(), size, half);
        auto equals = static_cast<std::ptrdiff_t>(half);
        for (std::size_t i = 0; i < size; ++i) equals -= keys[i] < limit ? 1 : 0;
        std::size_t kept = 0, others = 0;
        for (std::size_t i = 0; i < size; ++i) {
            const bool equal = keys[i] == limit;
            const bool goes_left = (keys[i] < limit) | (equal & (equals > 0));
            equals -= equal ? 1 : 0;
            const std::uint32_t point = begin[i];
            begin[kept] = rest_[others] = point;
            kept += goes_left ? 1 : 0;
            others += goes_left ? 0 : 1;
        }
        std::copy(rest_.begin(), rest_.begin() + static_cast<std::ptrdiff_t>(others),
                  begin + static_cast<std::ptrdiff_t>(half));
    }
    const std::uint32_t left = build(points, first_leaf, middle);
    const std::uint32_t right = build(points, middle, last_leaf);
    nodes[node].left = left;
    nodes[node].right = right;
    return node;
}

}  // namespace holdfast
