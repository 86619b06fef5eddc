// The entropy of one posterior with few points, as over a tree of its own (one compilation per
// instruction set).
//
// Eight points stand beside each other, with their distances to all points. What is added, and in
// which order, is as in group_entropy.hpp, to the bit: lists of the sixteen nearest points, and
// sums over balls where these do not reach. Distances to all of so few points take less time than
// the search for those that count.

#pragma once

#include "nearest_lists.hpp"

namespace holdfast::inline HOLDFAST_ISA {

inline constexpr std::size_t few_leaves = few_points / leaf_size;
inline constexpr std::size_t few_list = 16;

/// A node of PointTree, with the sum of its weights.
struct FewNode {
    std::size_t first_leaf, last_leaf, left, right;  // left is 0 in a leaf
    double weight;
    double low[max_dimension], high[max_dimension];
};

struct FewPoints {
    const CompactPosterior* posterior;
    std::size_t leaves;
    std::size_t nodes = 0;
    FewNode node[2 * few_leaves];
    std::size_t leaf_node[few_leaves];
    double block_weights[few_points / lane_count];
};

/// Makes the node of some leaves and those below it; returns its number.
static std::size_t add_node(FewPoints& few, std::size_t first_leaf, std::size_t last_leaf) {
    const CompactPosterior& posterior = *few.posterior;
    const std::size_t number = few.nodes++, dimension = posterior.dimension;
    FewNode& own = few.node[number];
    own.first_leaf = first_leaf;
    own.last_leaf = last_leaf;
    own.left = own.right = 0;
    if (last_leaf - first_leaf > 1) {
        const std::size_t middle = first_leaf + (last_leaf - first_leaf) / 2;
        own.left = add_node(few, first_leaf, middle);
        own.right = add_node(few, middle, last_leaf);
        const FewNode &left = few.node[own.left], &right = few.node[own.right];
        own.weight = left.weight + right.weight;
        for (std::size_t c = 0; c < dimension; ++c) {
            own.low[c] = left.low[c] < right.low[c] ? left.low[c] : right.low[c];
            own.high[c] = left.high[c] > right.high[c] ? left.high[c] : right.high[c];
        }
        return number;
    }
    few.leaf_node[first_leaf] = number;
    const std::size_t begin = first_leaf * leaf_size;
    const std::size_t left = posterior.count - begin;
    const std::size_t used = left < leaf_size ? left : leaf_size;
    for (std::size_t c = 0; c < dimension; ++c) {
        const double* x = posterior.coordinates + c * posterior.stride + begin;
        double low = x[0], high = x[0];
        for (std::size_t i = 1; i < used; ++i) {
            low = x[i] < low ? x[i] : low;
            high = x[i] > high ? x[i] : high;
        }
        own.low[c] = low;
        own.high[c] = high;
    }
    own.weight = 0.0;
    for (std::size_t block = begin; block < begin + leaf_size; block += lane_count) {
        double sum = 0.0;
        for (std::size_t i = block; i < block + lane_count; ++i) sum += posterior.weights[i];
        few.block_weights[block / lane_count] = sum;
        own.weight += sum;
    }
    return number;
}

/// As box_distances of a tree's nodes.
HOLDFAST_INLINE void box_distances(const FewPoints& few, std::size_t a, std::size_t b,
                                   double& least, double& greatest) {
    const FewNode &own = few.node[a], &other = few.node[b];
    box_distances(few.posterior->dimension, own.low, own.high, other.low, other.high, least,
                  greatest);
}

/// A leaf, and the least distance to its box.
struct Visited {
    std::size_t leaf;
    double least;
};

/// Appends the leaves below a node as find_nearest visits them.
static void visiting_order(const FewPoints& few, std::size_t query_leaf, std::size_t at,
                           double least, Visited* order, std::size_t& number) {
    const FewNode& own = few.node[at];
    if (own.left == 0) {
        order[number++] = {own.first_leaf, least};
        return;
    }
    const std::size_t query = few.leaf_node[query_leaf];
    double left_least, right_least, unused;
    box_distances(few, query, own.left, left_least, unused);
    box_distances(few, query, own.right, right_least, unused);
    const bool left_first = left_least != right_least ? left_least < right_least
                                                      : query_leaf < few.node[own.left].last_leaf;
    const auto go_on = [&](bool left) HOLDFAST_LAMBDA {
        visiting_order(few, query_leaf, left ? own.left : own.right,
                       left ? left_least : right_least, order, number);
    };
    go_on(left_first);
    go_on(!left_first);
}

/// Adds what sum_balls adds for eight points of a leaf below a node; `shared` is the leaf's.
static void add_balls(const FewPoints& few, std::size_t query_leaf, std::size_t first,
                      std::size_t at, double radius_squared, const Lanes* distances, Lanes& mass,
                      double& shared) {
    const CompactPosterior& posterior = *few.posterior;
    const FewNode& own = few.node[at];
    double least, greatest;
    box_distances(few, few.leaf_node[query_leaf], at, least, greatest);
    if (least > radius_squared) return;
    if (greatest <= radius_squared) {
        shared += own.weight;
        return;
    }
    if (own.left != 0) {
        add_balls(few, query_leaf, first, own.left, radius_squared, distances, mass, shared);
        add_balls(few, query_leaf, first, own.right, radius_squared, distances, mass, shared);
        return;
    }
    PointDistances to_box{};
    for (std::size_t c = 0; c < posterior.dimension; ++c) {
        to_box.add(load(posterior.coordinates + c * posterior.stride + first), own.low[c],
                   own.high[c]);
    }
    const IntLanes inside = to_box.greatest <= radius_squared;
    const IntLanes reached = to_box.least <= radius_squared;
    Lanes sum = mass;
    for (std::size_t block = own.first_leaf * leaf_size; block < own.last_leaf * leaf_size;
         block += lane_count) {
        Lanes one_by_one = sum;
        IntLanes all = distances[block] <= radius_squared;
        for (std::size_t n = block; n < block + lane_count; ++n) {
            const IntLanes within = distances[n] <= radius_squared;
            one_by_one += select(within, splat(posterior.weights[n]), Lanes{});
            all = all & within;
        }
        sum = select(all, sum + few.block_weights[block / lane_count], one_by_one);
    }
    mass = select(inside, mass + own.weight, select(reached, sum, mass));
}

/// As searched_term.
static double searched_term(const CompactPosterior& posterior, std::size_t own,
                            const Lanes* distances, std::uint32_t neighbors,
                            const NearestNeighborConstants& constants) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const std::size_t lane = own % lane_count;
    double smallest[few_list];
    std::uint32_t kept = 0;
    for (std::size_t n = 0; n < posterior.count; ++n) {
        const double distance = distances[n][lane];
        if (n != own && (kept < neighbors || distance < smallest[neighbors - 1])) {
            insert_smallest(smallest, kept, neighbors, distance);
        }
    }
    double radius_squared = smallest[neighbors - 1];
    const bool resolved = radius_squared > resolution_squared;
    radius_squared = resolved ? radius_squared * tie_tolerance : resolution_squared;
    double mass = 0.0;
    std::uint32_t count = 0;
    for (std::size_t n = 0; n < posterior.count; ++n) {
        if (n == own || !(distances[n][lane] <= radius_squared)) continue;
        mass += posterior.weights[n];
        ++count;
    }
    return nearest_term(posterior.weights[own], mass, 0.5 * log_of(radius_squared),
                        posterior.dimension, resolved ? neighbors : count, constants);
}

/// The sixteen nearest points of eight, sorted as find_nearest does.
static void sort_nearest(const Lanes* distances, const Visited* leaves, std::size_t number,
                         unsigned used, Lanes* best) {
    for (std::size_t l = 0; l < number; ++l) {
        if (l > 0 && (bits_of(best[few_list - 1] > leaves[l].least) & used) == 0) continue;
        Lanes block[few_list];
        for (std::size_t other = 0; other < leaf_size; ++other) {
            Lanes distance = distances[leaves[l].leaf * leaf_size + other];
            distance = select(distance < far_away, distance, splat(far_away));
            block[other] =
                detail::from_bits<Lanes>((detail::bits(distance) & ~number_bits) |
                                         static_cast<std::int64_t>(l * leaf_size + other));
        }
        if (l == 0) {
            apply<few_list, sorting<few_list>>(block);
            for (std::size_t i = 0; i < few_list; ++i) best[i] = block[i];
        } else {
            merge_block<few_list>(best, block);
        }
    }
}

/// One posterior of `leaf_size` to `few_points` points and k up to 8; the stride is a multiple of
/// leaf_size.
static double few_nearest(const CompactPosterior& posterior, std::uint32_t neighbors,
                          const NearestNeighborConstants& constants, std::uint64_t* visits) {
    const std::size_t count = posterior.count, dimension = posterior.dimension;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double log_ball =
        constants.log_ball_volume + static_cast<double>(dimension) * log_of(constants.resolution);
    FewPoints few;
    few.posterior = &posterior;
    few.leaves = (count + leaf_size - 1) / leaf_size;
    add_node(few, 0, few.leaves);
    *visits += count * count;
    double entropy = 0.0;
    for (std::size_t leaf = 0; leaf < few.leaves; ++leaf) {
        double unused, diameter_squared;
        box_distances(few, few.leaf_node[leaf], few.leaf_node[leaf], unused, diameter_squared);
        const bool dense = diameter_squared <= resolution_squared;
        Visited order[few_leaves];
        std::size_t ordered = 0;
        if (!dense) visiting_order(few, leaf, 0, 0.0, order, ordered);
        double by_lists = 0.0, terms[leaf_size];
        unsigned open = 0;
        for (std::size_t v = 0; v < query_vectors; ++v) {
            const std::size_t first = leaf * leaf_size + v * lane_count;
            if (first >= count) break;
            Lanes distances[few_points], within{};
            for (std::size_t n = 0; n < few.leaves * leaf_size; ++n) {
                Lanes distance{};
                for (std::size_t c = 0; c < dimension; ++c) {
                    const double* x = posterior.coordinates + c * posterior.stride;
                    const Lanes difference = load(x + first) - x[n];
                    distance += difference * difference;
                }
                distances[n] = distance;
                within += select(distance <= resolution_squared, splat(1.0), Lanes{});
            }
            const Lanes weight = load(posterior.weights + first);
            const unsigned used = bits_of(weight > 0.0);
            unsigned unsettled = used;
            // A list that ends within the resolution settles nothing.
            if (!dense && (used & bits_of(within < static_cast<double>(few_list))) != 0) {
                Lanes best[few_list];
                sort_nearest(distances, order, ordered, used, best);
                // The leaf's own points have the first numbers.
                const auto weight_of = [&](std::size_t number, std::size_t lane) HOLDFAST_LAMBDA {
                    if (number == v * lane_count + lane) return 0.0;
                    return posterior
                        .weights[order[number / leaf_size].leaf * leaf_size + number % leaf_size];
                };
                unsettled =
                    walk_single<few_list>(best, __builtin_inf(), weight_of, weight, splat(1.0),
                                          neighbors, dimension, constants, by_lists);
            }
            if (unsettled == 0) continue;
            Lanes mass{};
            double shared = 0.0;
            add_balls(few, leaf, first, 0, resolution_squared, distances, mass, shared);
            const Lanes log_mass = log_of(((mass + shared) - weight) / (1.0 - weight));
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                if ((unsettled >> lane & 1) == 0) continue;
                const auto others = static_cast<std::uint32_t>(within[lane]) - 1;
                terms[v * lane_count + lane] =
                    others >= neighbors
                        ? weight[lane] *
                              (log_ball - log_mass[lane] + constants.bias_correction[others])
                        : searched_term(posterior, first + lane, distances, neighbors, constants);
            }
            open |= unsettled << (v * lane_count);
        }
        double sum = by_lists;
        for (; open != 0; open &= open - 1) sum += terms[__builtin_ctz(open)];
        entropy += sum;
    }
    return entropy;
}

}  // namespace holdfast::inline HOLDFAST_ISA
