// The entropies of many posteriors over the same points at once (one compilation per instruction
// set).
//
// The geometry (which points lie within a ball, what the kernel between two points is) does not
// depend on the weights. So it is computed once per pair of points and applied to a row of up to 32
// posteriors.

#pragma once

#include "ball_sums.hpp"
#include "nearest_lists.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// Where the points are denser than the resolution, sums over balls; where they are not, sorted
/// lists of the nearest points; and for what neither settles (few of the near points have weight),
/// a search for one posterior. All give the same terms.
template <std::size_t vectors, std::size_t length>
static void group_nearest_rows(const PosteriorGroup& group, const QueryLeaf& query,
                               const NearestNeighborConstants& constants, double* scratch,
                               double* out, std::uint64_t* visits) {
    const double resolution_squared = constants.resolution * constants.resolution * tie_tolerance;
    bool dense = squared_diameter(group.tree, query) <= resolution_squared;
    bool summed = false;
    Row<vectors> rows[leaf_size];
    NearestLists<length> lists;
    Lanes wanted[vectors];  // the k of each column
    // Where all lists would end within the resolution, all points need their balls.
    dense = dense || !find_nearest(group.tree, query, lists, visits, resolution_squared,
                                   group.sample.count != 0);
    if (!dense) {
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
    open_leaf(tree, group.sample, leaf, query);
    Lanes totals[leaf_size][vectors] = {};
    std::uint32_t stack[stack_size];
    std::size_t depth = 0;
    stack[depth++] = 0;
    while (depth > 0) {
        const std::uint32_t at = stack[--depth];
        double least, greatest;
        box_distances(tree, query, at, least, greatest);
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
            const Lanes weight = load(group.weights + query.slots[i] * columns + v * lane_count);
            const Lanes term = select(weight > 0.0, weight * log_of(totals[i][v]), Lanes{});
            store(out + v * lane_count, load(out + v * lane_count) - query.factors[i] * term);
        }
    }
}

template <std::size_t vectors>
static void group_nearest_leaf(const PosteriorGroup& group, std::size_t leaf,
                               const NearestNeighborConstants& constants, double* scratch,
                               double* out, std::uint64_t* visits) {
    QueryLeaf query;
    open_leaf(group.tree, group.sample, leaf, query);
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

}  // namespace holdfast::inline HOLDFAST_ISA
