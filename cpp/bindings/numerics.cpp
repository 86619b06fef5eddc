#include <nanobind/stl/array.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <limits>
#include <optional>
#include <vector>

#include "belief_update.hpp"
#include "bindings.hpp"
#include "deterministic_math.hpp"
#include "resampling.hpp"
#include "vector_kernels.hpp"

namespace nb = nanobind;
using namespace holdfast;
using namespace holdfast::bindings;

namespace {

using Elementwise = void (*)(const double*, double*, std::size_t);

template <Elementwise VectorKernels::* function>
Output<double> elementwise(const Input<1>& in) {
    double* out;
    auto result = make_array<double>({in.shape(0)}, out);
    (vector_kernels().*function)(in.data(), out, in.shape(0));
    return result;
}

// Of any rank: it is asked of whatever somebody's code returned.
template <class Value>
using AnyArray = nb::ndarray<const Value, nb::c_contig, nb::device::cpu>;

/// False for a NaN.
template <class Value>
bool are_within(const Value* values, std::size_t size, Value least, Value most) {
    // In an integer as wide as a value, the compiler compares several values at a time.
    std::int64_t within = 1;
    for (std::size_t i = 0; i < size; ++i) {
        within &= static_cast<std::int64_t>(least <= values[i]) &
                  static_cast<std::int64_t>(values[i] <= most);
    }
    return within != 0;
}

template <class Value>
bool all_within(const AnyArray<Value>& in, Value least, Value most) {
    return are_within(in.data(), in.size(), least, most);
}

constexpr double smallest = std::numeric_limits<double>::denorm_min();
constexpr double largest = std::numeric_limits<double>::max();

bool all_finite(const AnyArray<double>& in) {
    return all_within(in, -largest, largest);
}

Particles particles_of(const Input<2>& states, const Input<1>& weights) {
    require(states.shape(0) == weights.shape(0) && weights.shape(0) > 0, "shapes differ");
    return {states.shape(0), states.shape(1), states.data(), weights.data()};
}

/// Lets other threads of Python run while so many numbers are worth the switch.
class ReleaseForMany {
  public:
    explicit ReleaseForMany(std::size_t numbers) {
        if (numbers >= 8192) release_.emplace();
    }

  private:
    std::optional<WithoutInterpreter> release_;
};

struct Posterior {
    std::size_t survivors;  // weights that are not zero
    BeliefSizes sizes;      // of the belief that has them, or of the one before if none is
};

/// Makes log-likelihoods posterior weights.
Posterior posterior_of(Particles particles, double* values) {
    const std::size_t survivors = reweigh(particles, values);
    if (survivors > 0) particles.weights = values;
    return {survivors, sizes_of(particles)};
}

template <class... Further>
nb::tuple told(const Posterior& found, Further... further) {
    return nb::make_tuple(found.survivors, found.sizes.effective, found.sizes.distinct, further...);
}

/// None if a mean is not finite, or a variance not positive and finite.
nb::object update_by_gaussian(const Input<2>& states, const Input<1>& weights,
                              const Input<1>& observed, const Input<2>& mean,
                              const AnyArray<double>& variance,
                              const std::vector<std::size_t>& circular,
                              InPlace<double, 1> posterior) {
    const Particles particles = particles_of(states, weights);
    const std::size_t count = particles.count, size = observed.shape(0);
    const bool varies = variance.ndim() > 1;
    require(mean.shape(0) == count && mean.shape(1) == size && posterior.shape(0) == count &&
                variance.size() == (varies ? count * size : size),
            "shapes differ");
    const GaussianObservation given{size,   observed.data(), mean.data(), variance.data(),
                                    varies, circular};
    bool usable;
    double nearest = 0.0;
    Posterior found{};
    {
        const ReleaseForMany release(count * size);
        usable = are_within(given.mean, mean.size(), -largest, largest) &&
                 are_within(given.variance, variance.size(), smallest, largest);
        if (usable) {
            nearest = gaussian_log_likelihood(particles, given, posterior.data());
            found = posterior_of(particles, posterior.data());
        }
    }
    return usable ? nb::object(told(found, nearest)) : nb::none();
}

}  // namespace

void holdfast::bind_numerics(nb::module_& module) {
    define(module, "exp", &elementwise<&VectorKernels::exp>);
    define(module, "log", &elementwise<&VectorKernels::log>);
    define(module, "sin", &elementwise<&VectorKernels::sin>);
    define(module, "cos", &elementwise<&VectorKernels::cos>);
    define(module, "arctan2", [](const Input<1>& y, const Input<1>& x) {
        if (y.shape(0) != x.shape(0)) throw nb::value_error("y and x do not fit");
        double* out;
        auto result = make_array<double>({y.shape(0)}, out);
        for (std::size_t i = 0; i < y.shape(0); ++i) out[i] = arctan2(y.data()[i], x.data()[i]);
        return result;
    });
    define(module, "arcsin", [](double x) { return arcsin(x); });
    define(module, "sum",
           [](const Input<1>& in) { return vector_kernels().sum(in.data(), in.shape(0)); });
    define(module, "all_finite", &all_finite);
    define(module, "all_within", &all_within<double>);
    define(module, "all_integers_within", &all_within<std::int64_t>);
    define(module, "weighted_sums", [](const Input<1>& weights, const Input<2>& rows) {
        double* out;
        auto result = make_array<double>({rows.shape(1)}, out);
        vector_kernels().weighted_sums(weights.data(), rows.data(), rows.shape(0), rows.shape(1),
                                       out);
        return result;
    });
    define(module, "normalize", [](const Input<1>& log_weights, bool drop_negligible) {
        double* out;
        auto result = make_array<double>({log_weights.shape(0)}, out);
        const std::size_t survivors = vector_kernels().normalize(
            log_weights.data(), log_weights.shape(0), drop_negligible, out);
        return nb::make_tuple(result, survivors);
    });
    define(module, "belief_sizes", [](const Input<2>& states, const Input<1>& weights) {
        const BeliefSizes sizes = sizes_of(particles_of(states, weights));
        return nb::make_tuple(sizes.effective, sizes.distinct);
    });
    define(
        module, "update",
        [](const Input<2>& states, const Input<1>& weights, InPlace<double, 1> log_likelihood) {
            require(log_likelihood.shape(0) == weights.shape(0), "shapes differ");
            const Particles particles = particles_of(states, weights);
            Posterior found;
            {
                const ReleaseForMany release(particles.count);
                found = posterior_of(particles, log_likelihood.data());
            }
            return told(found);
        },
        nb::arg("states"), nb::arg("weights"), nb::arg("log_likelihood").noconvert());
    define(module, "update_by_gaussian", &update_by_gaussian, nb::arg("states"), nb::arg("weights"),
           nb::arg("observed"), nb::arg("mean"), nb::arg("variance"), nb::arg("circular"),
           nb::arg("posterior").noconvert());
    define(module, "philox", [](const StreamWords& words, std::uint32_t block) {
        const PhiloxBlock result = philox(to_stream(words), block);
        return StreamWords{result.words[0], result.words[1], result.words[2], result.words[3], 0};
    });
    define(module, "substream", [](const StreamWords& words, std::uint32_t index) {
        const Stream s = substream(to_stream(words), index);
        return nb::make_tuple(s.key0, s.key1, s.c1, s.c2, s.c3);
    });
    define(module, "normals", [](const StreamWords& words, std::size_t count) {
        double* out;
        auto result = make_array<double>({count}, out);
        normals(to_stream(words), 0, count, out);
        return result;
    });
    define(module, "uniforms", [](const StreamWords& words, std::size_t count) {
        double* out;
        auto result = make_array<double>({count}, out);
        uniforms(to_stream(words), 0, count, out);
        return result;
    });
    // Not by define, which would undo what they do.
    module.def("enter_standard_mode", &enter_standard_mode);
    module.def("restore_mode", &restore_mode);
    define(module, "systematic_resample", [](const Input<1>& weights, double offset) {
        std::int64_t* out;
        auto result = make_array<std::int64_t>({weights.shape(0)}, out);
        systematic_resample(weights.data(), weights.shape(0), offset, out);
        return result;
    });
    define(
        module, "resample",
        [](const Input<2>& states, const Input<1>& weights, const StreamWords& words,
           InPlace<double, 2> drawn, InPlace<double, 1> drawn_weights) {
            const Particles particles = particles_of(states, weights);
            const std::size_t count = particles.count;
            require(drawn.shape(0) == count && drawn.shape(1) == particles.dimension &&
                        drawn_weights.shape(0) == count,
                    "shapes differ");
            const ReleaseForMany release(count * particles.dimension);
            resample(particles, uniform(to_stream(words), 0), drawn.data());
            std::fill_n(drawn_weights.data(), count, 1.0 / static_cast<double>(count));
        },
        nb::arg("states"), nb::arg("weights"), nb::arg("words"), nb::arg("drawn").noconvert(),
        nb::arg("drawn_weights").noconvert());
}
