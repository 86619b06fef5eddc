// The entropies of many posteriors over the same points at once (one compilation per instruction
// set).
//
// The geometry (which points lie within a ball, what the kernel between two points is) does not
// depend on the weights. So it is computed once per pair of points and applied to a row of up to 32
// posteriors; and where a whole node of the tree lies within the ball, its row of sums is added at
// once.
//
// Bounds of boxes are computed with the same operations in the same order as distances of points.
// Rounding is monotone, so a box that is found inside (outside) has only points that would be found
// inside (outside).

#pragma once

#include "compact_entropy.hpp"

namespace holdfast::HOLDFAST_ISA {

template <std::size_t... i>
struct Indices {};
template <std::size_t count, std::size_t... i>
struct IndicesBelow : IndicesBelow<count - 1, count - 1, i...> {};
template <std::size_t... i>
struct IndicesBelow<0, i...> {
    using type = Indices<i...>;
};

inline constexpr std::size_t stack_size = 128;  // deeper than any balanced tree of 2^32 points

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

/// Least and greatest squared distance between the boxes of two nodes.
HOLDFAST_INLINE void box_distances(const TreeView& tree, std::size_t a, std::size_t b,
                                   double& least, double& greatest) {
    least = 0.0;
    greatest = 0.0;
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        const double a_low = tree.low[a * tree.dimension + c],
                     a_high = tree.high[a * tree.dimension + c];
        const double b_low = tree.low[b * tree.dimension + c],
                     b_high = tree.high[b * tree.dimension + c];
        const double gap_1 = b_low - a_high, gap_2 = a_low - b_high;
        double gap = gap_1 > gap_2 ? gap_1 : gap_2;
        if (gap < 0.0) gap = 0.0;
        const double span_1 = b_high - a_low, span_2 = a_high - b_low;
        const double span = span_1 > span_2 ? span_1 : span_2;
        least += gap * gap;
        greatest += span * span;
    }
}

/// The same from one point to the box of a node; only the least distance is wanted.
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
};

HOLDFAST_INLINE PointDistances point_distances(const TreeView& tree, std::size_t leaf,
                                               std::size_t v, std::size_t node) {
    PointDistances result{};
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        const Lanes x =
            load(tree.coordinates + (leaf * tree.dimension + c) * leaf_size + v * lane_count);
        const Lanes from_low = x - tree.low[node * tree.dimension + c];
        const Lanes to_high = tree.high[node * tree.dimension + c] - x;
        Lanes span = from_low, gap = -to_high;
        const IntLanes upper = to_high > from_low;
        span = select(upper, to_high, span);
        gap = select(upper, -from_low, gap);
        gap = select(gap > 0.0, gap, Lanes{});
        result.least += gap * gap;
        result.greatest += span * span;
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

/// What the three ways below have in common about the leaf whose points are the centres.
struct QueryLeaf {
    std::size_t leaf;
    std::uint32_t node;
    std::size_t first_slot;
    std::size_t used;
    double points[leaf_size][max_dimension];
};

HOLDFAST_INLINE void open_leaf(const TreeView& tree, std::size_t leaf, QueryLeaf& query) {
    query.leaf = leaf;
    query.node = 0;
    while (tree.nodes[query.node].left != 0) {
        const TreeNode& node = tree.nodes[query.node];
        query.node = leaf < tree.nodes[node.left].last_leaf ? node.left : node.right;
    }
    query.first_slot = leaf * leaf_size;
    const std::size_t left = tree.count - query.first_slot;
    query.used = left < leaf_size ? left : leaf_size;
    for (std::size_t i = 0; i < query.used; ++i) {
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            query.points[i][c] = tree.coordinates[(leaf * tree.dimension + c) * leaf_size + i];
        }
    }
}

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
        box_distances(tree, query.node, at, least, greatest);
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
            const PointDistances to_box = point_distances(tree, query.leaf, v, at);
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

/// The nearest points of sixteen query points, sorted: keys[v][rank] has those of eight of them.
///
/// A key is a squared distance whose ten low bits are replaced by the number of the candidate, so
/// that numbers travel with distances through the sorting. The distance that is left is right
/// to 2.3e-13 of its size, a quarter of what counts as a tie anyway.
inline constexpr std::int64_t number_bits = 1023;
inline constexpr std::size_t max_candidate_leaves = (number_bits + 1) / leaf_size;
inline constexpr double far_away = 1e300;

template <std::size_t length>
struct NearestLists {
    Lanes keys[query_vectors][length];
    std::uint32_t leaves[max_candidate_leaves];  // number / leaf_size -> leaf
    double complete_below;                       // no point nearer than this was left out
};

/// Comparisons of a sorting network, as constants, so that the rows it sorts can stay in registers.
struct Comparison {
    std::uint8_t low, high;
};

template <std::size_t length>
struct Network {
    Comparison comparisons[length * 10];
    std::size_t size;
};

/// Batcher's odd-even merge sort (1968); `length` is a power of two.
template <std::size_t length>
constexpr Network<length> sorting_network() {
    Network<length> network{};
    for (std::size_t p = 1; p < length; p += p) {
        for (std::size_t k = p; k >= 1; k /= 2) {
            for (std::size_t j = k % p; j + k < length; j += 2 * k) {
                for (std::size_t i = j; i < j + k && i + k < length; ++i) {
                    if (i / (2 * p) != (i + k) / (2 * p)) continue;
                    network.comparisons[network.size++] = {static_cast<std::uint8_t>(i),
                                                           static_cast<std::uint8_t>(i + k)};
                }
            }
        }
    }
    return network;
}

/// The last stages of a bitonic sorter: sorts what first rises and then falls.
template <std::size_t length>
constexpr Network<length> merging_network() {
    Network<length> network{};
    for (std::size_t k = length / 2; k >= 1; k /= 2) {
        for (std::size_t j = 0; j < length; j += 2 * k) {
            for (std::size_t i = j; i < j + k; ++i) {
                network.comparisons[network.size++] = {static_cast<std::uint8_t>(i),
                                                       static_cast<std::uint8_t>(i + k)};
            }
        }
    }
    return network;
}

template <std::size_t length>
inline constexpr Network<length> sorting = sorting_network<length>();
template <std::size_t length>
inline constexpr Network<length> merging = merging_network<length>();

template <std::size_t length, const Network<length>& network, std::size_t... i>
HOLDFAST_INLINE void apply_written_out(Lanes* rows, Indices<i...>) {
    (order(rows[network.comparisons[i].low], rows[network.comparisons[i].high]), ...);
}

/// Applies a network to rows of eight lists each. Thirty-two rows fit into the registers of
/// AVX-512, so there the comparisons are written out; more rows go through memory in a loop.
template <std::size_t length, const Network<length>& network>
HOLDFAST_INLINE void apply(Lanes* rows) {
    if constexpr (length <= 32) {
        apply_written_out<length, network>(rows, typename IndicesBelow<network.size>::type{});
    } else {
        for (std::size_t i = 0; i < network.size; ++i) {
            order(rows[network.comparisons[i].low], rows[network.comparisons[i].high]);
        }
    }
}

/// Sorts `block` and keeps in the sorted `best` the least of both, sorted: for eight lists at once.
template <std::size_t length>
static void merge_block(Lanes* best, Lanes* block) {
    Lanes rows[length];
    for (std::size_t i = 0; i < length; ++i) rows[i] = block[i];
    apply<length, sorting<length>>(rows);
    for (std::size_t i = 0; i < length; ++i) block[i] = rows[i];
    for (std::size_t i = 0; i < length; ++i) {
        rows[i] = best[i];
        Lanes other = block[length - 1 - i];
        order(rows[i], other);
    }
    apply<length, merging<length>>(rows);
    for (std::size_t i = 0; i < length; ++i) best[i] = rows[i];
}

/// The largest of the last keys: no query point looks further.
template <std::size_t length>
HOLDFAST_INLINE double furthest(const NearestLists<length>& lists) {
    Lanes largest = lists.keys[0][length - 1];
    for (std::size_t v = 1; v < query_vectors; ++v) {
        const Lanes last = lists.keys[v][length - 1];
        largest = select(last > largest, last, largest);
    }
    return maximum_of(largest);
}

template <std::size_t length>
static void find_nearest(const TreeView& tree, const QueryLeaf& query, NearestLists<length>& lists,
                         std::uint64_t* visits) {
    struct Pending {
        std::uint32_t node;
        double least;
    } stack[stack_size];
    std::size_t depth = 0, leaves = 0, in_block = 0;
    Lanes block[query_vectors][length];
    for (std::size_t v = 0; v < query_vectors; ++v) {
        for (std::size_t i = 0; i < length; ++i) lists.keys[v][i] = splat(far_away);
    }
    lists.complete_below = __builtin_inf();
    double bound = far_away;
    // Lists of unused query slots would keep the bound up: they ask for nothing.
    for (std::size_t i = query.used; i < leaf_size; ++i) {
        for (std::size_t rank = 0; rank < length; ++rank) {
            lists.keys[i / lane_count][rank][i % lane_count] = -1.0;
        }
    }
    stack[depth++] = {0, 0.0};
    while (depth > 0) {
        const Pending pending = stack[--depth];
        if (pending.least >= bound) continue;
        const TreeNode& node = tree.nodes[pending.node];
        if (leaves == max_candidate_leaves) {
            if (pending.least < lists.complete_below) lists.complete_below = pending.least;
            continue;
        }
        if (node.left != 0) {
            double left_least, right_least, unused;
            box_distances(tree, query.node, node.left, left_least, unused);
            box_distances(tree, query.node, node.right, right_least, unused);
            // The nearer one on top; the query's own side, where both touch it.
            const bool own_side_left = query.leaf < tree.nodes[node.left].last_leaf;
            const bool left_first =
                left_least != right_least ? left_least < right_least : own_side_left;
            if (left_first) {
                stack[depth++] = {node.right, right_least};
                stack[depth++] = {node.left, left_least};
            } else {
                stack[depth++] = {node.left, left_least};
                stack[depth++] = {node.right, right_least};
            }
            continue;
        }
        const std::uint32_t leaf = node.first_leaf;
        for (std::size_t other = 0; other < leaf_size; ++other) {
            const auto number = static_cast<std::int64_t>(leaves * leaf_size + other);
            for (std::size_t v = 0; v < query_vectors; ++v) {
                Lanes distance{};
                for (std::size_t c = 0; c < tree.dimension; ++c) {
                    const double x =
                        tree.coordinates[(leaf * tree.dimension + c) * leaf_size + other];
                    const Lanes difference =
                        load(tree.coordinates + (query.leaf * tree.dimension + c) * leaf_size +
                             v * lane_count) -
                        x;
                    distance += difference * difference;
                }
                // Unused slots are at infinity from others and, as NaN, from each other.
                distance = select(distance < far_away, distance, splat(far_away));
                block[v][in_block] =
                    detail::from_bits<Lanes>((detail::bits(distance) & ~number_bits) | number);
            }
            ++in_block;
        }
        *visits += query.used * leaf_size;
        lists.leaves[leaves++] = leaf;
        if (in_block == length) {
            for (std::size_t v = 0; v < query_vectors; ++v)
                merge_block<length>(lists.keys[v], block[v]);
            bound = furthest(lists);
            in_block = 0;
        }
    }
    if (in_block > 0) {
        for (std::size_t v = 0; v < query_vectors; ++v) {
            for (std::size_t i = in_block; i < length; ++i) block[v][i] = splat(far_away);
            merge_block<length>(lists.keys[v], block[v]);
        }
    }
}

/// The terms of one point under every posterior, walking outwards through its list.
template <std::size_t vectors, std::size_t length>
static void walk_outwards(const PosteriorGroup& group, const QueryLeaf& query, std::size_t i,
                          const NearestLists<length>& lists, const Lanes* wanted, double limit,
                          const NearestNeighborConstants& constants, double* scratch, Lanes* terms,
                          std::uint64_t* visits) {
    constexpr std::size_t columns = vectors * lane_count;
    const TreeView& tree = group.tree;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const std::size_t slot = query.first_slot + i;
    const double* own_weights = group.weights + slot * columns;
    Lanes mass[vectors] = {}, within[vectors] = {}, radius[vectors];
    for (std::size_t v = 0; v < vectors; ++v) {
        radius[v] =
            select(load(own_weights + v * lane_count) > 0.0, splat(__builtin_inf()), splat(-1.0));
    }
    for (std::size_t rank = 0; rank < length; ++rank) {
        const double key = lists.keys[i / lane_count][rank][i % lane_count];
        if (key >= limit) break;
        const auto number = static_cast<std::size_t>(detail::bits(key) & number_bits);
        const std::size_t leaf = lists.leaves[number / leaf_size], other = number % leaf_size;
        const std::size_t other_slot = leaf * leaf_size + other;
        if (other_slot == slot) continue;
        const double distance = detail::from_bits<double>(detail::bits(key) & ~number_bits);
        const double reached_radius =
            distance > resolution_squared ? distance * tie_tolerance : resolution_squared;
        IntLanes any{};
        for (std::size_t v = 0; v < vectors; ++v) {
            const Lanes weight = load(group.weights + other_slot * columns + v * lane_count);
            const IntLanes open = distance <= radius[v];
            any |= open;
            mass[v] += select(open, weight, Lanes{});
            within[v] += select(open & (weight > 0.0), splat(1.0), Lanes{});
            const IntLanes reached = (within[v] >= wanted[v]) & (radius[v] == __builtin_inf());
            radius[v] = select(reached, splat(reached_radius), radius[v]);
        }
        if (bits_of(any) == 0) break;
    }
    for (std::size_t v = 0; v < vectors; ++v) {
        const Lanes weight = load(own_weights + v * lane_count);
        const Lanes log_mass = log_of(mass[v] / (1.0 - weight));
        const Lanes log_radius = 0.5 * log_of(radius[v]);
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            if (!(weight[lane] > 0.0)) continue;
            const std::size_t column = v * lane_count + lane;
            if (!(radius[v][lane] < limit)) {
                terms[v][lane] +=
                    searched_term(group, query.points[i], slot, column, constants, scratch, visits);
                continue;
            }
            const std::uint32_t q = radius[v][lane] > resolution_squared
                                        ? group.neighbors[column]
                                        : static_cast<std::uint32_t>(within[v][lane]);
            terms[v][lane] +=
                weight[lane] * (constants.log_ball_volume +
                                static_cast<double>(tree.dimension) * log_radius[lane] -
                                log_mass[lane] + constants.bias_correction[q]);
        }
    }
}

/// The terms of a leaf's points under a single posterior: eight points side by side instead of
/// eight posteriors. Adds what the lists settle to `sum`, and tells by bits which points they do
/// not.
template <std::size_t length>
static unsigned walk_single(const PosteriorGroup& group, const QueryLeaf& query, std::size_t v,
                            const NearestLists<length>& lists,
                            const NearestNeighborConstants& constants, double& sum) {
    const TreeView& tree = group.tree;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const std::uint32_t neighbors = group.neighbors[0];
    const Lanes last =
        detail::from_bits<Lanes>(detail::bits(lists.keys[v][length - 1]) & ~number_bits);
    const Lanes limit = select(last < lists.complete_below, last, splat(lists.complete_below));
    Lanes mass{}, within{}, radius = splat(__builtin_inf());
    for (std::size_t rank = 0; rank < length; ++rank) {
        const Lanes key = lists.keys[v][rank];
        const IntLanes known = key < limit;
        const Lanes distance = detail::from_bits<Lanes>(detail::bits(key) & ~number_bits);
        Lanes weight{};
        const unsigned bits = bits_of(known);
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            if ((bits >> lane & 1) == 0) continue;
            const auto number = static_cast<std::size_t>(detail::bits(key[lane]) & number_bits);
            // The own leaf is the first one visited, so a point's own number is its place in it.
            if (number == v * lane_count + lane) continue;
            const std::size_t other =
                lists.leaves[number / leaf_size] * leaf_size + number % leaf_size;
            weight[lane] = group.weights[other * lane_count];
        }
        const IntLanes open = (distance <= radius) & (weight > 0.0);
        if (bits_of(open) == 0 && rank > 0) {
            if (bits_of(radius == __builtin_inf()) == 0) break;
        }
        mass += select(open, weight, Lanes{});
        within += select(open, splat(1.0), Lanes{});
        const IntLanes reached =
            (within >= static_cast<double>(neighbors)) & (radius == __builtin_inf());
        const Lanes wide = select(distance > resolution_squared, distance * tie_tolerance,
                                  splat(resolution_squared));
        radius = select(reached, wide, radius);
    }
    Lanes weight{};
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        weight[lane] = group.weights[(query.first_slot + v * lane_count + lane) * lane_count];
    }
    const unsigned settled = bits_of((radius < limit) & (weight > 0.0));
    const Lanes spread = 0.5 * static_cast<double>(tree.dimension) * log_of(radius) -
                         log_of(mass / (1.0 - weight)) + constants.log_ball_volume;
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        if ((settled >> lane & 1) == 0) continue;
        const std::uint32_t q = radius[lane] > resolution_squared
                                    ? neighbors
                                    : static_cast<std::uint32_t>(within[lane]);
        sum += weight[lane] * (spread[lane] + constants.bias_correction[q]);
    }
    return bits_of(weight > 0.0) & ~settled;
}

/// The terms of one point under every posterior from its ball's sums.
template <std::size_t vectors>
static void ball_terms(const PosteriorGroup& group, const QueryLeaf& query, std::size_t i,
                       const Row<vectors>& row, const NearestNeighborConstants& constants,
                       double* scratch, Lanes* terms, std::uint64_t* visits) {
    const std::size_t slot = query.first_slot + i;
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
                count >= group.neighbors[column]
                    ? weight[lane] * (log_ball - log_mass[lane] + constants.bias_correction[count])
                    : searched_term(group, query.points[i], slot, column, constants, scratch,
                                    visits);
        }
    }
}

/// Three ways to the same terms. Where the points are denser than the resolution, sums over balls;
/// where they are not, sorted lists of the nearest points, made once for all posteriors; and for
/// what neither settles (few of the near points have weight), a search for one posterior.
template <std::size_t vectors, std::size_t length>
static void group_nearest_rows(const PosteriorGroup& group, const QueryLeaf& query,
                               const NearestNeighborConstants& constants, double* scratch,
                               double* out, std::uint64_t* visits) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    double unused, diameter_squared;
    box_distances(group.tree, query.node, query.node, unused, diameter_squared);
    const bool dense = diameter_squared <= resolution_squared;
    bool summed = false;
    Row<vectors> rows[leaf_size];
    NearestLists<length> lists;
    Lanes wanted[vectors];  // the k of each column
    if (!dense) {
        find_nearest(group.tree, query, lists, visits);
        for (std::size_t v = 0; v < vectors; ++v) {
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                wanted[v][lane] = group.neighbors[v * lane_count + lane];
            }
        }
    }
    Lanes terms[vectors];
    for (std::size_t v = 0; v < vectors; ++v) terms[v] = load(out + v * lane_count);
    unsigned open = (1u << query.used) - 1;
    const bool single = group.members == 1;
    if (single && !dense) {
        double sum = 0.0;
        open = 0;
        for (std::size_t v = 0; v < query_vectors; ++v) {
            open |= walk_single<length>(group, query, v, lists, constants, sum) << (v * lane_count);
        }
        terms[0][0] += sum;
    }
    for (std::size_t i = 0; i < query.used; ++i) {
        if ((open >> i & 1) == 0) continue;
        if (!dense && !single) {
            // Without its number, so that no point as far as the last one is taken for nearer.
            const double last = detail::from_bits<double>(
                detail::bits(lists.keys[i / lane_count][length - 1][i % lane_count]) &
                ~number_bits);
            const double limit = last < lists.complete_below ? last : lists.complete_below;
            if (limit > resolution_squared) {
                walk_outwards<vectors, length>(group, query, i, lists, wanted, limit, constants,
                                               scratch, terms, visits);
                continue;
            }
        }
        if (!summed) {
            sum_balls<vectors>(group, query, resolution_squared, rows, visits);
            summed = true;
        }
        ball_terms<vectors>(group, query, i, rows[i], constants, scratch, terms, visits);
    }
    for (std::size_t v = 0; v < vectors; ++v) store(out + v * lane_count, terms[v]);
}

template <std::size_t vectors>
static void group_mixture_rows(const PosteriorGroup& group, std::size_t leaf, double exponent,
                               double* out, std::uint64_t* visits) {
    constexpr std::size_t columns = vectors * lane_count;
    // exp(-60) = 9e-27: beyond it a component is lost in the rounding of the point's own.
    const double reach_squared = 60.0 / exponent;
    const TreeView& tree = group.tree;
    QueryLeaf query;
    open_leaf(tree, leaf, query);
    Lanes totals[leaf_size][vectors] = {};
    std::uint32_t stack[stack_size];
    std::size_t depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
        const std::uint32_t at = stack[--depth];
        double least, greatest;
        box_distances(tree, query.node, at, least, greatest);
        if (least > reach_squared) continue;
        const TreeNode& node = tree.nodes[at];
        if (node.left != 0) {
            stack[depth++] = node.right;
            stack[depth++] = node.left;
            continue;
        }
        *visits += query.used * leaf_size;
        for (std::size_t i = 0; i < query.used; ++i) {
            Lanes total[vectors];
            for (std::size_t v = 0; v < vectors; ++v) total[v] = totals[i][v];
            for (std::size_t block = 0; block < leaf_size / lane_count; ++block) {
                double kernel[lane_count];
                store(kernel, exp_of(-exponent * leaf_distances(tree, query.points[i],
                                                                node.first_leaf, block)));
                const double* weights =
                    group.weights + (node.first_leaf * leaf_size + block * lane_count) * columns;
                for (std::size_t lane = 0; lane < lane_count; ++lane) {
                    for (std::size_t v = 0; v < vectors; ++v) {
                        total[v] += kernel[lane] * load(weights + lane * columns + v * lane_count);
                    }
                }
            }
            for (std::size_t v = 0; v < vectors; ++v) totals[i][v] = total[v];
        }
    }
    for (std::size_t i = 0; i < query.used; ++i) {
        for (std::size_t v = 0; v < vectors; ++v) {
            const Lanes weight =
                load(group.weights + (query.first_slot + i) * columns + v * lane_count);
            const Lanes term = select(weight > 0.0, weight * log_of(totals[i][v]), Lanes{});
            store(out + v * lane_count, load(out + v * lane_count) - term);
        }
    }
}

template <std::size_t vectors>
static void group_nearest_leaf(const PosteriorGroup& group, std::size_t leaf,
                               const NearestNeighborConstants& constants, double* scratch,
                               double* out, std::uint64_t* visits) {
    QueryLeaf query;
    open_leaf(group.tree, leaf, query);
    std::uint32_t most = 0;
    for (std::size_t m = 0; m < group.members; ++m) {
        if (group.neighbors[m] > most) most = group.neighbors[m];
    }
    // A list must reach k points of non-zero weight: all points have it where one posterior has a
    // tree of its own, and perhaps one in four where posteriors with different points share one.
    if (group.members == 1 && most <= 8) {
        group_nearest_rows<vectors, 16>(group, query, constants, scratch, out, visits);
    } else if (most <= 8) {
        group_nearest_rows<vectors, 32>(group, query, constants, scratch, out, visits);
    } else {
        group_nearest_rows<vectors, 64>(group, query, constants, scratch, out, visits);
    }
}

static void group_nearest(const PosteriorGroup& group, std::size_t leaf,
                          const NearestNeighborConstants& constants, double* scratch, double* out,
                          std::uint64_t* visits) {
    switch (group.vectors) {
        case 1:
            return group_nearest_leaf<1>(group, leaf, constants, scratch, out, visits);
        case 2:
            return group_nearest_leaf<2>(group, leaf, constants, scratch, out, visits);
        case 3:
            return group_nearest_leaf<3>(group, leaf, constants, scratch, out, visits);
        default:
            return group_nearest_leaf<4>(group, leaf, constants, scratch, out, visits);
    }
}

static void group_mixture(const PosteriorGroup& group, std::size_t leaf, double exponent,
                          double* out, std::uint64_t* visits) {
    switch (group.vectors) {
        case 1:
            return group_mixture_rows<1>(group, leaf, exponent, out, visits);
        case 2:
            return group_mixture_rows<2>(group, leaf, exponent, out, visits);
        case 3:
            return group_mixture_rows<3>(group, leaf, exponent, out, visits);
        default:
            return group_mixture_rows<4>(group, leaf, exponent, out, visits);
    }
}

}  // namespace holdfast::HOLDFAST_ISA
