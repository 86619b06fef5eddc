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
    if (!find_nearest(group.tree, query, lists, visits, resolution_squared)) {
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

/// Adds the terms of the points of some leaves that lists settle; `open` tells by bits which points
/// of each leaf need their balls.
template <std::size_t vectors>
static void block_lists_rows(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                             const NearestNeighborConstants& constants, double* scratch,
                             double* out, unsigned* open, std::uint64_t* visits) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    std::uint32_t most = 0;
    for (std::size_t m = 0; m < group.members; ++m) {
        if (group.neighbors[m] > most) most = group.neighbors[m];
    }
    QueryLeaf query;
    for (std::size_t place = 0; place < leaves; ++place) {
        open_leaf(group.tree, first + place, query);
        double unused, diameter_squared, *terms = out + place * vectors * lane_count;
        box_distances(group.tree, query.node, query.node, unused, diameter_squared);
        if (diameter_squared <= resolution_squared) {
            open[place] = (1u << query.used) - 1;
        } else if (group.members == 1 && most <= 8) {
            open[place] = list_terms<vectors, 16>(group, query, constants, scratch, terms, visits);
        } else if (most <= 8) {
            open[place] = list_terms<vectors, 32>(group, query, constants, scratch, terms, visits);
        } else {
            open[place] = list_terms<vectors, 64>(group, query, constants, scratch, terms, visits);
        }
    }
}

/// The open points of some leaves in runs that lie close together; one of each stands for all.
struct Runs {
    std::uint32_t* slots;   // of run after run
    std::uint32_t* end;     // [number], of each run in `slots`
    std::uint32_t* chosen;  // [number], slots
    std::size_t number, stride;
};

HOLDFAST_INLINE double coordinate_of(const TreeView& tree, std::size_t slot, std::size_t c) {
    return tree.coordinates[(slot / leaf_size * tree.dimension + c) * leaf_size + slot % leaf_size];
}

/// The point nearest to the mean of a run, the first of equals: where the terms change evenly, it
/// has their mean.
static std::uint32_t middle_of(const TreeView& tree, const std::uint32_t* slots,
                               std::size_t number) {
    if (number == 1) return slots[0];
    double mean[max_dimension];
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        double sum = 0.0;
        for (std::size_t i = 0; i < number; ++i) sum += coordinate_of(tree, slots[i], c);
        mean[c] = sum / static_cast<double>(number);
    }
    std::uint32_t nearest = slots[0];
    double least = __builtin_inf();
    for (std::size_t i = 0; i < number; ++i) {
        double distance = 0.0;
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            const double difference = coordinate_of(tree, slots[i], c) - mean[c];
            distance += difference * difference;
        }
        if (distance < least) {
            least = distance;
            nearest = slots[i];
        }
    }
    return nearest;
}

/// Divides the slots [begin, end) of `runs` across their widest coordinate until no part has more
/// than `stride` points.
static void divide(const TreeView& tree, std::size_t begin, std::size_t end, Runs& runs) {
    const std::size_t number = end - begin;
    if (number <= runs.stride) {
        if (number == 0) return;
        runs.end[runs.number] = static_cast<std::uint32_t>(end);
        runs.chosen[runs.number++] = middle_of(tree, runs.slots + begin, number);
        return;
    }
    std::size_t widest = 0;
    double width = -1.0;
    for (std::size_t c = 0; c < tree.dimension; ++c) {
        double low = __builtin_inf(), high = -__builtin_inf();
        for (std::size_t i = begin; i < end; ++i) {
            const double x = coordinate_of(tree, runs.slots[i], c);
            low = x < low ? x : low;
            high = x > high ? x : high;
        }
        if (high - low > width) {
            width = high - low;
            widest = c;
        }
    }
    for (std::size_t i = begin + 1; i < end; ++i) {  // at most sixteen: by insertion
        const std::uint32_t slot = runs.slots[i];
        const double x = coordinate_of(tree, slot, widest);
        std::size_t at = i;
        for (; at > begin && coordinate_of(tree, runs.slots[at - 1], widest) > x; --at) {
            runs.slots[at] = runs.slots[at - 1];
        }
        runs.slots[at] = slot;
    }
    divide(tree, begin, begin + number / 2, runs);
    divide(tree, begin + number / 2, end, runs);
}

/// Adds the terms of the runs [begin, end), at most block_points, to `out`.
template <std::size_t vectors>
static void add_runs(const PosteriorGroup& group, const Runs& runs, std::size_t begin,
                     std::size_t end, const NearestNeighborConstants& constants, double* scratch,
                     double* out, std::uint64_t* visits) {
    constexpr std::size_t columns = vectors * lane_count;
    const TreeView& tree = group.tree;
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    const double log_ball = constants.log_ball_volume +
                            static_cast<double>(tree.dimension) * log_of(constants.resolution);
    const BlockQueries queries{end - begin, scratch};
    for (std::size_t i = 0; i < queries.number; ++i) {
        for (std::size_t c = 0; c < tree.dimension; ++c) {
            scratch[(i / leaf_size * tree.dimension + c) * leaf_size + i % leaf_size] =
                coordinate_of(tree, runs.chosen[begin + i], c);
        }
    }
    double* smallest = scratch + block_points * tree.dimension;
    BlockSums<vectors> sums;
    sum_block<vectors>(group, queries, resolution_squared, sums, visits);
    Lanes terms[vectors];
    for (std::size_t v = 0; v < vectors; ++v) terms[v] = load(out + v * lane_count);
    std::size_t first = begin > 0 ? runs.end[begin - 1] : 0;
    for (std::size_t i = 0; i < queries.number; ++i) {
        const std::size_t slot = runs.chosen[begin + i], last = runs.end[begin + i];
        const Row<vectors> row = sums.row(i);
        double point[max_dimension];
        for (std::size_t c = 0; c < tree.dimension; ++c) point[c] = coordinate_of(tree, slot, c);
        for (std::size_t v = 0; v < vectors; ++v) {
            Lanes share{};  // of all points of the run
            for (std::size_t at = first; at < last; ++at) {
                share += load(group.weights + runs.slots[at] * columns + v * lane_count);
            }
            const Lanes weight = load(group.weights + slot * columns + v * lane_count);
            // The point itself is within every ball around it.
            const Lanes log_mass = log_of((row.mass[v] - weight) / (1.0 - weight));
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                if (!(share[lane] > 0.0)) continue;
                const std::size_t column = v * lane_count + lane;
                const std::uint32_t count = row.within[v][lane] - (weight[lane] > 0.0 ? 1 : 0);
                const double value =
                    count >= group.neighbors[column]
                        ? log_ball - log_mass[lane] + constants.bias_correction[count]
                        : searched_value(group, point, slot, column, constants, smallest, visits);
                terms[v][lane] += share[lane] * value;
            }
        }
        first = last;
    }
    for (std::size_t v = 0; v < vectors; ++v) store(out + v * lane_count, terms[v]);
}

template <std::size_t vectors>
static void block_balls_rows(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                             const unsigned* open, std::size_t stride,
                             const NearestNeighborConstants& constants, double* scratch,
                             double* out, std::uint64_t* visits) {
    std::uint32_t slots[ball_leaves * leaf_size], end[ball_leaves * leaf_size],
        chosen[ball_leaves * leaf_size];
    Runs runs{slots, end, chosen, 0, stride};
    std::size_t number = 0, begin = 0;
    const std::size_t leaves_of_run = stride > leaf_size ? stride / leaf_size : 1;
    for (std::size_t place = 0; place < leaves; ++place) {
        for (unsigned left = open[place]; left != 0; left &= left - 1) {
            slots[number++] = static_cast<std::uint32_t>((first + place) * leaf_size) +
                              static_cast<std::uint32_t>(__builtin_ctz(left));
        }
        if ((place + 1) % leaves_of_run == 0 || place + 1 == leaves) {
            divide(group.tree, begin, number, runs);
            begin = number;
        }
    }
    for (std::size_t from = 0; from < runs.number; from += block_points) {
        const std::size_t to = from + block_points;
        add_runs<vectors>(group, runs, from, to < runs.number ? to : runs.number, constants,
                          scratch, out, visits);
    }
}

static void block_lists(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                        const NearestNeighborConstants& constants, double* scratch, double* out,
                        unsigned* open, std::uint64_t* visits) {
    switch (group.vectors) {
        case 1:
            return block_lists_rows<1>(group, first, leaves, constants, scratch, out, open, visits);
        case 2:
            return block_lists_rows<2>(group, first, leaves, constants, scratch, out, open, visits);
        case 3:
            return block_lists_rows<3>(group, first, leaves, constants, scratch, out, open, visits);
        default:
            return block_lists_rows<4>(group, first, leaves, constants, scratch, out, open, visits);
    }
}

static void block_balls(const PosteriorGroup& group, std::size_t first, std::size_t leaves,
                        const unsigned* open, std::size_t stride,
                        const NearestNeighborConstants& constants, double* scratch, double* out,
                        std::uint64_t* visits) {
    switch (group.vectors) {
        case 1:
            return block_balls_rows<1>(group, first, leaves, open, stride, constants, scratch, out,
                                       visits);
        case 2:
            return block_balls_rows<2>(group, first, leaves, open, stride, constants, scratch, out,
                                       visits);
        case 3:
            return block_balls_rows<3>(group, first, leaves, open, stride, constants, scratch, out,
                                       visits);
        default:
            return block_balls_rows<4>(group, first, leaves, open, stride, constants, scratch, out,
                                       visits);
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
