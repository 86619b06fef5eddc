// Sorted lists of the nearest points, made once for all posteriors (one compilation per instruction
// set).
//
// For points that are sparser than the resolution. From its list each point walks outwards until
// every posterior has found its k-th neighbour.

#pragma once

#include "sorting_network.hpp"
#include "tree_search.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// The nearest points of sixteen query points, sorted: keys[v][rank] has those of eight of them.
///
/// A key is a squared distance whose ten low bits are replaced by the number of the candidate, so
/// that numbers travel with distances through the sorting. The distance that is left is right
/// to 2.3e-13 of its size, a quarter of what counts as a tie anyway.
inline constexpr std::int64_t number_bits = 1023;
inline constexpr std::size_t max_candidates = number_bits + 1;
/// Renumbering must make room for so many, or it would be done for each leaf.
inline constexpr std::size_t worth_renumbering = 8 * leaf_size;
inline constexpr double far_away = 1e300;

template <std::size_t length>
struct NearestLists {
    Lanes keys[query_vectors][length];
    std::uint32_t slots[max_candidates];  // of each number
    std::size_t candidates;               // numbers in use
    double complete_below;                // no point nearer than this was left out
};

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

/// Takes the numbers of candidates that are in no list any more for others to come.
///
/// Candidates keep their order, and the query leaf's own points, which came first, their numbers.
template <std::size_t length>
static void renumber(NearestLists<length>& lists) {
    std::uint16_t number_of[max_candidates] = {};
    const double nobody = detail::from_bits<double>(detail::bits(far_away) & ~number_bits);
    for (std::size_t number = 0; number < leaf_size; ++number) number_of[number] = 1;
    for (std::size_t v = 0; v < query_vectors; ++v) {
        for (std::size_t rank = 0; rank < length; ++rank) {
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                const double key = lists.keys[v][rank][lane];
                if (key < nobody) number_of[detail::bits(key) & number_bits] = 1;
            }
        }
    }
    std::size_t kept = 0;
    for (std::size_t number = 0; number < lists.candidates; ++number) {
        if (number_of[number] == 0) continue;
        lists.slots[kept] = lists.slots[number];
        number_of[number] = static_cast<std::uint16_t>(kept++);
    }
    lists.candidates = kept;
    for (std::size_t v = 0; v < query_vectors; ++v) {
        for (std::size_t rank = 0; rank < length; ++rank) {
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                const double key = lists.keys[v][rank][lane];
                if (!(key < nobody)) continue;
                const std::int64_t number = number_of[detail::bits(key) & number_bits];
                lists.keys[v][rank][lane] =
                    detail::from_bits<double>((detail::bits(key) & ~number_bits) | number);
            }
        }
    }
}

/// Whether a list may have room for a point of a node.
template <std::size_t length>
HOLDFAST_INLINE bool reaches(const TreeView& tree, const QueryLeaf& query,
                             const NearestLists<length>& lists, std::size_t node) {
    unsigned near = 0;
    for (std::size_t v = 0; v < query_vectors; ++v) {
        const PointDistances to_box = point_distances(tree, query.coordinates, v, node);
        near |= bits_of(to_box.least < lists.keys[v][length - 1]);
    }
    return near != 0;
}

/// Fills the lists, or returns false once all of them reach no further than to `enough`.
template <std::size_t length>
static bool find_nearest(const TreeView& tree, const QueryLeaf& query, NearestLists<length>& lists,
                         std::uint64_t* visits, double enough = -1.0, bool sampled = false) {
    struct Pending {
        std::uint32_t node;
        double least;
    } stack[stack_size];
    std::size_t depth = 0, in_block = 0;
    Lanes block[query_vectors][length];
    for (std::size_t v = 0; v < query_vectors; ++v) {
        for (std::size_t i = 0; i < length; ++i) lists.keys[v][i] = splat(far_away);
    }
    lists.candidates = 0;
    lists.complete_below = __builtin_inf();
    bool full = false;
    double bound = far_away;
    // Lists of unused query slots would keep the bound up: they ask for nothing.
    for (std::size_t i = query.used; i < leaf_size; ++i) {
        for (std::size_t rank = 0; rank < length; ++rank) {
            lists.keys[i / lane_count][rank][i % lane_count] = -1.0;
        }
    }
    // Takes what is in the block, whole or not, into the lists.
    const auto merge = [&] {
        for (std::size_t v = 0; v < query_vectors; ++v) {
            for (std::size_t i = in_block; i < length; ++i) block[v][i] = splat(far_away);
            merge_block<length>(lists.keys[v], block[v]);
        }
        in_block = 0;
    };
    stack[depth++] = {0, 0.0};
    while (depth > 0) {
        const Pending pending = stack[--depth];
        if (pending.least >= bound) continue;
        // The points of a sample are far apart: what is near to their box may be near to none.
        if (sampled && !reaches(tree, query, lists, pending.node)) continue;
        const TreeNode& node = tree.nodes[pending.node];
        if (!full && lists.candidates + leaf_size > max_candidates) {
            if (in_block > 0) merge();
            bound = furthest(lists);
            renumber<length>(lists);
            full = lists.candidates + worth_renumbering > max_candidates;
        }
        if (full) {
            if (pending.least < lists.complete_below) lists.complete_below = pending.least;
            continue;
        }
        if (node.left != 0) {
            double left_least, right_least, unused;
            box_distances(tree, query, node.left, left_least, unused);
            box_distances(tree, query, node.right, right_least, unused);
            // The nearer one on top; the query's own side, where both touch it.
            const bool own_side_left = query.slots[0] / leaf_size < tree.nodes[node.left].last_leaf;
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
            const auto number = static_cast<std::int64_t>(lists.candidates);
            lists.slots[lists.candidates++] = static_cast<std::uint32_t>(leaf * leaf_size + other);
            for (std::size_t v = 0; v < query_vectors; ++v) {
                Lanes distance{};
                for (std::size_t c = 0; c < tree.dimension; ++c) {
                    const double x =
                        tree.coordinates[(leaf * tree.dimension + c) * leaf_size + other];
                    const Lanes difference =
                        load(query.coordinates + c * leaf_size + v * lane_count) - x;
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
        if (in_block == length) {
            merge();
            bound = furthest(lists);
            if (bound <= enough) return false;
        }
    }
    if (in_block > 0) merge();
    return true;
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
    const std::size_t slot = query.slots[i];
    const double factor = query.factors[i];
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
        const std::size_t other_slot = lists.slots[number];
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
                terms[v][lane] += factor * searched_term(group, query.points[i], slot, column,
                                                         constants, scratch, visits);
                continue;
            }
            const std::uint32_t q = radius[v][lane] > resolution_squared
                                        ? group.neighbors[column]
                                        : static_cast<std::uint32_t>(within[v][lane]);
            terms[v][lane] +=
                factor * (weight[lane] * (constants.log_ball_volume +
                                          static_cast<double>(tree.dimension) * log_radius[lane] -
                                          log_mass[lane] + constants.bias_correction[q]));
        }
    }
}

/// The terms of eight points under a single posterior, side by side instead of eight posteriors.
/// Adds what their sorted lists settle to `sum`, times the points' factors, and tells by bits which
/// points they do not. `weight_of` a number is zero for the point of a lane itself.
template <std::size_t length, class WeightOf>
HOLDFAST_INLINE unsigned walk_single(const Lanes* keys, double complete_below,
                                     const WeightOf& weight_of, const Lanes& own_weight,
                                     const Lanes& factors, std::uint32_t neighbors,
                                     std::size_t dimension,
                                     const NearestNeighborConstants& constants, double& sum) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const Lanes last = detail::from_bits<Lanes>(detail::bits(keys[length - 1]) & ~number_bits);
    const Lanes limit = select(last < complete_below, last, splat(complete_below));
    Lanes mass{}, within{}, radius = splat(__builtin_inf());
    for (std::size_t rank = 0; rank < length; ++rank) {
        const Lanes key = keys[rank];
        const IntLanes known = key < limit;
        const Lanes distance = detail::from_bits<Lanes>(detail::bits(key) & ~number_bits);
        if (bits_of(known & (distance <= radius)) == 0) break;
        Lanes weight{};
        const unsigned bits = bits_of(known);
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            if ((bits >> lane & 1) == 0) continue;
            const auto number = static_cast<std::size_t>(detail::bits(key[lane]) & number_bits);
            weight[lane] = weight_of(number, lane);
        }
        const IntLanes open = (distance <= radius) & (weight > 0.0);
        mass += select(open, weight, Lanes{});
        within += select(open, splat(1.0), Lanes{});
        const IntLanes reached =
            (within >= static_cast<double>(neighbors)) & (radius == __builtin_inf());
        const Lanes wide = select(distance > resolution_squared, distance * tie_tolerance,
                                  splat(resolution_squared));
        radius = select(reached, wide, radius);
    }
    const unsigned settled = bits_of((radius < limit) & (own_weight > 0.0));
    const Lanes spread = 0.5 * static_cast<double>(dimension) * log_of(radius) -
                         log_of(mass / (1.0 - own_weight)) + constants.log_ball_volume;
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        if ((settled >> lane & 1) == 0) continue;
        const std::uint32_t q = radius[lane] > resolution_squared
                                    ? neighbors
                                    : static_cast<std::uint32_t>(within[lane]);
        sum += factors[lane] * (own_weight[lane] * (spread[lane] + constants.bias_correction[q]));
    }
    return bits_of(own_weight > 0.0) & ~settled;
}

/// Of eight points of a leaf.
template <std::size_t length>
static unsigned walk_single(const PosteriorGroup& group, const QueryLeaf& query, std::size_t v,
                            const NearestLists<length>& lists,
                            const NearestNeighborConstants& constants, double& sum) {
    Lanes weight{}, factors{};
    for (std::size_t lane = 0; lane < lane_count && v * lane_count + lane < query.used; ++lane) {
        weight[lane] = group.weights[query.slots[v * lane_count + lane] * lane_count];
        factors[lane] = query.factors[v * lane_count + lane];
    }
    const auto weight_of = [&](std::size_t number, std::size_t lane) HOLDFAST_LAMBDA {
        const std::uint32_t slot = lists.slots[number];
        return slot == query.slots[v * lane_count + lane] ? 0.0 : group.weights[slot * lane_count];
    };
    return walk_single<length>(lists.keys[v], lists.complete_below, weight_of, weight, factors,
                               group.neighbors[0], group.tree.dimension, constants, sum);
}

}  // namespace holdfast::inline HOLDFAST_ISA
