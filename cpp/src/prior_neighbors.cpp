#include "prior_neighbors.hpp"

#include <algorithm>
#include <bit>
#include <limits>
#include <memory>
#include <numeric>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "deterministic_math.hpp"
#include "thread_pool.hpp"

namespace holdfast {

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
// Nanoseconds for a distance with its part in the choice of the nearest, and for the sums of a
// point and eight posteriors.
constexpr double cost_of_a_pair = 0.6;
constexpr double cost_of_sums = 40.0;
// Gains that are kept at once: 16 MB.
constexpr std::size_t most_gains = std::size_t{1} << 21;

/// Doubles that begin with a line of the cache, and are not set at first: between two rounds of
/// work the helpers wait, and the numbers are many.
class Lined {
  public:
    explicit Lined(std::size_t count = 0) { resize(count); }
    /// Makes room; what was there is gone if it is more than ever before.
    void resize(std::size_t count) {
        if (count <= room_) return;
        room_ = count;
        lines_ = std::make_unique_for_overwrite<Line[]>((count + lane_count - 1) / lane_count);
    }
    double* data() { return lines_[0].values; }
    const double* data() const { return lines_[0].values; }
    double& operator[](std::size_t i) { return data()[i]; }

  private:
    struct alignas(64) Line {
        double values[lane_count];
    };
    std::size_t room_ = 0;
    std::unique_ptr<Line[]> lines_;
};

/// The points of positive prior weight of one set, coordinate by coordinate, without those that are
/// the same in all points: a policy often leaves some alone, and they add nothing to a distance.
struct Coordinates {
    std::size_t varying = 0;
    Lined values;
    std::vector<std::uint32_t> order;  // equal points beside each other, in the order of numbers

    Coordinates(const PointSets& sets, std::size_t set, const std::vector<std::uint32_t>& present,
                std::size_t stride)
        : values(sets.dimension * stride) {
        const double* points = sets.points + set * sets.count * sets.dimension;
        for (std::size_t c = 0; c < sets.dimension; ++c) {
            double* const own = values.data() + varying * stride;
            bool varies = varying == 0 && c + 1 == sets.dimension;
            for (std::size_t i = 0; i < present.size(); ++i) {
                own[i] = points[present[i] * sets.dimension + c];
                varies |= own[i] != own[0];
            }
            std::fill(own + present.size(), own + stride, infinity);
            varying += varies ? 1 : 0;
        }
        bring_together_equals(present.size(), stride);
    }

  private:
    void bring_together_equals(std::size_t size, std::size_t stride);
};

/// By a table of hashes, in which each point finds the first one that is equal to it.
void Coordinates::bring_together_equals(std::size_t size, std::size_t stride) {
    constexpr std::uint32_t nobody = 0xffffffffu;
    constexpr std::size_t few = 128;  // their sums take less time than the search
    order.resize(size);
    std::iota(order.begin(), order.end(), 0u);
    if (size <= few) return;
    std::size_t slots = 2 * few;
    while (slots < 2 * size) slots *= 2;
    std::vector<std::uint32_t> table(slots, nobody), class_of(size), first_of, begins;
    for (std::uint32_t n = 0; n < size; ++n) {
        std::uint64_t hash = 0;
        for (std::size_t c = 0; c < varying; ++c) {
            // Of -0 the bits of 0, to which it is equal.
            const auto bits = std::bit_cast<std::uint64_t>(values.data()[c * stride + n] + 0.0);
            hash = (hash ^ bits) * 0x9e3779b97f4a7c15u;
            hash ^= hash >> 32;
        }
        std::size_t slot = hash & (slots - 1);
        const auto is_equal = [&](std::uint32_t other) {
            for (std::size_t c = 0; c < varying; ++c) {
                const double* const column = values.data() + c * stride;
                if (column[n] != column[other]) return false;
            }
            return true;
        };
        while (table[slot] != nobody && !is_equal(first_of[table[slot]])) {
            slot = (slot + 1) & (slots - 1);
        }
        if (table[slot] == nobody) {
            table[slot] = static_cast<std::uint32_t>(first_of.size());
            first_of.push_back(n);
            begins.push_back(0);
        }
        class_of[n] = table[slot];
        ++begins[class_of[n]];
    }
    std::uint32_t begin = 0;
    for (std::uint32_t& each : begins) begin += std::exchange(each, begin);
    for (std::uint32_t n = 0; n < size; ++n) order[begins[class_of[n]]++] = n;
}

/// Writes the rows of a vector: of eight posteriors, in some order, of which the first of all is
/// the prior.
void write_rows(const std::vector<std::uint32_t>& present, const double* prior,
                const double* weights, std::size_t count, std::span<const std::size_t> order,
                std::size_t vector, double* to) {
    const std::vector<double> nothing(count);
    const double* columns[lane_count];
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        const std::size_t column = vector * lane_count + lane;
        columns[lane] = column == 0              ? prior
                        : column <= order.size() ? weights + order[column - 1] * count
                                                 : nothing.data();
    }
    // Row by row: column by column they would go through the first cache eight times.
    for (std::size_t i = 0; i < present.size(); ++i) {
        for (std::size_t lane = 0; lane < lane_count; ++lane) {
            to[i * lane_count + lane] = columns[lane][present[i]];
        }
    }
}

}  // namespace

void prior_entropies(const PointSets& sets, const double* weights,
                     const std::vector<std::size_t>& survivors, std::size_t number,
                     const EntropySettings& settings, const NearestNeighborConstants& constants,
                     double* out) {
    std::vector<std::uint32_t> present;
    for (std::size_t n = 0; n < sets.count; ++n) {
        if (settings.prior[n] > 0.0) present.push_back(static_cast<std::uint32_t>(n));
    }
    const std::size_t size = present.size();
    const std::size_t stride = (size + lane_count - 1) / lane_count * lane_count;
    const std::size_t blocks = (size + prior_block_size - 1) / prior_block_size;
    const auto k = static_cast<std::uint32_t>(std::min<std::size_t>(settings.neighbors, size - 1));
    // Posteriors of many points beside each other, and beside the prior: then those of few leave
    // out most points together.
    std::vector<std::size_t> order(number);
    std::iota(order.begin(), order.end(), std::size_t{0});
    std::stable_sort(order.begin(), order.end(),
                     [&](std::size_t a, std::size_t b) { return survivors[a] > survivors[b]; });
    // As many posteriors at a time as one set allows, then as many sets.
    const std::size_t most = std::max<std::size_t>(lane_count, most_gains / size) - 1;
    for (std::size_t first = 0; first < number; first += most) {
        const std::size_t here = std::min(most, number - first);
        const std::size_t vectors = (1 + here + lane_count - 1) / lane_count;
        const std::size_t columns = vectors * lane_count;
        const std::span<const std::size_t> own(order.data() + first, here);
        const std::size_t together =
            std::clamp<std::size_t>(most_gains / (size * columns), 1, sets.number);
        Lined rows(size * columns), gains(together * size * columns), terms(together * size);
        for (std::size_t from = 0; from < sets.number; from += together) {
            const std::size_t of_sets = std::min(together, sets.number - from);
            const double work =
                static_cast<double>(of_sets * size) * (cost_of_a_pair * static_cast<double>(size) +
                                                       cost_of_sums * static_cast<double>(vectors));
            // Helpers that wait while one thread prepares may go to sleep.
            std::vector<std::optional<Coordinates>> coordinates(of_sets);
            const std::size_t to_write = from == 0 ? vectors : 0;
            parallel_for(of_sets + to_write,
                         threads_for(work, of_sets + to_write, settings.threads),
                         [&](std::size_t i) {
                             if (i < of_sets) {
                                 coordinates[i].emplace(sets, from + i, present, stride);
                                 return;
                             }
                             const std::size_t v = i - of_sets;
                             write_rows(present, settings.prior, weights, sets.count, own, v,
                                        rows.data() + v * size * lane_count);
                         });
            const std::size_t pieces = of_sets * blocks;
            parallel_for(pieces, threads_for(work, pieces, settings.threads), [&](std::size_t i) {
                const std::size_t h = i / blocks, begin = i % blocks * prior_block_size;
                thread_local Lined scratch;
                thread_local std::vector<std::uint32_t> numbers;
                scratch.resize(10 * stride + 9 * k);
                numbers.resize(prior_block_size * (stride + 2 * lane_count));
                vector_kernels().prior_block(
                    {size, stride, sets.dimension, coordinates[h]->varying,
                     coordinates[h]->values.data(), coordinates[h]->order.data(), vectors,
                     rows.data(), k, constants},
                    begin, std::min(begin + prior_block_size, size), scratch.data(), numbers.data(),
                    &terms[h * size], &gains[h * size * columns]);
            });
            for (std::size_t h = 0; h < of_sets; ++h) {
                // A single point is known to within the resolution.
                double entropy = 0.0;
                if (k == 0) {
                    entropy = constants.log_ball_volume +
                              static_cast<double>(sets.dimension) * log(constants.resolution);
                } else {
                    for (std::size_t n = 0; n < size; ++n) entropy += terms[h * size + n];
                }
                std::vector<double> gained(columns);
                for (std::size_t n = 0; n < size; ++n) {
                    const double* gain = &gains[(h * size + n) * columns];
                    for (std::size_t column = 0; column < columns; ++column) {
                        gained[column] += gain[column];
                    }
                }
                for (std::size_t p = 0; p < here; ++p) {
                    out[(from + h) * number + own[p]] = entropy - gained[1 + p];
                }
            }
        }
        // Weight where the prior has none is without bound.
        for (std::size_t p = 0; p < here && size < sets.count; ++p) {
            bool outside = false;
            for (std::size_t n = 0; n < sets.count; ++n) {
                outside |= weights[own[p] * sets.count + n] > 0.0 && !(settings.prior[n] > 0.0);
            }
            for (std::size_t set = 0; set < sets.number && outside; ++set) {
                out[set * number + own[p]] = infinity;
            }
        }
    }
}

}  // namespace holdfast
