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
    // Several, so that none waits for the one before; where a value takes more than one register,
    // these are few.
    constexpr std::size_t chains = registers == 1 ? together : 1;
    Lanes least[chains];
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
            order(least[i % chains], sums[i]);
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
    for (std::size_t i = 1; i < chains; ++i) order(least[0], least[i]);
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

/// The k-th least of eight values: the least that no fewer than k of them do not exceed.
HOLDFAST_INLINE double kth_of(const Lanes& x, std::uint32_t k) {
    Lanes not_greater{};
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        not_greater += select(splat(x[lane]) <= x, splat(1.0), Lanes{});
    }
    return -maximum_of(-select(not_greater >= static_cast<double>(k), x, splat(__builtin_inf())));
}

/// What `neighborhoods_of` works with; numbers for each of eight points.
struct PriorScratch {
    double* first;           // [stride] the first coordinates
    double* distances;       // [stride]
    double* smallest;        // [k]
    double* rows;            // [stride][8]
    double* kept;            // [k][8]
    std::uint32_t* numbers;  // [8][numbers_each]
    std::size_t numbers_each;
};

/// Writes the numbers of the neighbours of eight points or fewer, from point `base` on.
static void neighborhoods_of(const PriorGroup& group, std::size_t base, std::size_t used,
                             const PriorScratch& scratch, Neighborhood* around) {
    const double resolution_squared = group.constants.resolution * group.constants.resolution;
    const double resolved_above = resolution_squared * tie_tolerance;
    const std::uint32_t k = group.neighbors;
    // The k-th of the least distances of k or more lanes is an upper bound on the k-th distance.
    const std::size_t blocks = group.stride / lane_count;
    const std::size_t parts = (k + lane_count - 1) / lane_count;
    std::size_t candidates[lane_count] = {}, most = 0;
    for (std::size_t i = 0; i < used; ++i) {
        const std::size_t n = base + i;
        std::uint32_t* const numbers = scratch.numbers + i * scratch.numbers_each;
        scratch.first[n] = __builtin_inf();  // a point is no neighbour of its own
        std::uint32_t kept = 0, within = 0;
        double reach = 0.0;
        for (std::size_t part = 0; part < parts; ++part) {
            const Lanes least = distances_from(group, n, scratch.first, part * blocks / parts,
                                               (part + 1) * blocks / parts, scratch.distances);
            within += static_cast<std::uint32_t>(
                __builtin_popcount(bits_at_most(least, splat(resolved_above))));
            if (within >= k) continue;
            if (parts == 1) {
                reach = kth_of(least, k);
                continue;
            }
            for (std::size_t lane = 0; lane < lane_count; ++lane) {
                if (kept < k || least[lane] < scratch.smallest[k - 1]) {
                    insert_smallest(scratch.smallest, kept, k, least[lane]);
                }
            }
            reach = scratch.smallest[k - 1];
        }
        scratch.first[n] = group.coordinates[n];
        if (within >= k) {
            const std::size_t members =
                numbers_within(scratch.distances, group.stride, resolved_above, numbers);
            around[i] = {members, static_cast<std::uint32_t>(members), resolved_above};
            continue;
        }
        reach *= tie_tolerance;
        candidates[i] = numbers_within(scratch.distances, group.stride,
                                       reach < largest_finite ? reach : largest_finite, numbers);
        for (std::size_t c = 0; c < candidates[i]; ++c) {
            scratch.rows[c * lane_count + i] = scratch.distances[numbers[c]];
        }
        if (candidates[i] > most) most = candidates[i];
    }
    if (most == 0) return;
    for (std::size_t i = 0; i < lane_count; ++i) {
        for (std::size_t c = candidates[i]; c < most; ++c) {
            scratch.rows[c * lane_count + i] = __builtin_inf();
        }
    }
    Lanes within;
    const Lanes furthest = kth_least(scratch.rows, most, k, scratch.kept, resolved_above, within);
    for (std::size_t i = 0; i < used; ++i) {
        if (candidates[i] == 0) continue;
        const bool resolved = within[i] < static_cast<double>(k);
        const double radius = resolved ? furthest[i] * tie_tolerance : resolved_above;
        std::uint32_t* const numbers = scratch.numbers + i * scratch.numbers_each;
        std::size_t members = 0;
        for (std::size_t c = 0; c < candidates[i]; ++c) {
            numbers[members] = numbers[c];
            members += scratch.rows[c * lane_count + i] <= radius ? 1 : 0;
        }
        around[i] = {members, resolved ? k : static_cast<std::uint32_t>(members), radius};
    }
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

/// The terms of eight points or fewer of the prior's entropy.
static void prior_terms(const PriorGroup& group, const Lanes& prior, const Lanes& mass,
                        const Neighborhood* around, std::size_t used, double* terms) {
    const NearestNeighborConstants& constants = group.constants;
    Lanes radius_squared = splat(1.0), correction{};
    for (std::size_t i = 0; i < used; ++i) {
        radius_squared[i] = around[i].radius_squared;
        correction[i] = constants.bias_correction[around[i].within];
    }
    // Rounding may leave nothing for the others, or less than their own sum.
    const Lanes rest = 1.0 - prior;
    const Lanes share = select(mass < rest, mass / rest, splat(1.0));
    const double half = 0.5 * static_cast<double>(group.dimension);
    store_partial(terms,
                  prior * (-log_of(share) + constants.log_ball_volume +
                           half * log_of(radius_squared) + correction),
                  used);
}

/// For the points [begin, end): terms[n] of the prior's entropy, gains[n][vectors * 8] of the
/// posteriors' information. `doubles` has 10 stride + 9 k places, `numbers` 8 (stride + 16).
static void prior_block(const PriorGroup& group, std::size_t begin, std::size_t end,
                        double* doubles, std::uint32_t* all_numbers, double* terms, double* gains) {
    const NearestNeighborConstants& constants = group.constants;
    const std::size_t columns = group.vectors * lane_count;
    const std::size_t stride = group.stride, k = group.neighbors;
    double* const rows = doubles + 2 * stride;
    double* const kept = rows + lane_count * stride;
    const PriorScratch scratch{doubles, doubles + stride, kept + lane_count * k,  rows,
                               kept,    all_numbers,      stride + 2 * lane_count};
    for (std::size_t j = 0; j < stride; j += lane_count) {
        store(scratch.first + j, load(group.coordinates + j));
    }
    Neighborhood found[lane_count];
    Lanes priors{}, masses{};
    for (std::size_t n = begin; n < end; ++n) {
        const std::size_t place = (n - begin) % lane_count;
        if (place == 0) {
            for (Neighborhood& each : found) {
                each = {0, 0, constants.resolution * constants.resolution};
            }
            const std::size_t used = end - n < lane_count ? end - n : lane_count;
            if (k > 0) neighborhoods_of(group, n, used, scratch, found);
        }
        const Neighborhood& around = found[place];
        const std::uint32_t* const numbers = all_numbers + place * scratch.numbers_each;
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
                if (from[i] == 0 && k > 0) {  // column 0 is the prior
                    priors[place] = own_row[0];
                    masses[place] = sums[i][0];
                    inverse_mass = 1.0 / mass_around(masses[place], priors[place]);
                }
                const Lanes own = load(own_row + from[i]);
                const Lanes ratio =
                    select(own > 0.0, mass_around(sums[i], own) * inverse_mass, splat(1.0));
                store(gains + n * columns + from[i], own * log_of(ratio));
            }
        }
        if (k > 0 && (place + 1 == lane_count || n + 1 == end)) {
            prior_terms(group, priors, masses, found, place + 1, terms + n - place);
        }
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
