// Neighbourhoods of the prior, and what posteriors gain in them (one compilation per instruction
// set).
//
// The neighbours of a block of points are found first: distances to all points, eight at a time.
// Then come the sums over them, for eight posteriors at once, whose weights stay in the cache, and
// for several points, so that no addition waits for the one before. Sums take the neighbours in the
// order of their numbers, so the bits depend on no block and no vector.
//
// Where a policy gives few actions, many points are equal. They have one ball, which is found once,
// and their sums differ by the point itself alone: up to there they are the same.

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

/// Writes the numbers of the neighbours of eight points or fewer.
static void neighborhoods_of(const PriorGroup& group, const std::uint32_t* points, std::size_t used,
                             const PriorScratch& scratch, Neighborhood* around) {
    const double resolution_squared = group.constants.resolution * group.constants.resolution;
    const double resolved_above = resolution_squared * tie_tolerance;
    const std::uint32_t k = group.neighbors;
    // The k-th of the least distances of k or more lanes is an upper bound on the k-th distance.
    const std::size_t blocks = group.stride / lane_count;
    const std::size_t parts = (k + lane_count - 1) / lane_count;
    std::size_t candidates[lane_count] = {}, most = 0;
    for (std::size_t i = 0; i < used; ++i) {
        const std::size_t n = points[i];
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

/// Points whose sums are made beside each other, so that no addition waits for the one before.
inline constexpr std::size_t sums_together = registers == 1 ? 4 : 2;

/// totals[p] += the rows of eight posteriors at the p-th point's numbers from the i-th on, in their
/// order. The numbers of members do not fall.
template <std::size_t first = 0>
HOLDFAST_INLINE void sum_rows(const double* rows, const std::uint32_t* const* numbers,
                              const std::size_t* members, Lanes* totals, std::size_t i = 0) {
    for (; i < members[first]; ++i) {
        for (std::size_t p = first; p < sums_together; ++p) {
            totals[p] += load(rows + numbers[p][i] * lane_count);
        }
    }
    if constexpr (first + 1 < sums_together) sum_rows<first + 1>(rows, numbers, members, totals, i);
}

/// The sums of equal points, which have one ball: sums[i] lacks the own[i]-th of its numbers. Own
/// places ascend. Up to the first of them all sums are `before`, which has come to `begun`.
static void sum_ball(const double* rows, const std::uint32_t* numbers, std::size_t members,
                     const std::size_t* own, std::size_t& begun, Lanes& before, Lanes* sums) {
    Lanes common = before;
    for (; begun < own[0]; ++begun) common += load(rows + numbers[begun] * lane_count);
    before = common;
    Lanes totals[sums_together];
    for (Lanes& each : totals) each = common;
    std::size_t i = begun;
    for (; i <= own[sums_together - 1]; ++i) {
        const Lanes row = load(rows + numbers[i] * lane_count);
        for (std::size_t p = 0; p < sums_together; ++p) {
            if (own[p] != i) totals[p] += row;
        }
    }
    for (; i < members; ++i) {
        const Lanes row = load(rows + numbers[i] * lane_count);
        for (Lanes& each : totals) each += row;
    }
    for (std::size_t p = 0; p < sums_together; ++p) sums[p] = totals[p];
}

/// The terms of eight points or fewer of the prior's entropy.
static Lanes prior_terms(const PriorGroup& group, const Lanes& prior, const Lanes& mass,
                         const Neighborhood* around, std::size_t used) {
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
    return prior * (-log_of(share) + constants.log_ball_volume + half * log_of(radius_squared) +
                    correction);
}

/// What is known of the points of a block, place by place.
struct PriorPlaces {
    const std::uint32_t* points;
    Neighborhood around[prior_block_size];
    const std::uint32_t* numbers[prior_block_size];  // of its neighbours; of equal points the ball
    std::size_t own[prior_block_size];               // of equal points, the place in the ball
    std::size_t end_of_equals[prior_block_size];     // where the points end that are equal to it
    Lanes priors[prior_block_size / lane_count] = {}, masses[prior_block_size / lane_count] = {};
    double inverse_masses[prior_block_size];
};

static bool equal_points(const PriorGroup& group, std::size_t a, std::size_t b) {
    for (std::size_t c = 0; c < group.varying; ++c) {
        const double* const column = group.coordinates + c * group.stride;
        if (column[a] != column[b]) return false;
    }
    return true;
}

/// Finds the neighbours of the points at [0, count), once for equal ones.
static void find_neighborhoods(const PriorGroup& group, std::size_t count, double* doubles,
                               std::uint32_t* all_numbers, PriorPlaces& places) {
    const std::size_t stride = group.stride, numbers_each = stride + 2 * lane_count;
    double* const rows = doubles + 2 * stride;
    double* const kept = rows + lane_count * stride;
    for (std::size_t j = 0; j < stride; j += lane_count) {
        store(doubles + j, load(group.coordinates + j));
    }
    for (std::size_t first = 0; first < count;) {
        std::size_t begins[lane_count + 1], used = 0;
        std::uint32_t firsts[lane_count];
        std::uint32_t* const numbers = all_numbers + first * numbers_each;
        while (first < count && used < lane_count) {
            begins[used] = first;
            firsts[used++] = places.points[first];
            do {
                ++first;
            } while (first < count && equal_points(group, firsts[used - 1], places.points[first]));
        }
        begins[used] = first;
        Neighborhood found[lane_count];
        neighborhoods_of(group, firsts, used,
                         {doubles, doubles + stride, kept + lane_count * group.neighbors, rows,
                          kept, numbers, numbers_each},
                         found);
        for (std::size_t i = 0; i < used; ++i) {
            std::uint32_t* const own = numbers + i * numbers_each;
            const std::size_t begin = begins[i], end = begins[i + 1];
            for (std::size_t place = begin; place < end; ++place) {
                places.around[place] = found[i];
                places.numbers[place] = own;
                places.end_of_equals[place] = end;
            }
            if (end - begin == 1) continue;
            std::size_t at = found[i].members;
            for (; at > 0 && own[at - 1] > firsts[i]; --at) own[at] = own[at - 1];
            own[at] = firsts[i];
            for (std::size_t place = begin; place < end; ++place) {
                while (own[at] != places.points[place]) ++at;
                places.own[place] = at;
            }
        }
    }
}

/// Points under posteriors that give them weight, one after the other: most lanes of a row have
/// none, and a logarithm takes as long for one lane as for eight.
struct PendingGains {
    static constexpr std::size_t room = (prior_block_size + 1) * lane_count;
    std::size_t number = 0;
    double sums[room], weights[room], inverse_masses[room];
    std::uint32_t places[room];  // in the gains

    HOLDFAST_INLINE void add(const Lanes& sum, const Lanes& own, double inverse_mass,
                             std::size_t place) {
        unsigned bits = bits_of(own > 0.0);
        store(inverse_masses + number, splat(inverse_mass));
#if defined(__AVX512VL__)
        const auto mask = static_cast<__mmask8>(bits);
        _mm512_storeu_pd(sums + number, _mm512_maskz_compress_pd(mask, sum.part[0]));
        _mm512_storeu_pd(weights + number, _mm512_maskz_compress_pd(mask, own.part[0]));
        const __m256i lanes = _mm256_add_epi32(_mm256_set1_epi32(static_cast<int>(place)),
                                               _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
        _mm256_storeu_si256(reinterpret_cast<__m256i*>(places + number),
                            _mm256_maskz_compress_epi32(mask, lanes));
        number += static_cast<std::size_t>(__builtin_popcount(bits));
#else
        for (; bits != 0; bits &= bits - 1) {
            const auto lane = static_cast<std::size_t>(__builtin_ctz(bits));
            sums[number] = sum[lane];
            weights[number] = own[lane];
            places[number++] = static_cast<std::uint32_t>(place + lane);
        }
#endif
    }

    void put(double* gains) {
        store(sums + number, Lanes{});
        store(weights + number, Lanes{});
        store(inverse_masses + number, Lanes{});
        for (std::size_t first = 0; first < number; first += lane_count) {
            const Lanes own = load(weights + first);
            const Lanes ratio = mass_around(load(sums + first), own) * load(inverse_masses + first);
            double found[lane_count];
            store(found, own * log_of(ratio));
            const std::size_t left = number - first < lane_count ? number - first : lane_count;
            for (std::size_t i = 0; i < left; ++i) gains[places[first + i]] = found[i];
        }
        number = 0;
    }
};

/// Takes down what a point gains under eight posteriors.
HOLDFAST_INLINE void take_gain(const PriorGroup& group, PriorPlaces& places, std::size_t place,
                               std::size_t vector, const double* rows, const Lanes& sum,
                               PendingGains& pending) {
    const std::size_t n = places.points[place];
    const Lanes own = load(rows + n * lane_count);
    if (vector == 0 && group.neighbors > 0) {  // its first column is the prior
        places.priors[place / lane_count][place % lane_count] = own[0];
        places.masses[place / lane_count][place % lane_count] = sum[0];
        places.inverse_masses[place] = 1.0 / mass_around(sum[0], own[0]);
    }
    pending.add(sum, own, places.inverse_masses[place], (n * group.vectors + vector) * lane_count);
}

/// Finds the places of the points that have no equal, by the number of their neighbours: sums
/// beside each other should end together. Returns how many there are.
static std::size_t order_singles(const PriorPlaces& places, std::size_t count,
                                 std::size_t* singles) {
    // Without a branch on a number: the rank of each is how many come before it.
    std::uint32_t keys[prior_block_size], ranks[prior_block_size] = {};
    std::size_t found = 0;
    for (std::size_t place = 0; place < count; ++place) {
        const std::size_t end = places.end_of_equals[place];
        const bool single =
            end == place + 1 && (place == 0 || places.end_of_equals[place - 1] == place);
        const std::size_t key = places.around[place].members * prior_block_size + place;
        keys[place] = single ? static_cast<std::uint32_t>(key) : 0xffffffffu;
        found += single ? 1 : 0;
    }
    for (std::size_t place = count; place < prior_block_size; ++place) keys[place] = 0xffffffffu;
    for (const std::uint32_t other : keys) {
        for (std::size_t i = 0; i < prior_block_size; ++i) ranks[i] += other < keys[i] ? 1 : 0;
    }
    for (std::size_t place = 0; place < count; ++place) {
        if (keys[place] != 0xffffffffu) singles[ranks[place]] = place;
    }
    return found;
}

/// For the points at [begin, end) of the group's order, `prior_block_size` or fewer: terms[n] of
/// the prior's entropy, gains[n][vectors * 8] of the posteriors' information. `doubles` has
/// 10 stride + 9 k places, `all_numbers` prior_block_size (stride + 16).
static void prior_block(const PriorGroup& group, std::size_t begin, std::size_t end,
                        double* doubles, std::uint32_t* all_numbers, double* terms, double* gains) {
    const std::size_t count = end - begin;
    PriorPlaces places;
    places.points = group.order + begin;
    if (group.neighbors > 0) {
        find_neighborhoods(group, count, doubles, all_numbers, places);
    } else {
        places.around[0] = {0, 0, 1.0};
        places.numbers[0] = all_numbers;
        places.end_of_equals[0] = 1;
        places.inverse_masses[0] = 1.0;
    }
    PendingGains pending;
    std::size_t singles[prior_block_size];
    const std::size_t num_singles = order_singles(places, count, singles);
    for (std::size_t v = 0; v < group.vectors; ++v) {
        // One vector of posteriors after the other: its rows stay in the first cache.
        const double* const rows = group.weights + v * group.count * lane_count;
        const auto has_weight = [&](std::size_t place) HOLDFAST_LAMBDA {
            const std::size_t n = places.points[place];
            store(gains + (n * group.vectors + v) * lane_count, Lanes{});
            return bits_of(load(rows + n * lane_count) > 0.0) != 0;
        };
        Lanes sums[sums_together];
        for (std::size_t place = 0; place < count;) {
            const std::size_t end_of_equals = places.end_of_equals[place];
            if (end_of_equals - place == 1) {
                ++place;
                continue;
            }
            const std::uint32_t* const numbers = places.numbers[place];
            const std::size_t members = places.around[place].members + 1;
            std::size_t begun = 0;
            Lanes before{};
            while (place < end_of_equals) {
                std::size_t here[sums_together], own[sums_together], found = 0;
                for (; place < end_of_equals && found < sums_together; ++place) {
                    if (has_weight(place)) here[found++] = place;
                }
                if (found == 0) break;
                for (std::size_t i = 0; i < sums_together; ++i) {
                    own[i] = places.own[here[i < found ? i : found - 1]];
                }
                sum_ball(rows, numbers, members, own, begun, before, sums);
                for (std::size_t i = 0; i < found; ++i) {
                    take_gain(group, places, here[i], v, rows, sums[i], pending);
                }
            }
        }
        std::size_t chosen[prior_block_size], number = 0;
        for (std::size_t s = 0; s < num_singles; ++s) {
            // Without a branch, which would often be predicted wrongly.
            chosen[number] = singles[s];
            number += has_weight(singles[s]) ? 1 : 0;
        }
        for (std::size_t first = 0; first < number; first += sums_together) {
            const std::size_t here =
                number - first < sums_together ? number - first : sums_together;
            const std::uint32_t* numbers[sums_together];
            std::size_t members[sums_together];
            for (std::size_t i = 0; i < sums_together; ++i) {
                const std::size_t place = chosen[first + (i < here ? i : here - 1)];
                numbers[i] = places.numbers[place];
                members[i] = places.around[place].members;
            }
            Lanes totals[sums_together] = {};
            sum_rows(rows, numbers, members, totals);
            for (std::size_t i = 0; i < sums_together; ++i) sums[i] = totals[i];
            for (std::size_t i = 0; i < here; ++i) {
                take_gain(group, places, chosen[first + i], v, rows, sums[i], pending);
            }
        }
        pending.put(gains);
    }
    for (std::size_t first = 0; group.neighbors > 0 && first < count; first += lane_count) {
        const std::size_t used = count - first < lane_count ? count - first : lane_count;
        const std::size_t part = first / lane_count;
        const Lanes own = prior_terms(group, places.priors[part], places.masses[part],
                                      places.around + first, used);
        for (std::size_t i = 0; i < used; ++i) terms[places.points[first + i]] = own[i];
    }
}

}  // namespace holdfast::inline HOLDFAST_ISA
