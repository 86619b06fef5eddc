// Nearest-neighbour terms of several leaves of a large tree at once (one compilation per
// instruction set).
//
// Lists and balls as in group_entropy.hpp, but first all lists, then all balls of a block of leaves
// together.

#pragma once

#include "block_sums.hpp"
#include "nearest_lists.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// Adds the terms of a leaf's points that lists settle; tells by bits which need their balls.
template <std::size_t vectors, std::size_t length>
static unsigned list_terms(const PosteriorGroup& group, const QueryLeaf& query,
                           const NearestNeighborConstants& constants, double* scratch, double* out,
                           std::uint64_t* visits) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    NearestLists<length> lists;
    // Where all lists would end within the resolution, all points need their balls.
    if (!find_nearest(group.tree, query, lists, visits, resolution_squared,
                      group.sample.count != 0)) {
        return (1u << query.used) - 1;
    }
    if (group.members == 1) {
        unsigned open = 0;
        double sum = 0.0;
        for (std::size_t v = 0; v < query_vectors; ++v) {
            open |= walk_single<length>(group, query, v, lists, constants, sum) << (v * lane_count);
        }
        out[0] += sum;
        return open & ((1u << query.used) - 1);
    }
    Lanes wanted[vectors], terms[vectors];  // wanted: the k of each column
    for (std::size_t v = 0; v < vectors; ++v) {
        terms[v] = load(out + v * lane_count);
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            wanted[v][lane] = group.neighbors[v * lane_count + lane];
        }
    }
    unsigned open = 0;
    for (std::size_t i = 0; i < query.used; ++i) {
        // Without its number, so that no point as far as the last one is taken for nearer.
        const double last = detail::from_bits<double>(
            detail::bits(lists.keys[i / lane_count][length - 1][i % lane_count]) & ~number_bits);
        const double limit = last < lists.complete_below ? last : lists.complete_below;
        if (limit > resolution_squared) {
            walk_outwards<vectors, length>(group, query, i, lists, wanted, limit, constants,
                                           scratch, terms, visits);
        } else {
            open |= 1u << i;
        }
    }
    for (std::size_t v = 0; v < vectors; ++v) store(out + v * lane_count, terms[v]);
    return open;
}

/// Adds the terms of the points of some leaves.
template <std::size_t vectors>
static void block_nearest_rows(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                               const NearestNeighborConstants& constants, double* scratch,
                               double* out, std::uint64_t* visits) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    std::uint32_t most = 0;
    for (std::size_t m = 0; m < group.members; ++m) {
        if (group.neighbors[m] > most) most = group.neighbors[m];
    }
    BlockQueries queries;
    for (std::size_t place = 0; place < leaves; ++place) {
        QueryLeaf& query = queries.leaves[place];
        open_leaf(group.tree, group.sample, first + place, query);
        unsigned& open = queries.open[place];
        if (squared_diameter(group.tree, query) <= resolution_squared) {
            open = (1u << query.used) - 1;
        } else if (group.members == 1 && most <= 8) {
            open = list_terms<vectors, 16>(group, query, constants, scratch, out, visits);
        } else if (most <= 8) {
            open = list_terms<vectors, 32>(group, query, constants, scratch, out, visits);
        } else {
            open = list_terms<vectors, 64>(group, query, constants, scratch, out, visits);
        }
    }
    BlockSums<vectors> sums;
    sum_block<vectors>(group, queries, resolution_squared, sums, visits);
    Lanes terms[vectors];
    for (std::size_t v = 0; v < vectors; ++v) terms[v] = load(out + v * lane_count);
    for (std::size_t place = 0; place < leaves; ++place) {
        const QueryLeaf& query = queries.leaves[place];
        for (unsigned left = queries.open[place]; left != 0; left &= left - 1) {
            const auto i = static_cast<std::size_t>(__builtin_ctz(left));
            ball_terms<vectors>(group, query, i, sums.row(place * leaf_size + i), constants,
                                scratch, terms, visits);
        }
    }
    for (std::size_t v = 0; v < vectors; ++v) store(out + v * lane_count, terms[v]);
}

static void block_nearest(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                          const NearestNeighborConstants& constants, double* scratch, double* out,
                          std::uint64_t* visits) {
    switch (group.vectors) {
        case 1:
            return block_nearest_rows<1>(group, first, leaves, constants, scratch, out, visits);
        case 2:
            return block_nearest_rows<2>(group, first, leaves, constants, scratch, out, visits);
        case 3:
            return block_nearest_rows<3>(group, first, leaves, constants, scratch, out, visits);
        default:
            return block_nearest_rows<4>(group, first, leaves, constants, scratch, out, visits);
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
