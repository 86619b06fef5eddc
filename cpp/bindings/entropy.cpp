#include "entropy.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <chrono>
#include <cstring>
#include <optional>
#include <vector>

#include "bindings.hpp"
#include "sensing.hpp"
#include "thread_pool.hpp"
#include "vector_kernels.hpp"

namespace nb = nanobind;
using namespace holdfast;
using namespace holdfast::bindings;

namespace {

using Flag = nb::ndarray<std::uint8_t, nb::shape<1>, nb::c_contig, nb::device::cpu>;

// About what one particle of a posterior takes; from it follows how many threads are worth their
// waking.
constexpr double nanoseconds_of_a_point = 100.0;

EntropySettings make_settings(Estimator estimator, std::uint32_t neighbors, double resolution,
                              double exponent, double offset, int threads, const Input<1>& prior,
                              std::size_t count, bool sampled = true) {
    if (estimator == Estimator::prior_neighbors && prior.shape(0) != count) {
        throw nb::value_error("prior and weights do not fit");
    }
    return {estimator, neighbors, resolution, exponent, offset, threads, prior.data(), sampled};
}

/// `number` as in `EstimatorKind` of planning/estimators.py.
Estimator to_estimator(int number) {
    switch (number) {
        case 0:
            return Estimator::nearest_neighbor;
        case 1:
            return Estimator::gaussian_mixture;
        case 2:
            return Estimator::total_variance;
        case 3:
            return Estimator::prior_neighbors;
        default:
            throw nb::value_error("there is no such estimator");
    }
}

HypothesisInput make_input(const Input<1>& weights, const std::vector<std::uint32_t>& sizes,
                           const Input<2>& predicted, const Input<2>& variance, std::size_t samples,
                           const StreamWords& stream, bool drop_negligible,
                           const std::vector<std::uint8_t>& circular) {
    return {weights.shape(0),
            weights.data(),
            sizes.size(),
            sizes.data(),
            predicted.data(),
            variance.data(),
            variance.shape(1) != 1,
            samples,
            to_stream(stream),
            drop_negligible,
            circular.empty() ? nullptr : circular.data()};
}

/// The sets stand one below the other; each has a point for every particle.
PointSets make_sets(const Input<2>& points, std::size_t count, const std::vector<double>& factors) {
    if (factors.empty() || points.shape(0) != factors.size() * count) {
        throw nb::value_error("points and factors do not fit");
    }
    return {points.data(), count, points.shape(1), factors.size(), factors.data()};
}

double seconds_since(std::chrono::steady_clock::time_point start) {
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

}  // namespace

void holdfast::bind_entropy(nb::module_& module) {
    define(module, "use_threads_from",
           [](double nanoseconds) { return use_threads_from(nanoseconds); });
    module.attr("few_up_to") = initially_few_up_to;
    module.attr("sample_of_groups") = sample_of_groups;
    define(module, "take_as_few_up_to",
           [](std::size_t points) { return take_as_few_up_to(points); });
    define(module, "threads_started", [] { return threads_started(); });
    // The caller keeps the flag alive until it watches another one, or none.
    define(
        module, "watch_interruption",
        [](std::optional<Flag> flag, double most_s) {
            watch_interruption(flag ? flag->data() : nullptr, most_s);
        },
        nb::arg("flag").none(), nb::arg("most_s"));
    define(module, "is_interrupted", [] { return is_interrupted(); });

    define(
        module, "entropies",
        [](const Input<2>& points, const Input<2>& rows_in, bool logarithms, int number,
           std::uint32_t neighbors, double resolution, double exponent, double offset, int threads,
           const std::vector<double>& factors, const Input<1>& prior, bool sampled) {
            const std::size_t posteriors = rows_in.shape(0), count = rows_in.shape(1);
            const PointSets sets = make_sets(points, count, factors);
            double* out;
            auto result = make_array<double>({posteriors}, out);
            EntropyCounts counts;
            const Estimator estimator = to_estimator(number);
            const EntropySettings settings = make_settings(
                estimator, neighbors, resolution, exponent, offset, threads, prior, count, sampled);
            const bool drop = drops_negligible(estimator);
            {
                WithoutInterpreter released;
                const VectorKernels& kernels = vector_kernels();
                const double* rows = rows_in.data();
                const auto source = [&](std::size_t index, double* weights) {
                    const double* row = rows + index * count;
                    if (logarithms) return kernels.normalize(row, count, drop, weights);
                    kernels.log(row, weights, count);
                    return kernels.normalize(weights, count, drop, weights);
                };
                entropies(sets, posteriors, source, settings, out, counts);
            }
            return nb::make_tuple(
                result, counts.likelihoods, counts.visits,
                nb::make_tuple(counts.pair_by_pair, counts.own_tree, counts.grouped));
        });

    // Row r of the weights weighs points of its own, block r.
    define(
        module, "entropies_of_each",
        [](const Input<3>& points, const Input<2>& rows_in, int number, std::uint32_t neighbors,
           double resolution, double exponent, double offset, int threads, const Input<1>& prior) {
            const std::size_t rows = rows_in.shape(0), count = rows_in.shape(1);
            const std::size_t dimension = points.shape(2);
            if (points.shape(0) != rows || points.shape(1) != count) {
                throw nb::value_error("points and weights do not fit");
            }
            double* out;
            auto result = make_array<double>({rows}, out);
            const Estimator estimator = to_estimator(number);
            const bool drop = drops_negligible(estimator);
            const EntropySettings settings =
                make_settings(estimator, neighbors, resolution, exponent, offset, 1, prior, count);
            {
                WithoutInterpreter released;
                const VectorKernels& kernels = vector_kernels();
                const double work = nanoseconds_of_a_point * static_cast<double>(rows * count);
                parallel_for(rows, threads_for(work, rows, threads), [&](std::size_t row) {
                    const auto source = [&](std::size_t, double* weights) {
                        kernels.log(rows_in.data() + row * count, weights, count);
                        return kernels.normalize(weights, count, drop, weights);
                    };
                    EntropyCounts counts;
                    const double whole = 1.0;
                    const PointSets own{points.data() + row * count * dimension, count, dimension,
                                        1, &whole};
                    entropies(own, 1, source, settings, out + row, counts);
                });
            }
            return result;
        });

    define(module, "hypothetical_entropies",
           [](const Input<1>& weights, const std::vector<std::uint32_t>& sizes,
              const Input<2>& predicted, const Input<2>& variance, std::size_t samples,
              const StreamWords& stream, const std::vector<std::uint8_t>& circular,
              const Input<2>& points, int number, std::uint32_t neighbors, double resolution,
              double exponent, double offset, int threads, const std::vector<double>& factors,
              const Input<1>& prior, bool unchanged) {
               const PointSets sets = make_sets(points, weights.shape(0), factors);
               const std::size_t rows = sizes.size() + (unchanged ? 1 : 0);
               double* out;
               auto result = make_array<double>({rows, samples}, out);
               double* mean;
               auto means = make_array<double>({rows}, mean);
               EntropyCounts counts;
               const Estimator estimator = to_estimator(number);
               const EntropySettings settings =
                   make_settings(estimator, neighbors, resolution, exponent, offset, threads, prior,
                                 weights.shape(0));
               {
                   WithoutInterpreter released;
                   hypothetical_entropies(make_input(weights, sizes, predicted, variance, samples,
                                                     stream, drops_negligible(estimator), circular),
                                          sets, settings, unchanged, out, counts);
                   if (unchanged) {
                       // All samples of the last row are alike, and their mean is not rounded.
                       mean[sizes.size()] = out[sizes.size() * samples];
                       for (std::size_t i = 1; i < samples; ++i) {
                           out[sizes.size() * samples + i] = mean[sizes.size()];
                       }
                   }
                   for (std::size_t j = 0; j < sizes.size(); ++j) {
                       double total = 0.0;
                       for (std::size_t i = 0; i < samples; ++i) total += out[j * samples + i];
                       mean[j] = total / static_cast<double>(samples);
                   }
               }
               return nb::make_tuple(means, result, counts.likelihoods, counts.visits);
           });

    define(module, "stratified",
           [](const Input<1>& weights, std::size_t samples, const StreamWords& stream) {
               std::int64_t* out;
               auto result = make_array<std::int64_t>({samples}, out);
               stratified(weights.data(), weights.shape(0), samples, to_stream(stream), out);
               return result;
           });
    define(module, "hypothetical_weights",
           [](const Input<1>& weights, const std::vector<std::uint32_t>& sizes,
              const Input<2>& predicted, const Input<2>& variance, std::size_t samples,
              const StreamWords& stream, const std::vector<std::uint8_t>& circular,
              bool drop_negligible) {
               double* out;
               auto result = make_array<double>({sizes.size(), samples, weights.shape(0)}, out);
               WithoutInterpreter released;
               hypothetical_weights(make_input(weights, sizes, predicted, variance, samples, stream,
                                               drop_negligible, circular),
                                    out);
               return result;
           });

    // For benchmarks: seconds that one vectorised exp, and one visit of a neighbour, take here.
    define(module, "measure_exp", [](std::size_t count, int repetitions) {
        std::vector<double> in(count, -0.5), out(count);
        const auto start = std::chrono::steady_clock::now();
        for (int i = 0; i < repetitions; ++i) {
            in[static_cast<std::size_t>(i) % count] = -0.25;
            vector_kernels().exp(in.data(), out.data(), count);
        }
        return seconds_since(start) / (static_cast<double>(count) * repetitions);
    });
    define(module, "measure_visit", [](std::size_t count, std::size_t dimension, int repetitions) {
        // All pairs of `count` points, no selection: every neighbour lies within the resolution.
        const std::size_t stride = (count + lane_count - 1) / lane_count * lane_count;
        std::vector<double> coordinates(stride * dimension), weights(stride),
            scratch((stride + 1) * lane_count);
        for (std::size_t i = 0; i < coordinates.size(); ++i) {
            coordinates[i] = 1e-3 * static_cast<double>(i % 17);
        }
        for (std::size_t i = 0; i < stride; ++i) weights[i] = 1.0 / static_cast<double>(stride);
        std::vector<double> bias(stride + 1, 0.0);
        std::uint64_t visits = 0;
        const auto start = std::chrono::steady_clock::now();
        for (int i = 0; i < repetitions; ++i) {
            vector_kernels().compact_nearest(
                {stride, stride, dimension, coordinates.data(), weights.data(), scratch.data()}, 1,
                {1.0, 0.0, bias.data()}, &visits);
        }
        return seconds_since(start) / static_cast<double>(visits);
    });
}
