#include "entropy.hpp"

#include <algorithm>
#include <atomic>
#include <limits>
#include <memory>
#include <vector>

#include "deterministic_math.hpp"
#include "kept_memory.hpp"
#include "point_sample.hpp"
#include "point_tree.hpp"
#include "prior_neighbors.hpp"
#include "thread_pool.hpp"
#include "vector_kernels.hpp"

namespace holdfast {

namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

// The ways to an entropy and when which is taken. All give the same values up to rounding, and the
// choice depends on counts alone, so the bits do not depend on threads or machines.
//  - pair by pair: a posterior of few points, quadratic in them;
//  - own tree: one posterior, a tree over its points; of few points all pairs, added in its order;
//  - grouped: posteriors that keep a good part of the points share one tree over all of them.
// The costs are nanoseconds, measured in three dimensions; they need to be right within a factor of
// two.
constexpr std::size_t compact_limit = 24;
// Of all points: below it the lists of near points hold too few of a posterior.
constexpr double grouped_share = 0.12;
constexpr double grouped_cost_of_a_point = 1000.0;
constexpr double cost_of_making = 80.0;  // the tree and the group, of it
// Points up to which all terms are added, and a tree's leaves are taken one by one. Beyond it the
// terms are those of a sample, if the settings say so, and a tree's leaves are taken in blocks:
// faster where the points are dense, but sums are rounded otherwise. So this number changes bits.
std::atomic<std::size_t> few_up_to{initially_few_up_to};
// Points in the sample for a posterior with its own tree; that for the groups is in the header.
// They are chosen for 100,000 particles: a decision with the largest errors that still takes less
// than a second of two threads (docs/decisions/many_entropies.md).
constexpr double sample_of_one = 512.0;
constexpr double fewest_of_a_posterior = 128.0;
// Nanoseconds for each likelihood, with the entropies that follow.
constexpr double work_that_follows = 10.0;

double cost_alone(std::size_t survivors) {
    const auto size = static_cast<double>(survivors);
    if (survivors <= compact_limit) return size * (60.0 + 5.0 * size);
    return size * std::min(30.0 + 1.1 * size, 420.0);
}

/// [q] = log q - psi(q), psi(q) = -gamma + 1 + 1/2 + ... + 1/(q - 1). Grows and is kept per thread.
const double* bias_corrections(std::size_t largest) {
    constexpr double euler_gamma = 0.57721566490153286061;
    thread_local std::vector<double> table{0.0};
    thread_local double harmonic = 0.0;  // 1 + ... + 1/(table.size() - 1)
    while (table.size() <= largest) {
        const auto q = static_cast<double>(table.size());
        table.push_back(log(q) + euler_gamma - harmonic);
        harmonic += 1.0 / q;
    }
    return table.data();
}

/// log of the unit ball's volume: c_0 = 1, c_1 = 2, c_d = c_{d-2} 2 pi / d.
double log_unit_ball(std::size_t dimension) {
    constexpr double two_pi = 6.28318530717958647693;
    double volume = dimension % 2 == 0 ? 1.0 : 2.0;
    for (std::size_t d = 2 + dimension % 2; d <= dimension; d += 2) {
        volume = volume * two_pi / static_cast<double>(d);
    }
    return log(volume);
}

struct Task {
    const double* points;
    std::size_t count;
    std::size_t dimension;
    const EntropySettings* settings;
    NearestNeighborConstants constants;
    const VectorKernels* kernels;
    bool sampled;  // the terms of a sample stand for all, where there are enough
};

std::uint32_t neighbors_among(const Task& task, std::size_t survivors) {
    return static_cast<std::uint32_t>(
        std::min<std::size_t>(task.settings->neighbors, survivors - 1));
}

/// sum_n w_n |u_n - mean|^2, in two passes.
double total_variance(const Task& task, const double* weights) {
    std::vector<double> mean(task.dimension);
    task.kernels->weighted_sums(weights, task.points, task.count, task.dimension, mean.data());
    double total = 0.0;
    for (std::size_t n = 0; n < task.count; ++n) {
        double distance = 0.0;
        for (std::size_t c = 0; c < task.dimension; ++c) {
            const double difference = task.points[n * task.dimension + c] - mean[c];
            distance += difference * difference;
        }
        total += weights[n] * distance;
    }
    return total;
}

/// A single surviving point: its action is known to within the resolution (or the motion noise).
double entropy_of_one(const Task& task) {
    if (task.settings->estimator == Estimator::gaussian_mixture) return 0.0;
    return task.constants.log_ball_volume +
           static_cast<double>(task.dimension) * log(task.constants.resolution);
}

/// Puts some points' numbers into the order of a tree over these points.
void put_in_order_of_tree(const Task& task, std::vector<std::uint32_t>& numbers) {
    std::vector<double> points(numbers.size() * task.dimension);
    for (std::size_t i = 0; i < numbers.size(); ++i) {
        const double* own = task.points + numbers[i] * task.dimension;
        std::copy(own, own + task.dimension, points.begin() + i * task.dimension);
    }
    const PointTree tree(points.data(), numbers.size(), task.dimension);
    const std::vector<std::uint32_t> before = numbers;
    for (std::size_t i = 0; i < numbers.size(); ++i) numbers[i] = before[tree.order[i]];
}

/// Whether a posterior that has points of its own is one of `few_nearest`.
bool are_few(const Task& task, std::size_t survivors) {
    return survivors <= few_points && task.settings->neighbors <= 8 &&
           task.settings->estimator == Estimator::nearest_neighbor;
}

/// The surviving points of one posterior, coordinate by coordinate, for `compact_*` and
/// `few_nearest`.
double compact_entropy(const Task& task, const double* weights, std::size_t survivors,
                       std::uint64_t& visits) {
    const std::size_t stride = (survivors + leaf_size - 1) / leaf_size * leaf_size;
    thread_local std::vector<double> buffer;
    buffer.resize(stride * (task.dimension + 1) + lane_count * (stride + task.settings->neighbors));
    double* coordinates = buffer.data();
    double* compact_weights = coordinates + stride * task.dimension;
    thread_local std::vector<std::uint32_t> kept;
    kept.clear();
    for (std::uint32_t n = 0; n < task.count; ++n) {
        if (weights[n] != 0.0) kept.push_back(n);
    }
    if (survivors > unsorted_leaves * leaf_size) put_in_order_of_tree(task, kept);
    std::size_t at = 0;
    for (const std::uint32_t n : kept) {
        for (std::size_t c = 0; c < task.dimension; ++c) {
            coordinates[c * stride + at] = task.points[n * task.dimension + c];
        }
        compact_weights[at++] = weights[n];
    }
    for (; at < stride; ++at) {
        for (std::size_t c = 0; c < task.dimension; ++c) coordinates[c * stride + at] = infinity;
        compact_weights[at] = 0.0;
    }
    const CompactPosterior posterior{survivors,   stride,          task.dimension,
                                     coordinates, compact_weights, compact_weights + stride};
    if (task.settings->estimator == Estimator::gaussian_mixture) {
        return task.kernels->compact_mixture(posterior, task.settings->exponent, &visits);
    }
    const auto nearest =
        survivors > compact_limit ? task.kernels->few_nearest : task.kernels->compact_nearest;
    return nearest(posterior, neighbors_among(task, survivors), task.constants, &visits);
}

/// A sample of about `size` points, or null if all terms are added.
std::unique_ptr<PointSample> sample_of(const Task& task, const PointTree& tree,
                                       const double* greatest, double size) {
    if (!task.sampled || static_cast<double>(tree.count) < 2.0 * size) return nullptr;
    return std::make_unique<PointSample>(tree, greatest, size, fewest_of_a_posterior);
}

/// Posteriors side by side over one tree; owns what PosteriorGroup points to.
class Group {
  public:
    Group(const Task& task, const PointTree& tree, const std::vector<const double*>& weights,
          const std::vector<std::size_t>& survivors, const PointSample* sample)
        : task_(task),
          members_(weights.size()),
          leaves_of_piece_((tree.count > few_up_to || sample != nullptr) &&
                                   task.settings->estimator == Estimator::nearest_neighbor
                               ? block_leaves
                               : 1),
          leaves_(sample != nullptr ? sample->leaves() : tree.leaves) {
        const std::size_t vectors = (members_ + lane_count - 1) / lane_count;
        const std::size_t columns = vectors * lane_count;
        const std::size_t slots = tree.leaves * leaf_size;
        weights_.resize(slots * columns);
        significant_.resize(slots * columns);
        for (std::size_t slot = 0; slot < tree.count; ++slot) {
            const std::uint32_t point = tree.order[slot];
            double* row = &weights_[slot * columns];
            std::uint32_t* mask = &significant_[slot * columns];
            for (std::size_t member = 0; member < members_; ++member) {
                row[member] = weights[member][point];
                mask[member] = row[member] != 0.0 ? 1 : 0;
            }
        }
        block_weights_.resize(slots / lane_count * columns);
        block_counts_.resize(slots / lane_count * columns);
        for (std::size_t slot = 0; slot < tree.count; ++slot) {
            for (std::size_t column = 0; column < columns; ++column) {
                const std::size_t block = slot / lane_count * columns + column;
                block_weights_[block] += weights_[slot * columns + column];
                block_counts_[block] += significant_[slot * columns + column];
            }
        }
        node_weights_.resize(tree.nodes.size() * columns);
        node_counts_.resize(tree.nodes.size() * columns);
        for (std::size_t at = tree.nodes.size(); at-- > 0;) {
            const TreeNode& node = tree.nodes[at];
            double* mass = &node_weights_[at * columns];
            std::uint32_t* number = &node_counts_[at * columns];
            if (node.left == 0) {
                constexpr std::size_t blocks = leaf_size / lane_count;
                for (std::size_t block = node.first_leaf * blocks;
                     block < (node.first_leaf + 1) * blocks; ++block) {
                    for (std::size_t column = 0; column < columns; ++column) {
                        mass[column] += block_weights_[block * columns + column];
                        number[column] += block_counts_[block * columns + column];
                    }
                }
            } else {
                for (std::size_t column = 0; column < columns; ++column) {
                    mass[column] = node_weights_[node.left * columns + column] +
                                   node_weights_[node.right * columns + column];
                    number[column] = node_counts_[node.left * columns + column] +
                                     node_counts_[node.right * columns + column];
                }
            }
        }
        neighbors_.resize(columns);
        for (std::size_t member = 0; member < members_; ++member) {
            neighbors_[member] = neighbors_among(task, survivors[member]);
        }
        if (sample != nullptr) {
            const SampleView view = sample->view();
            sampled_.resize(columns);
            for (std::size_t i = 0; i < view.count; ++i) {
                for (std::size_t column = 0; column < columns; ++column) {
                    sampled_[column] +=
                        view.factors[i] * weights_[view.slots[i] * columns + column];
                }
            }
        }
        view_ = {tree.view(),
                 sample != nullptr ? sample->view() : SampleView{},
                 members_,
                 vectors,
                 weights_.data(),
                 significant_.data(),
                 block_weights_.data(),
                 block_counts_.data(),
                 node_weights_.data(),
                 node_counts_.data(),
                 neighbors_.data()};
        partial_.resize(pieces() * columns);
        visited_.resize(pieces());
    }

    /// The leaves are worked on in so many pieces, from several threads at once.
    std::size_t pieces() const { return (leaves_ + leaves_of_piece_ - 1) / leaves_of_piece_; }

    /// The terms of the points of a piece.
    void add_piece(std::size_t piece) {
        const std::size_t leaf = piece * leaves_of_piece_;
        double* terms = &partial_[piece * view_.vectors * lane_count];
        std::uint64_t* visits = &visited_[piece];
        thread_local std::vector<double> scratch;
        scratch.resize(task_.settings->neighbors);
        if (task_.settings->estimator == Estimator::gaussian_mixture) {
            task_.kernels->group_mixture(view_, leaf, task_.settings->exponent, terms, visits);
        } else if (leaves_of_piece_ == 1) {
            task_.kernels->group_nearest(view_, leaf, task_.constants, scratch.data(), terms,
                                         visits);
        } else {
            task_.kernels->block_nearest(view_, leaf, std::min(leaves_of_piece_, leaves_ - leaf),
                                         task_.constants, scratch.data(), terms, visits);
        }
    }

    /// Partial sums are added in the order of the pieces.
    double entropy(std::size_t member) const {
        double sum = 0.0;
        for (std::size_t piece = 0; piece < pieces(); ++piece) {
            sum += partial_[piece * view_.vectors * lane_count + member];
        }
        return sampled_.empty() ? sum : sum / sampled_[member];
    }

    std::uint64_t visits() const {
        std::uint64_t total = 0;
        for (const std::uint64_t v : visited_) total += v;
        return total;
    }

  private:
    const Task& task_;
    std::size_t members_, leaves_of_piece_, leaves_;
    KeptVector<double> weights_, block_weights_, node_weights_;
    KeptVector<double> sampled_;  // of each member the weight in the sample; empty without one
    KeptVector<std::uint32_t> significant_, block_counts_, node_counts_, neighbors_;
    KeptVector<double> partial_;
    KeptVector<std::uint64_t> visited_;
    PosteriorGroup view_{};
};

/// One posterior with many points, but few of all: a tree of its own.
double own_tree_entropy(const Task& task, const double* weights, std::size_t survivors,
                        std::uint64_t& visits) {
    KeptVector<double> points, kept;
    points.reserve(survivors * task.dimension);
    kept.reserve(survivors);
    for (std::size_t n = 0; n < task.count; ++n) {
        if (weights[n] == 0.0) continue;
        points.insert(points.end(), task.points + n * task.dimension,
                      task.points + (n + 1) * task.dimension);
        kept.push_back(weights[n]);
    }
    Task own = task;
    own.points = points.data();
    own.count = survivors;
    const PointTree tree(own.points, own.count, own.dimension);
    const auto sample = sample_of(task, tree, kept.data(), sample_of_one);
    Group group(own, tree, {kept.data()}, {survivors}, sample.get());
    for (std::size_t piece = 0; piece < group.pieces(); ++piece) group.add_piece(piece);
    visits += group.visits();
    return group.entropy(0);
}

}  // namespace

std::size_t take_as_few_up_to(std::size_t points) {
    return few_up_to.exchange(points);
}

void entropies(const PointSets& sets, std::size_t posteriors, const PosteriorSource& source,
               const EntropySettings& settings, double* out, EntropyCounts& counts) {
    const bool shared = settings.estimator == Estimator::prior_neighbors;
    const bool nearest = shared || settings.estimator == Estimator::nearest_neighbor;
    const std::size_t count = sets.count;
    const NearestNeighborConstants constants{settings.resolution,
                                             nearest ? log_unit_ball(sets.dimension) : 0.0,
                                             nearest ? bias_corrections(count) : nullptr};
    std::vector<Task> tasks;
    for (std::size_t set = 0; set < sets.number; ++set) {
        tasks.push_back({sets.points + set * count * sets.dimension, count, sets.dimension,
                         &settings, constants, &vector_kernels(),
                         settings.sampled && count > few_up_to});
    }
    // Posteriors are taken in batches: their weights fill 64 MB, or those of one group if that is
    // more.
    const std::size_t batch =
        std::max<std::size_t>(max_group_lanes, (std::size_t{8} << 20) / count);
    KeptVector<double> weights(std::min(batch, posteriors) * count);
    std::vector<std::size_t> survivors(std::min(batch, posteriors));
    std::vector<std::unique_ptr<PointTree>> trees(sets.number);
    // Sets whose groups are worked on at once: a group takes 400 bytes for each particle.
    const std::size_t together =
        std::max<std::size_t>(1, std::min(sets.number, (std::size_t{1} << 20) / count));

    for (std::size_t first = 0; first < posteriors; first += batch) {
        const std::size_t number = std::min(batch, posteriors - first);
        // A likelihood takes about a nanosecond, and the entropies several times as long. Helpers
        // that are woken for the likelihoods (from 400 particles and 30 posteriors on) are there
        // when the entropies begin.
        const double likelihoods = static_cast<double>(number) * static_cast<double>(count);
        std::vector<double> values(sets.number * number);  // [set][posterior]
        std::vector<std::uint64_t> visits(sets.number * number);
        parallel_for(number, threads_for(work_that_follows * likelihoods, number, settings.threads),
                     [&](std::size_t i) { survivors[i] = source(first + i, &weights[i * count]); });
        counts.likelihoods += number * count;

        // What becomes of a posterior depends on the number of its points alone, so it is the same
        // for all sets.
        const double shared_from = grouped_share * static_cast<double>(count);
        double candidates_alone = 0.0;
        std::size_t candidates = 0;
        for (std::size_t i = 0; i < number; ++i) {
            const std::size_t s = survivors[i];
            if (s <= compact_limit || static_cast<double>(s) < shared_from) continue;
            candidates_alone += cost_alone(s);
            ++candidates;
        }
        const std::size_t groups = (candidates + max_group_lanes - 1) / max_group_lanes;
        const bool group_them =
            candidates_alone >
            static_cast<double>(groups) * static_cast<double>(count) * grouped_cost_of_a_point;
        const bool variance = settings.estimator == Estimator::total_variance;
        std::vector<std::size_t> alone, grouped;
        double work_alone = 0.0;
        for (std::size_t i = 0; i < number; ++i) {
            const std::size_t s = survivors[i];
            if (shared) continue;
            if (s == 0 || (s == 1 && !variance)) {
                const double value = s == 0 ? std::numeric_limits<double>::quiet_NaN()
                                            : entropy_of_one(tasks[0]) + settings.offset;
                for (std::size_t set = 0; set < sets.number; ++set) {
                    values[set * number + i] = value;
                }
            } else if (variance) {
                alone.push_back(i);
                work_alone += work_that_follows * static_cast<double>(count);
            } else if (group_them && s > compact_limit && static_cast<double>(s) >= shared_from) {
                grouped.push_back(i);
                counts.grouped += sets.number;
            } else {
                alone.push_back(i);
                (s <= compact_limit ? counts.pair_by_pair : counts.own_tree) += sets.number;
                work_alone += cost_alone(s);
            }
        }
        if (shared) {
            prior_entropies(sets, weights.data(), survivors, number, settings, constants,
                            values.data());
            counts.visits += sets.number * count * count;
            for (std::size_t i = 0; i < values.size(); ++i) {
                values[i] = survivors[i % number] == 0 ? std::numeric_limits<double>::quiet_NaN()
                                                       : values[i] + settings.offset;
            }
        }
        // One sample for all groups: what they have in common in its error favours none of them.
        std::vector<std::unique_ptr<PointSample>> samples(sets.number);
        std::vector<double> greatest(tasks[0].sampled ? count : 0);
        for (std::size_t n = 0; n < greatest.size(); ++n) {
            for (const std::size_t i : grouped) {
                greatest[n] = std::max(greatest[n], weights[i * count + n]);
            }
        }
        const auto make_group = [&](std::size_t begin, std::size_t set) {
            const std::size_t end = std::min(begin + max_group_lanes, grouped.size());
            std::vector<const double*> members;
            std::vector<std::size_t> sizes;
            for (std::size_t g = begin; g < end; ++g) {
                members.push_back(&weights[grouped[g] * count]);
                sizes.push_back(survivors[grouped[g]]);
            }
            const Task& task = tasks[set];
            if (!trees[set]) {
                trees[set] = std::make_unique<PointTree>(task.points, count, task.dimension);
            }
            if (begin == 0) {
                samples[set] = sample_of(task, *trees[set], greatest.data(), sample_of_groups);
            }
            return std::make_unique<Group>(task, *trees[set], members, sizes, samples[set].get());
        };
        // The first groups are made while other threads work on posteriors alone.
        std::vector<std::unique_ptr<Group>> shared_groups(
            grouped.empty() ? 0 : std::min(together, sets.number));
        const std::size_t to_make = shared_groups.size();
        const std::size_t pieces = to_make + sets.number * alone.size();
        const double work_before =
            static_cast<double>(sets.number) * work_alone +
            cost_of_making * static_cast<double>(to_make) * static_cast<double>(count);
        parallel_for(pieces, threads_for(work_before, pieces, settings.threads),
                     [&](std::size_t task_number) {
                         if (task_number < to_make) {
                             shared_groups[task_number] = make_group(0, task_number);
                             return;
                         }
                         const std::size_t piece = task_number - to_make;
                         const std::size_t set = piece / alone.size();
                         const std::size_t i = alone[piece % alone.size()];
                         const std::size_t at = set * number + i;
                         const Task& task = tasks[set];
                         const double* w = &weights[i * count];
                         if (variance) {
                             values[at] = total_variance(task, w);
                             visits[at] = count;
                         } else if (survivors[i] <= compact_limit || are_few(task, survivors[i])) {
                             values[at] = settings.offset +
                                          compact_entropy(task, w, survivors[i], visits[at]);
                         } else {
                             values[at] = settings.offset +
                                          own_tree_entropy(task, w, survivors[i], visits[at]);
                         }
                     });
        for (const std::uint64_t v : visits) counts.visits += v;

        for (std::size_t begin = 0; begin < grouped.size(); begin += max_group_lanes) {
            const std::size_t end = std::min(begin + max_group_lanes, grouped.size());
            for (std::size_t from = 0; from < sets.number; from += together) {
                const std::size_t here = std::min(together, sets.number - from);
                const double work = grouped_cost_of_a_point * static_cast<double>(here) *
                                    static_cast<double>(count);
                if (begin > 0 || from > 0) {
                    shared_groups.resize(here);
                    parallel_for(here, threads_for(work, here, settings.threads),
                                 [&](std::size_t h) {
                                     shared_groups[h].reset();  // or both would take memory
                                     shared_groups[h] = make_group(begin, from + h);
                                 });
                }
                const std::size_t pieces = shared_groups[0]->pieces();
                parallel_for(here * pieces, threads_for(work, here * pieces, settings.threads),
                             [&](std::size_t piece) {
                                 shared_groups[piece / pieces]->add_piece(piece % pieces);
                             });
                for (std::size_t h = 0; h < here; ++h) {
                    counts.visits += shared_groups[h]->visits();
                    for (std::size_t g = begin; g < end; ++g) {
                        values[(from + h) * number + grouped[g]] =
                            settings.offset + shared_groups[h]->entropy(g - begin);
                    }
                }
            }
        }
        for (std::size_t i = 0; i < number; ++i) {
            double sum = sets.factors[0] * values[i];
            for (std::size_t set = 1; set < sets.number; ++set) {
                sum += sets.factors[set] * values[set * number + i];
            }
            out[first + i] = sum;
        }
    }
}

}  // namespace holdfast
