// Sums over balls of the resolution around the points of several leaves at once (one compilation
// per instruction set).
//
// The same sums as in ball_sums.hpp, for so many points that most of the time goes into leaves
// which the surface of a ball cuts. Which of such a leaf's 16 points lie within a ball is 16 bits.
// The sums over all subsets of four points are tabulated (the "method of four Russians": Arlazarov,
// Dinic, Kronrod and Faradzev, 1970), so that four rows are added for each ball instead of up to
// sixteen. The table of a leaf is made once for all balls of a block, and lies in the first cache.

#pragma once

#include "ball_sums.hpp"

namespace holdfast::inline HOLDFAST_ISA {

inline constexpr std::size_t subset_points = 4;
inline constexpr std::size_t subsets = 1u << subset_points;
inline constexpr std::size_t parts_of_leaf = leaf_size / subset_points;
inline constexpr std::size_t block_points = block_leaves * leaf_size;
inline constexpr std::size_t block_vectors = block_leaves / lane_count;
/// Leaves that wait until they are added together: their rows arrive from memory meanwhile, and the
/// sums of one vector of posteriors stay in the first cache.
inline constexpr std::size_t waiting_leaves = 16;

/// Numbers of points under each of 32 posteriors.
struct ShortCounts {
    using Register = std::uint16_t __attribute__((vector_size(register_bytes)));
    Register part[registers];

    HOLDFAST_INLINE ShortCounts operator+(const ShortCounts& other) const {
        ShortCounts sum;
        for (std::size_t r = 0; r < registers; ++r) sum.part[r] = part[r] + other.part[r];
        return sum;
    }
    HOLDFAST_INLINE std::uint16_t& operator[](std::size_t i) {
        return reinterpret_cast<std::uint16_t*>(part)[i];
    }
};

static_assert(sizeof(ShortCounts) == max_group_lanes * sizeof(std::uint16_t));

/// Leaves that short counts have room for.
inline constexpr std::size_t leaves_counted = 65535 / leaf_size;

/// Which points of a leaf lie within the ball around a point of the block.
struct Cut {
    std::uint16_t point, subset;
};

/// sums[part][subset]: over the points of the subset, of the rows of a leaf that `row` returns.
template <class T, class Source>
HOLDFAST_INLINE void tabulate(T (&sums)[parts_of_leaf][subsets], const Source& row) {
    for (std::size_t part = 0; part < parts_of_leaf; ++part) {
        sums[part][0] = T{};
        for (std::size_t point = 0; point < subset_points; ++point) {
            const T own = row(part * subset_points + point);
            const std::size_t number = std::size_t{1} << point;
            for (std::size_t rest = 0; rest < number; ++rest) {
                sums[part][number + rest] = sums[part][rest] + own;
            }
        }
    }
}

template <class T>
HOLDFAST_INLINE void add_subsets(const T (&sums)[parts_of_leaf][subsets], const Cut* begin,
                                 const Cut* end, T* to) {
    constexpr unsigned low = subsets - 1;
    for (const Cut* cut = begin; cut != end; ++cut) {
        const unsigned subset = cut->subset;
        to[cut->point] =
            to[cut->point] + ((sums[0][subset & low] + sums[1][subset >> subset_points & low]) +
                              (sums[2][subset >> (2 * subset_points) & low] +
                               sums[3][subset >> (3 * subset_points)]));
    }
}

template <class T>
HOLDFAST_INLINE void add_whole(const T (&sums)[parts_of_leaf][subsets], const std::uint16_t* begin,
                               const std::uint16_t* end, T* to) {
    constexpr unsigned all = subsets - 1;
    const T whole = (sums[0][all] + sums[1][all]) + (sums[2][all] + sums[3][all]);
    for (const std::uint16_t* point = begin; point != end; ++point) to[*point] = to[*point] + whole;
}

/// Weights and numbers of the points within the balls around the points of a block of leaves.
template <std::size_t vectors>
struct BlockSums {
    static constexpr std::size_t columns = vectors * lane_count;
    Lanes mass[vectors][block_points];
    CountLanes within[block_points][vectors];
    ShortCounts recent[block_points];  // not yet in `within`
    std::size_t recent_leaves;
    Row<vectors> shared[block_leaves];  // of nodes within the balls around all points of a leaf
    Cut cuts[waiting_leaves * block_points];
    std::uint16_t around[waiting_leaves * block_points];  // points whose balls hold the whole leaf
    std::size_t waiting, first_cut[waiting_leaves + 1], first_around[waiting_leaves + 1];
    std::uint32_t waiting_leaf[waiting_leaves];

    void clear() {
        waiting = recent_leaves = first_cut[0] = first_around[0] = 0;
        for (std::size_t i = 0; i < block_points; ++i) {
            recent[i] = ShortCounts{};
            for (std::size_t v = 0; v < vectors; ++v) {
                mass[v][i] = Lanes{};
                within[i][v] = CountLanes{};
            }
        }
        for (std::size_t place = 0; place < block_leaves; ++place) shared[place] = Row<vectors>{};
    }

    /// Adds what the waiting leaves have within the balls.
    void add_waiting(const PosteriorGroup& group) {
        std::uint32_t significant[waiting_leaves][leaf_size] = {};  // a bit for each posterior
        for (std::size_t v = 0; v < vectors; ++v) {
            for (std::size_t i = 0; i < waiting; ++i) {
                const double* rows = group.weights + waiting_leaf[i] * leaf_size * columns;
                Lanes table[parts_of_leaf][subsets];
                tabulate(table, [&](std::size_t slot) HOLDFAST_LAMBDA {
                    const Lanes row = load(rows + slot * columns + v * lane_count);
                    significant[i][slot] |= bits_of(row > 0.0) << (v * lane_count);
                    return row;
                });
                add_subsets(table, cuts + first_cut[i], cuts + first_cut[i + 1], mass[v]);
                add_whole(table, around + first_around[i], around + first_around[i + 1], mass[v]);
            }
        }
        for (std::size_t i = 0; i < waiting; ++i) {
            ShortCounts table[parts_of_leaf][subsets];
            tabulate(table, [&](std::size_t slot) HOLDFAST_LAMBDA {
                const std::uint32_t bits = significant[i][slot];
                ShortCounts row;
                for (std::size_t column = 0; column < max_group_lanes; ++column) {
                    row[column] = static_cast<std::uint16_t>(bits >> column & 1);
                }
                return row;
            });
            add_subsets(table, cuts + first_cut[i], cuts + first_cut[i + 1], recent);
            add_whole(table, around + first_around[i], around + first_around[i + 1], recent);
        }
        recent_leaves += waiting;
        waiting = 0;
        if (recent_leaves + waiting_leaves > leaves_counted) take_recent();
    }

    void take_recent() {
        recent_leaves = 0;
        for (std::size_t i = 0; i < block_points; ++i) {
            for (std::size_t column = 0; column < columns; ++column) {
                reinterpret_cast<std::uint32_t*>(within[i])[column] += recent[i][column];
            }
            recent[i] = ShortCounts{};
        }
    }

    /// All sums of a point of the block.
    Row<vectors> row(std::size_t point) const {
        Row<vectors> result = shared[point / leaf_size];
        for (std::size_t v = 0; v < vectors; ++v) {
            result.mass[v] = mass[v][point] + result.mass[v];
            result.within[v] += within[point][v];
        }
        return result;
    }
};

/// Leaves with points whose balls are summed.
struct BlockQueries {
    QueryLeaf leaves[block_leaves];
    unsigned open[block_leaves] = {};  // bits: these points
};

/// Appends which points of leaf `at` of the tree lie within the balls around the open points of a
/// leaf of the block.
static void cut_leaf(const TreeView& tree, const BlockQueries& queries, std::size_t place,
                     std::uint32_t at, double radius_squared, Cut*& cut, std::uint16_t*& around,
                     std::uint64_t* visits) {
    const double* const own_leaf = queries.leaves[place].coordinates;
    unsigned inside = 0, reached = 0;
    for (std::size_t v = 0; v < query_vectors; ++v) {
        const PointDistances to_box = point_distances(tree, own_leaf, v, at);
        inside |= bits_of(to_box.greatest <= radius_squared) << (v * lane_count);
        reached |= bits_of(to_box.least <= radius_squared) << (v * lane_count);
    }
    const std::size_t first_point = place * leaf_size, size = tree.dimension * leaf_size;
    const double* points = tree.coordinates + tree.nodes[at].first_leaf * size;
    for (unsigned left = inside & queries.open[place]; left != 0; left &= left - 1) {
        *around++ =
            static_cast<std::uint16_t>(first_point + static_cast<std::size_t>(__builtin_ctz(left)));
        ++*visits;
    }
    for (reached &= queries.open[place] & ~inside; reached != 0; reached &= reached - 1) {
        const auto i = static_cast<std::size_t>(__builtin_ctz(reached));
        Lanes distance[query_vectors] = {};
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            const double* x = points + c * leaf_size;
            const double own = own_leaf[c * leaf_size + i];
            for (std::size_t v = 0; v < query_vectors; ++v) {
                const Lanes difference = load(x + v * lane_count) - own;
                distance[v] += difference * difference;
            }
        }
        unsigned subset = 0;
        for (std::size_t v = 0; v < query_vectors; ++v) {
            subset |= bits_of(distance[v] <= radius_squared) << (v * lane_count);
        }
        *cut = {static_cast<std::uint16_t>(first_point + i), static_cast<std::uint16_t>(subset)};
        cut += subset != 0 ? 1 : 0;
        *visits += leaf_size;
    }
}

/// Weights and numbers of all points (an open point itself, too) within the resolution.
template <std::size_t vectors>
static void sum_block(const PosteriorGroup& group, const BlockQueries& queries,
                      double radius_squared, BlockSums<vectors>& sums, std::uint64_t* visits) {
    constexpr std::size_t columns = vectors * lane_count;
    const TreeView& tree = group.tree;
    sums.clear();
    Lanes low[max_dimension][block_vectors] = {}, high[max_dimension][block_vectors] = {};
    unsigned all = 0;
    for (std::size_t place = 0; place < block_leaves; ++place) {
        if (queries.open[place] == 0) continue;
        all |= 1u << place;
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            low[c][place / lane_count][place % lane_count] = queries.leaves[place].low[c];
            high[c][place / lane_count][place % lane_count] = queries.leaves[place].high[c];
        }
    }
    struct Pending {
        std::uint32_t node;
        unsigned open;  // leaves of the block with balls that the node may cut
    } stack[stack_size];
    std::size_t depth = 0;
    if (all != 0) stack[depth++] = {0, all};
    while (depth > 0) {
        const auto [at, open_above] = stack[--depth];
        unsigned open = 0, contained = 0;
        for (std::size_t v = 0; v < block_vectors; ++v) {
            Lanes least{}, greatest{};
            for (std::size_t c = 0; c < tree.dimension; ++c) {
                const double node_low = tree.low[at * tree.dimension + c],
                             node_high = tree.high[at * tree.dimension + c];
                const Lanes gap_1 = node_low - high[c][v], gap_2 = low[c][v] - node_high;
                Lanes gap = select(gap_1 > gap_2, gap_1, gap_2);
                gap = select(gap > 0.0, gap, Lanes{});
                const Lanes span_1 = node_high - low[c][v], span_2 = high[c][v] - node_low;
                const Lanes span = select(span_1 > span_2, span_1, span_2);
                least += gap * gap;
                greatest += span * span;
            }
            open |= bits_of(least <= radius_squared) << (v * lane_count);
            contained |= bits_of(greatest <= radius_squared) << (v * lane_count);
        }
        open &= open_above;
        for (unsigned left = open & contained; left != 0; left &= left - 1) {
            sums.shared[__builtin_ctz(left)].add(group.node_weights + at * columns,
                                                 group.node_counts + at * columns);
            ++*visits;
        }
        open &= ~contained;
        if (open == 0) continue;
        const TreeNode& node = tree.nodes[at];
        if (node.left != 0) {
            stack[depth++] = {node.right, open};
            stack[depth++] = {node.left, open};
            continue;
        }
        const std::size_t number = sums.waiting++;
        Cut* cut = sums.cuts + sums.first_cut[number];
        std::uint16_t* around = sums.around + sums.first_around[number];
        for (std::size_t line = 0; line < leaf_size * vectors; ++line) {
            __builtin_prefetch(group.weights + node.first_leaf * leaf_size * columns +
                               line * lane_count);
        }
        for (; open != 0; open &= open - 1) {
            cut_leaf(tree, queries, static_cast<std::size_t>(__builtin_ctz(open)), at,
                     radius_squared, cut, around, visits);
        }
        sums.waiting_leaf[number] = node.first_leaf;
        sums.first_cut[number + 1] = static_cast<std::size_t>(cut - sums.cuts);
        sums.first_around[number + 1] = static_cast<std::size_t>(around - sums.around);
        if (sums.waiting == waiting_leaves) sums.add_waiting(group);
    }
    sums.add_waiting(group);
    sums.take_recent();
}

}  // namespace holdfast::inline HOLDFAST_ISA
