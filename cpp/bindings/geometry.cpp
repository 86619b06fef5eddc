// Python's view of the worlds of geometry_2d.hpp and geometry_3d.hpp and of motion.hpp.
//
// Callers go through holdfast/numerics/geometry.py. To cost nothing where all is well, a function
// here checks its values while it has them at hand and returns false; the Python side then finds
// out what is wrong and raises the error that says so.

#include <nanobind/stl/array.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <vector>

#include "bindings.hpp"
#include "geometry_2d.hpp"
#include "geometry_3d.hpp"
#include "motion.hpp"
#include "policies.hpp"
#include "rollouts.hpp"

namespace nb = nanobind;
using namespace holdfast;
using namespace holdfast::bindings;

namespace {

bool all_finite(const double* values, std::size_t count) {
    bool finite = true;
    for (std::size_t i = 0; i < count; ++i) finite &= std::isfinite(values[i]);
    return finite;
}

bool all_non_negative(const double* values, std::size_t count) {
    bool non_negative = true;
    for (std::size_t i = 0; i < count; ++i) non_negative &= values[i] >= 0.0;
    return non_negative;
}

// Lets other Python threads run while the work is long enough to be worth the switch, or proves to
// be: for many states, or few among many obstacles, where each of them is compared with all.
class ReleaseForLongWork final : public LongWork {
  public:
    ReleaseForLongWork(std::size_t count, std::size_t obstacles)
        : before_(std::exchange(long_work, this)) {
        if (count >= 1024 || count * obstacles >= 8192) begins();
    }
    ~ReleaseForLongWork() { long_work = before_; }
    ReleaseForLongWork(const ReleaseForLongWork&) = delete;
    ReleaseForLongWork& operator=(const ReleaseForLongWork&) = delete;

    void begins() override {
        if (!release_) release_.emplace();
    }

  private:
    LongWork* before_;
    std::optional<WithoutInterpreter> release_;
};

std::vector<AxisAlignedRectangle> rectangles(const Input<2>& limits) {
    require(limits.shape(1) == 4, "a rectangle has four limits");
    std::vector<AxisAlignedRectangle> result(limits.shape(0));
    for (std::size_t i = 0; i < result.size(); ++i) {
        const double* row = limits.data() + 4 * i;
        result[i] = {row[0], row[1], row[2], row[3]};
    }
    return result;
}

std::vector<AxisAlignedBox> boxes(const Input<2>& limits) {
    require(limits.shape(1) == 6, "a box has six limits");
    std::vector<AxisAlignedBox> result(limits.shape(0));
    for (std::size_t i = 0; i < result.size(); ++i) {
        const double* row = limits.data() + 6 * i;
        result[i] = {{row[0], row[1], row[2]}, {row[3], row[4], row[5]}};
    }
    return result;
}

template <class World>
bool collides_batch(const World& world, const Input<2>& states, InPlace<bool, 1> result) {
    const std::size_t count = states.shape(0);
    require(states.shape(1) == World::dimension && result.shape(0) == count, "shapes differ");
    const double* state = states.data();
    if (!all_finite(state, count * World::dimension)) return false;
    ReleaseForLongWork release(count, world.num_obstacles());
    world.collide_each(state, count, reinterpret_cast<std::uint8_t*>(result.data()));
    return true;
}

template <class World>
bool move_batch(const World& world, const Input<2>& states, const Input<2>& actions,
                const Input<1>& standard_deviation, double tolerance, const StreamWords& stream,
                InPlace<double, 2> next) {
    constexpr std::size_t d = World::dimension;
    const std::size_t count = states.shape(0);
    require(states.shape(1) == d && actions.shape(1) == d && next.shape(1) == d &&
                next.shape(0) == count && (actions.shape(0) == count || actions.shape(0) == 1),
            "shapes differ");
    if (!all_finite(states.data(), count * d) ||
        !all_finite(actions.data(), actions.shape(0) * d) || standard_deviation.shape(0) != d ||
        !all_finite(standard_deviation.data(), d) ||
        !all_non_negative(standard_deviation.data(), d) || !(tolerance > 0.0 && tolerance < 1.0)) {
        return false;
    }
    const std::size_t action_stride = actions.shape(0) == count ? d : 0;
    ReleaseForLongWork release(count, world.num_obstacles());
    move(world, count, states.data(), actions.data(), action_stride, standard_deviation.data(),
         tolerance, to_stream(stream), next.data());
    return true;
}

template <class World>
bool move_each_batch(const World& world, const Input<3>& states, const Input<2>& actions,
                     const Input<1>& standard_deviation, double tolerance,
                     const std::vector<StreamWords>& words, int threads, InPlace<double, 3> next) {
    constexpr std::size_t d = World::dimension;
    const std::size_t beliefs = states.shape(0), count = states.shape(1);
    require(states.shape(2) == d && actions.shape(1) == d && actions.shape(0) == beliefs &&
                words.size() == beliefs && next.shape(0) == beliefs && next.shape(1) == count &&
                next.shape(2) == d,
            "shapes differ");
    if (!all_finite(states.data(), beliefs * count * d) ||
        !all_finite(actions.data(), beliefs * d) || standard_deviation.shape(0) != d ||
        !all_finite(standard_deviation.data(), d) ||
        !all_non_negative(standard_deviation.data(), d) || !(tolerance > 0.0 && tolerance < 1.0)) {
        return false;
    }
    std::vector<Stream> streams;
    for (const StreamWords& own : words) streams.push_back(to_stream(own));
    WithoutInterpreter released;
    move_each(world, beliefs, count, states.data(), actions.data(), standard_deviation.data(),
              tolerance, streams.data(), threads, next.data());
    return true;
}

template <class World>
std::size_t draw_free_batch(const World& world, const Input<1>& mean,
                            const Input<1>& standard_deviation, const StreamWords& stream,
                            InPlace<double, 2> states) {
    constexpr std::size_t d = World::dimension;
    require(mean.shape(0) == d && standard_deviation.shape(0) == d && states.shape(1) == d,
            "shapes differ");
    const std::size_t count = states.shape(0);
    ReleaseForLongWork release(count, world.num_obstacles());
    return draw_free(world, count, mean.data(), standard_deviation.data(), to_stream(stream),
                     states.data());
}

template <class World, class Policy>
bool follow_batch(const World& world, const OwnedPolicy<Policy>& policy, const Input<2>& states,
                  std::size_t stage, const std::vector<std::uint32_t>& offsets, double tolerance,
                  int threads, bool commands, InPlace<double, 3> rows_at,
                  InPlace<std::int64_t, 2> stages_at) {
    constexpr std::size_t d = World::dimension;
    const std::size_t count = states.shape(0);
    require(states.shape(1) == d && rows_at.shape(2) == d && rows_at.shape(1) == count &&
                rows_at.shape(0) == offsets.size() && stages_at.shape(1) == count &&
                stages_at.shape(0) == offsets.size(),
            "shapes differ");
    require(!offsets.empty() && std::is_sorted(offsets.begin(), offsets.end()),
            "the offsets are not in order");
    require(stage < policy.num_stages, "there is no such stage");
    if (!all_finite(states.data(), count * d)) return false;
    WithoutInterpreter released;
    follow<World, Policy>(world, policy, count, states.data(), stage, offsets, tolerance, threads,
                          commands, rows_at.data(), stages_at.data());
    return true;
}

/// The tuple of that name in geometry.py.
using RolloutSettings = std::tuple<std::size_t, std::size_t, std::size_t, double, double, bool>;

template <class World, class Policy>
bool roll_out_batch(
    const World& world, const OwnedPolicy<Policy>& policy, const Input<2>& true_states,
    const Input<3>& estimates,
    const nb::ndarray<const double, nb::ndim<4>, nb::c_contig, nb::device::cpu>& clouds,
    std::size_t stage, const Input<1>& standard_deviation, double tolerance,
    const StreamWords& stream, const RolloutSettings& settings, int threads,
    InPlace<double, 2> returns) {
    constexpr std::size_t d = World::dimension;
    const std::size_t actions = returns.shape(0), samples = returns.shape(1);
    const std::size_t members = clouds.shape(2);
    require(true_states.shape(0) == samples && true_states.shape(1) == d &&
                estimates.shape(0) == actions && estimates.shape(1) == samples &&
                estimates.shape(2) == d && clouds.shape(0) == actions &&
                clouds.shape(1) == samples && clouds.shape(3) == d && members > 0 &&
                standard_deviation.shape(0) == d,
            "shapes differ");
    require(stage < policy.num_stages, "there is no such stage");
    if (!all_finite(true_states.data(), true_states.size()) ||
        !all_finite(estimates.data(), estimates.size()) ||
        !all_finite(clouds.data(), clouds.size())) {
        return false;
    }
    const auto& [interval, looks, steps, discount, price, counts_steps] = settings;
    WithoutInterpreter released;
    roll_out<World, Policy>(world, policy,
                            {actions, samples, members, true_states.data(), estimates.data(),
                             clouds.data(), stage, standard_deviation.data(), tolerance, interval,
                             looks, steps, discount, price, counts_steps},
                            to_stream(stream), threads, returns.data());
    return true;
}

/// The means and the particles drawn, or None if a posterior gives its true state no weight.
nb::object beliefs_without_truth_batch(
    InPlace<double, 3> weights, const Input<2>& states,
    const nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>& truths,
    const StreamWords& stream, std::size_t members, double negligible) {
    const std::size_t actions = weights.shape(0), samples = weights.shape(1),
                      count = weights.shape(2), dimension = states.shape(1);
    require(states.shape(0) == count && truths.shape(0) == samples, "shapes differ");
    for (std::size_t i = 0; i < samples; ++i) {
        const std::int64_t truth = truths.data()[i];
        require(truth >= 0 && static_cast<std::size_t>(truth) < count, "there is no such particle");
    }
    double *means, *drawn;
    auto estimates = make_array<double>({actions, samples, dimension}, means);
    auto clouds = make_array<double>({actions, samples, members, dimension}, drawn);
    bool likely;
    {
        WithoutInterpreter released;
        likely = beliefs_without_truth(actions, samples, count, dimension, members, states.data(),
                                       truths.data(), to_stream(stream), negligible, weights.data(),
                                       means, drawn);
    }
    if (!likely) return nb::none();
    return nb::make_tuple(estimates, clouds);
}

template <class World, class Policy>
void bind_way(nb::class_<World>& world) {
    world.def("follow", &follow_batch<World, Policy>, nb::arg("policy"),
              nb::arg("states").noconvert(), nb::arg("stage"), nb::arg("offsets"),
              nb::arg("tolerance"), nb::arg("threads"), nb::arg("commands"),
              nb::arg("rows_at").noconvert(), nb::arg("stages_at").noconvert(),
              nb::call_guard<StandardRounding>());
    world.def("roll_out", &roll_out_batch<World, Policy>, nb::arg("policy"),
              nb::arg("true_states").noconvert(), nb::arg("estimates").noconvert(),
              nb::arg("clouds").noconvert(), nb::arg("stage"),
              nb::arg("standard_deviation").noconvert(), nb::arg("tolerance"), nb::arg("stream"),
              nb::arg("rollouts"), nb::arg("threads"), nb::arg("returns").noconvert(),
              nb::call_guard<StandardRounding>());
}

/// The numbers of a policy's stages, one after the other.
template <std::size_t size>
std::vector<double> numbers_of(const std::vector<std::array<double, size>>& stages) {
    require(!stages.empty(), "a policy has a stage");
    std::vector<double> numbers;
    for (const auto& stage : stages) numbers.insert(numbers.end(), stage.begin(), stage.end());
    return numbers;
}

template <class World>
nb::class_<World> bind_world(nb::module_& module, const char* name) {
    return nb::class_<World>(module, name)
        .def("collides", &collides_batch<World>, nb::arg("states").noconvert(),
             nb::arg("result").noconvert(), nb::call_guard<StandardRounding>())
        .def("move", &move_batch<World>, nb::arg("states").noconvert(),
             nb::arg("actions").noconvert(), nb::arg("standard_deviation").noconvert(),
             nb::arg("tolerance"), nb::arg("stream"), nb::arg("next_states").noconvert(),
             nb::call_guard<StandardRounding>())
        .def("move_each", &move_each_batch<World>, nb::arg("states").noconvert(),
             nb::arg("actions").noconvert(), nb::arg("standard_deviation").noconvert(),
             nb::arg("tolerance"), nb::arg("streams"), nb::arg("threads"),
             nb::arg("next_states").noconvert(), nb::call_guard<StandardRounding>())
        .def("draw_free", &draw_free_batch<World>, nb::arg("mean").noconvert(),
             nb::arg("standard_deviation").noconvert(), nb::arg("stream"),
             nb::arg("states").noconvert(), nb::call_guard<StandardRounding>());
}

}  // namespace

void holdfast::bind_geometry(nb::module_& module) {
    auto disc = bind_world<DiscWorld>(module, "DiscWorld");
    disc.def(
        "__init__",
        [](DiscWorld* self, double radius, const Input<2>& obstacles) {
            new (self) DiscWorld(radius, rectangles(obstacles));
        },
        nb::arg("radius"), nb::arg("obstacles").noconvert());
    auto rectangle = bind_world<RectangleWorld>(module, "RectangleWorld");
    rectangle.def(
        "__init__",
        [](RectangleWorld* self, double width, double height, const Input<2>& obstacles) {
            new (self) RectangleWorld(width, height, rectangles(obstacles));
        },
        nb::arg("width"), nb::arg("height"), nb::arg("obstacles").noconvert());
    auto box = bind_world<BoxWorld>(module, "BoxWorld");
    box.def(
        "__init__",
        [](BoxWorld* self, double size_x, double size_y, double size_z, const Input<2>& obstacles) {
            new (self) BoxWorld({size_x, size_y, size_z}, boxes(obstacles));
        },
        nb::arg("size_x"), nb::arg("size_y"), nb::arg("size_z"), nb::arg("obstacles").noconvert());

    using Peg2D = OwnedPolicy<PegPolicy2D>;
    nb::class_<Peg2D>(module, "PegPolicy2D")
        .def("__init__", [](Peg2D* self, const std::vector<std::array<double, 3>>& stages,
                            double half_width, double height, const std::array<double, 3>& limits,
                            const std::array<double, 4>& goal) {
            const auto [axis, tolerance, above, below] = goal;
            PegPolicy2D policy{half_width, height, {}, {axis, tolerance, above, below}};
            std::copy(limits.begin(), limits.end(), policy.limits);
            new (self) Peg2D(policy, numbers_of(stages));
        });
    using Peg3D = OwnedPolicy<PegPolicy3D>;
    nb::class_<Peg3D>(module, "PegPolicy3D")
        .def("__init__", [](Peg3D* self, double half_width, double upright_limit,
                            const std::array<double, 6>& limits, double goal_tolerance) {
            PegPolicy3D policy{half_width, upright_limit, {}, goal_tolerance};
            std::copy(limits.begin(), limits.end(), policy.limits);
            new (self) Peg3D(policy, {});
        });
    using ViaPoints = OwnedPolicy<ViaPointPolicy>;
    nb::class_<ViaPoints>(module, "ViaPointPolicy")
        .def("__init__",
             [](ViaPoints* self, const std::vector<std::array<double, 5>>& stages,
                double step_size) { new (self) ViaPoints({step_size}, numbers_of(stages)); });
    define(module, "beliefs_without_truth", &beliefs_without_truth_batch);
    bind_way<DiscWorld, ViaPointPolicy>(disc);
    bind_way<RectangleWorld, PegPolicy2D>(rectangle);
    bind_way<BoxWorld, PegPolicy3D>(box);
}
