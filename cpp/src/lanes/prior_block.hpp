// Neighbourhoods of the prior, and what posteriors gain in them (one compilation per instruction
// set).
//
// A point's neighbours are found and used while they are in the cache: distances to all points,
// eight at a time; then the sums over the neighbours, for a row of posteriors at once. Sums take
// the neighbours in the order of their numbers, so the bits depend on no block and no vector.

#pragma once

#include "compact_entropy.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// The share s of a point that counts in its own neighbourhood.
inline constexpr double own_share = 0.05;
inline constexpr double largest_finite = 1.7976931348623157e308;

template <class T>
HOLDFAST_INLINE T mass_around(T others, T own) {
    return (others + own_share * own) / (1.0 - (1.0 - own_share) * own);
}

/// Squared distances from point n to the blocks [begin, end) of eight points; returns the least in
/// each lane. `first` has the first coordinates.
static Lanes distances_from(const PriorGroup& group, std::size_t n, const double* first,
                            std::size_t begin, std::size_t end, double* distances) {
    constexpr std::size_t together = 4;
    Lanes least[together];
    for (Lanes& each : least) each = splat(largest_finite);
    const auto rows = [&]<std::size_t number>(std::size_t block,
                                              Lanes(&sums)[number]) HOLDFAST_LAMBDA {
        const Lanes own_first = splat(group.coordinates[n]);
        for (std::size_t i = 0; i < number; ++i) {
            const Lanes difference = load(first + (block + i) * lane_count) - own_first;
            sums[i] = difference * difference;
        }
        for (std::size_t c = 1; c < group.varying; ++c) {
            const double* column = group.coordinates + c * group.stride;
            const Lanes own = splat(column[n]);
            for (std::size_t i = 0; i < number; ++i) {
                const Lanes difference = load(column + (block + i) * lane_count) - own;
                sums[i] += difference * difference;
            }
        }
        for (std::size_t i = 0; i < number; ++i) {
            store(distances + (block + i) * lane_count, sums[i]);
            order(least[i], sums[i]);
        }
    };
    std::size_t block = begin;
    for (; block + together <= end; block += together) {
        Lanes sums[together];
        rows(block, sums);
    }
    for (; block < end; ++block) {
        Lanes sums[1];
        rows(block, sums);
    }
    for (std::size_t i = 1; i < together; ++i) order(least[0], least[i]);
    return least[0];
}

/// Writes the numbers of the distances up to `bound`, and up to sixteen more; returns how many
/// there are.
static std::size_t numbers_within(const double* distances, std::size_t stride, double bound,
                                  std::uint32_t* numbers) {
    const Lanes bounds = splat(bound);
    std::size_t found = 0, j = 0;
#if defined(__AVX512VL__)
    __m512i own = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    for (; j + 2 * lane_count <= stride; j += 2 * lane_count) {
        const unsigned bits = bits_at_most(load(distances + j), bounds) |
                              bits_at_most(load(distances + j + lane_count), bounds) << lane_count;
        _mm512_storeu_si512(numbers + found,
                            _mm512_maskz_compress_epi32(static_cast<__mmask16>(bits), own));
        found += static_cast<std::size_t>(__builtin_popcount(bits));
        own = _mm512_add_epi32(own, _mm512_set1_epi32(2 * lane_count));
    }
#endif
    for (; j < stride; j += lane_count) {
        for (unsigned bits = bits_at_most(load(distances + j), bounds); bits != 0;
             bits &= bits - 1) {
            numbers[found++] =
                static_cast<std::uint32_t>(j) + static_cast<std::uint32_t>(__builtin_ctz(bits));
        }
    }
    return found;
}

struct Neighborhood {
    std::size_t members;
    std::uint32_t within;   // the q of the bias correction
    double radius_squared;  // with the tolerance for ties
};

/// Writes the numbers of the neighbours of point n.
static Neighborhood neighborhood_of(const PriorGroup& group, std::size_t n, const double* first,
                                    double* distances, double* smallest, std::uint32_t* numbers) {
    const double resolution_squared = group.constants.resolution * group.constants.resolution;
    const double resolved_above = resolution_squared * tie_tolerance;
    const std::uint32_t k = group.neighbors;
    // The k-th of the least distances of k or more lanes is an upper bound on the k-th distance.
    const std::size_t blocks = group.stride / lane_count;
    const std::size_t parts = (k + lane_count - 1) / lane_count;
    std::uint32_t kept = 0, within = 0;
    for (std::size_t part = 0; part < parts; ++part) {
        const Lanes least = distances_from(group, n, first, part * blocks / parts,
                                           (part + 1) * blocks / parts, distances);
        within += static_cast<std::uint32_t>(
            __builtin_popcount(bits_at_most(least, splat(resolved_above))));
        if (within >= k) continue;
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            if (kept < k || least[lane] < smallest[k - 1]) {
                insert_smallest(smallest, kept, k, least[lane]);
            }
        }
    }
    if (within >= k) {
        const std::size_t members =
            numbers_within(distances, group.stride, resolved_above, numbers);
        return {members, static_cast<std::uint32_t>(members), resolved_above};
    }
    const double reach = smallest[k - 1] * tie_tolerance;
    const std::size_t candidates = numbers_within(
        distances, group.stride, reach < largest_finite ? reach : largest_finite, numbers);
    kept = within = 0;
    for (std::size_t i = 0; i < candidates; ++i) {
        const double distance = distances[numbers[i]];
        within += distance <= resolved_above ? 1 : 0;
        if (kept < k || distance < smallest[k - 1]) insert_smallest(smallest, kept, k, distance);
    }
    const bool resolved = within < k;
    const double radius = resolved ? smallest[k - 1] * tie_tolerance : resolved_above;
    std::size_t members = 0;
    for (std::size_t i = 0; i < candidates; ++i) {
        const std::uint32_t number = numbers[i];
        numbers[members] = number;
        members += distances[number] <= radius ? 1 : 0;
    }
    return {members, resolved ? k : static_cast<std::uint32_t>(members), radius};
}

/// sums[i] = the sum over the numbers, in their order, of the row's vector that begins at from[i].
template <std::size_t vectors>
HOLDFAST_INLINE void sum_rows(const PriorGroup& group, const std::uint32_t* numbers,
                              std::size_t members, const std::size_t* from, Lanes* sums) {
    Lanes totals[vectors] = {};
    const std::size_t columns = group.vectors * lane_count;
    for (std::size_t i = 0; i < members; ++i) {
        const double* row = group.weights + numbers[i] * columns;
        for (std::size_t v = 0; v < vectors; ++v) totals[v] += load(row + from[v]);
    }
    for (std::size_t v = 0; v < vectors; ++v) sums[v] = totals[v];
}

/// For the points [begin, end): terms[n] of the prior's entropy, gains[n][vectors * 8] of the
/// posteriors' information. `scratch` has 2 stride + k doubles, `numbers` stride + 16.
static void prior_block(const PriorGroup& group, std::size_t begin, std::size_t end,
                        double* scratch, std::uint32_t* numbers, double* terms, double* gains) {
    const NearestNeighborConstants& constants = group.constants;
    const std::size_t columns = group.vectors * lane_count;
    const double d = static_cast<double>(group.dimension);
    double* first = scratch;
    double* distances = first + group.stride;
    double* smallest = distances + group.stride;
    for (std::size_t j = 0; j < group.stride; j += lane_count) {
        store(first + j, load(group.coordinates + j));
    }
    for (std::size_t n = begin; n < end; ++n) {
        Neighborhood around{0, 0, constants.resolution * constants.resolution};
        if (group.neighbors > 0) {
            first[n] = __builtin_inf();  // a point is no neighbour of its own
            around = neighborhood_of(group, n, first, distances, smallest, numbers);
            first[n] = group.coordinates[n];
        }
        const double* own_row = group.weights + n * columns;
        double inverse_mass = 1.0;
        for (std::size_t v = 0; v < group.vectors;) {
            constexpr std::size_t most = 4;
            std::size_t from[most], chosen = 0;
            Lanes sums[most];
            for (; v < group.vectors && chosen < most; ++v) {
                if (bits_of(load(own_row + v * lane_count) > 0.0) != 0) {
                    from[chosen++] = v * lane_count;
                } else {
                    store(gains + n * columns + v * lane_count, Lanes{});
                }
            }
            if (chosen == 4) {
                sum_rows<4>(group, numbers, around.members, from, sums);
            } else if (chosen == 3) {
                sum_rows<3>(group, numbers, around.members, from, sums);
            } else if (chosen == 2) {
                sum_rows<2>(group, numbers, around.members, from, sums);
            } else if (chosen == 1) {
                sum_rows<1>(group, numbers, around.members, from, sums);
            }
            for (std::size_t i = 0; i < chosen; ++i) {
                if (from[i] == 0 && group.neighbors > 0) {
                    // Column 0 is the prior. Rounding may leave nothing for the others, or less
                    // than their own sum.
                    const double prior = own_row[0], mass = sums[i][0], rest = 1.0 - prior;
                    const double share = mass < rest ? mass / rest : 1.0;
                    terms[n] = prior * (-log_of(share) + constants.log_ball_volume +
                                        0.5 * d * log_of(around.radius_squared) +
                                        constants.bias_correction[around.within]);
                    inverse_mass = 1.0 / mass_around(mass, prior);
                }
                const Lanes own = load(own_row + from[i]);
                const Lanes ratio =
                    select(own > 0.0, mass_around(sums[i], own) * inverse_mass, splat(1.0));
                store(gains + n * columns + from[i], own * log_of(ratio));
            }
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
