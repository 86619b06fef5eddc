#include "rollouts.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

#include "geometry_2d.hpp"
#include "geometry_3d.hpp"
#include "motion.hpp"
#include "policies.hpp"
#include "thread_pool.hpp"
#include "vector_kernels.hpp"

namespace holdfast {
namespace {

constexpr double nanoseconds_of_a_move = 100.0;
constexpr std::size_t steps_of_long_work = 64;

// Streams of a step: its own, and that of the first attempt to place the noise.
struct StepStreams {
    Stream step, first;
};

// Streams that are drawn from together: as many as fill the processor's registers.
constexpr std::size_t streams_at_once = 4;

// Noise of one sample. Attempts after the first are rare, and drawn when asked for.
template <std::size_t d>
class StepNoise {
  public:
    StepNoise(const RolloutInput& input, std::size_t sample)
        : deviation_(input.standard_deviation),
          first_(sample * (1 + input.members)),
          noise_(1 + input.members) {}

    void begin(const StepStreams& streams) {
        streams_ = &streams;
        drawn_.resize(noise_.size() * d);
        normals(streams.first, first_ * d, drawn_.size(), drawn_.data());
        for (std::size_t p = 0; p < noise_.size(); ++p) {
            noise_[p].resize(d);
            for (std::size_t c = 0; c < d; ++c) noise_[p][c] = deviation_[c] * drawn_[p * d + c];
        }
    }

    const double* of(std::size_t particle, std::size_t attempt) {
        std::vector<double>& own = noise_[particle];
        while (own.size() <= attempt * d) {
            check_interruption();
            std::array<Stream, streams_at_once> streams;
            std::array<std::uint32_t, streams_at_once> numbers;
            for (std::size_t i = 0; i < streams_at_once; ++i) {
                streams[i] = streams_->step;
                numbers[i] = static_cast<std::uint32_t>(own.size() / d + i);
            }
            vector_kernels().substreams(streams.data(), numbers.data(), streams_at_once,
                                        streams.data());
            append(streams.data(), streams_at_once, particle, own);
        }
        return own.data() + attempt * d;
    }

    // Appends the noise that a particle has in each of some streams.
    void append(const Stream* streams, std::size_t number, std::size_t particle,
                std::vector<double>& to) const {
        std::array<double, streams_at_once * d> drawn;
        vector_kernels().normals_of_each(streams, number, (first_ + particle) * d, d, drawn.data());
        for (std::size_t i = 0; i < number * d; ++i) {
            to.push_back(deviation_[i % d] * drawn[i]);
        }
    }

  private:
    const double* deviation_;
    std::size_t first_;
    const StepStreams* streams_ = nullptr;
    std::vector<double> drawn_;
    std::vector<std::vector<double>> noise_;
};

template <class World, class Policy>
class Sample {
  public:
    static constexpr std::size_t d = World::dimension;
    static_assert(Policy::dimension == d);
    using State = std::array<double, d>;

    Sample(const World& world, const Policy& policy, const RolloutInput& input,
           const std::vector<StepStreams>& streams, std::size_t sample, double* returns)
        : world_(world),
          policy_(policy),
          input_(input),
          streams_(streams),
          sample_(sample),
          returns_(returns),
          noisy_(std::any_of(input.standard_deviation, input.standard_deviation + d,
                             [](double each) { return each != 0.0; })),
          noise_(input, sample),
          clouds_(input.actions * input.members) {
        const double* state = input.true_states + sample * d;
        for (std::size_t j = 0; j < input.actions; ++j) {
            returns_[j * input.samples + sample] = 0.0;
            Robot robot{};
            robot.stage = input.stage;
            robot.share = policy.is_goal(state) ? 0.0 : 1.0;
            std::copy(state, state + d, robot.state.begin());
            const std::size_t belief = j * input.samples + sample;
            for (std::size_t l = 0; l < input.members; ++l) {
                const double* member = input.clouds + (belief * input.members + l) * d;
                std::copy(member, member + d, clouds_[j * input.members + l].begin());
            }
            const State mean = mean_of_cloud(j);
            for (std::size_t c = 0; c < d; ++c) {
                robot.offset[c] = input.estimates[belief * d + c] - mean[c];
            }
            robots_.push_back(robot);
        }
    }

    void run() {
        for (std::size_t step = 0; step < input_.steps; ++step) {
            if (step % steps_of_long_work == 0) check_interruption();
            if (step > 0 && step % input_.interval == 0) sense(step / input_.interval);
            if (std::none_of(robots_.begin(), robots_.end(), goes_on) || factor_ == 0.0) return;
            if (noisy_) noise_.begin(streams_[step]);
            act();
            factor_ *= input_.discount;
        }
    }

  private:
    // A robot that acts on its belief, after one sensing action.
    struct Robot {
        State state, offset;
        State before, action;  // the last state, and the action executed in it
        std::size_t stage;
        double share;  // the probability that its state is not known; 0 where the goal is reached
        double value;  // of its state, when it last could become known
    };
    static bool goes_on(const Robot& robot) { return robot.share > 0.0; }

    State mean_of_cloud(std::size_t j) const {
        State mean = clouds_[j * input_.members];
        for (std::size_t l = 1; l < input_.members; ++l) {
            for (std::size_t c = 0; c < d; ++c) mean[c] += clouds_[j * input_.members + l][c];
        }
        for (double& each : mean) each /= static_cast<double>(input_.members);
        return mean;
    }

    void add(std::size_t j, double value) {
        returns_[j * input_.samples + sample_] += factor_ * value;
    }

    // Pays for a later sensing step; at the first ones the state may become known.
    void sense(std::size_t later) {
        for (std::size_t j = 0; j < robots_.size(); ++j) add(j, -input_.price * robots_[j].share);
        if (later > input_.looks) return;
        const double chance = later == input_.looks ? 1.0 : 1.0 / static_cast<double>(input_.looks);
        for (auto robot = robots_.begin(); robot != robots_.end(); ++robot) {
            if (!goes_on(*robot)) continue;
            const auto alike = std::find_if(robots_.begin(), robot, [&](const Robot& other) {
                return other.state == robot->state && other.stage == robot->stage;
            });
            robot->value = alike != robot
                               ? alike->value
                               : known_value(robot->state, robot->stage, later * input_.interval);
        }
        for (std::size_t j = 0; j < robots_.size(); ++j) {
            const double share = robots_[j].share * chance;
            robots_[j].share -= share;
            add(j, share * robots_[j].value);
        }
    }

    // What is earned from the step on by a robot that knows its state, without obstacles.
    double known_value(State state, std::size_t stage, std::size_t from) {
        double value = 0.0, factor = 1.0;
        for (std::size_t step = from; step < input_.steps; ++step) {
            if ((step - from) % steps_of_long_work == 0) check_interruption();
            if (step > from && step % input_.interval == 0) value -= factor * input_.price;
            State action;
            stage = policy_.next_stage(state.data(), stage);
            policy_.executed(state.data(), stage, action.data());
            const double* noise = free_noise(step);
            for (std::size_t c = 0; c < d; ++c) state[c] = state[c] + action[c] + noise[c];
            value += factor * reward(state, action);
            if (policy_.is_goal(state.data())) break;
            factor *= input_.discount;
        }
        return value;
    }

    // The true state's noise where it is drawn once, for all robots of the sample.
    const double* free_noise(std::size_t step) {
        while (free_noise_.size() <= step * d) {
            const std::size_t from = free_noise_.size() / d;
            const std::size_t number = std::min(streams_at_once, streams_.size() - from);
            std::array<Stream, streams_at_once> streams;
            for (std::size_t i = 0; i < number; ++i) streams[i] = streams_[from + i].first;
            noise_.append(streams.data(), number, 0, free_noise_);
        }
        return free_noise_.data() + step * d;
    }

    void act() {
        for (std::size_t j = 0; j < robots_.size(); ++j) {
            Robot& robot = robots_[j];
            if (!goes_on(robot)) {
                robot.before.fill(std::numeric_limits<double>::infinity());
                continue;
            }
            State believed = mean_of_cloud(j);
            for (std::size_t c = 0; c < d; ++c) believed[c] += robot.offset[c];
            robot.stage = policy_.next_stage(believed.data(), robot.stage);
            policy_.executed(believed.data(), robot.stage, robot.action.data());
            for (std::size_t l = 0; l < input_.members; ++l) {
                State& member = clouds_[j * input_.members + l];
                member = moved(member, robot.action, 1 + l);
            }
            robot.before = robot.state;
            // The same action in the same state, and the same noise.
            const auto end = robots_.begin() + static_cast<std::ptrdiff_t>(j);
            const auto alike = std::find_if(robots_.begin(), end, [&](const Robot& other) {
                return other.before == robot.before && other.action == robot.action;
            });
            robot.state = alike != end ? alike->state : moved(robot.state, robot.action, 0);
            add(j, robot.share * reward(robot.state, robot.action));
            if (policy_.is_goal(robot.state.data())) robot.share = 0.0;
        }
    }

    double reward(const State& state, const State& action) const {
        return input_.counts_steps ? -1.0 : policy_.reward(world_, state.data(), action.data());
    }

    // As `move` has it.
    State moved(const State& state, const State& action, std::size_t particle) {
        State next;
        const double room = world_.clearance(state.data());
        const double way = greatest(action.data());
        if (way < room) {
            for (std::size_t c = 0; c < d; ++c) next[c] = state[c] + action[c];
        } else {
            stop_at_contact(world_, state.data(), action.data(), input_.tolerance, next.data());
        }
        for (std::size_t attempt = 0; noisy_ && attempt < max_noise_attempts; ++attempt) {
            const double* noise = noise_.of(particle, attempt);
            State placed;
            for (std::size_t c = 0; c < d; ++c) placed[c] = next[c] + noise[c];
            if (way + greatest(noise) < room || !world_.collides(placed.data())) return placed;
        }
        return next;
    }

    static double greatest(const double* way) {
        double found = 0.0;
        for (std::size_t c = 0; c < World::space_dimension; ++c) {
            found = std::max(found, std::abs(way[c]));
        }
        return found;
    }

    const World& world_;
    const Policy& policy_;
    const RolloutInput& input_;
    const std::vector<StepStreams>& streams_;
    std::size_t sample_;
    double* returns_;
    bool noisy_;
    StepNoise<d> noise_;
    std::vector<State> clouds_;
    std::vector<Robot> robots_;
    std::vector<double> free_noise_;
    double factor_ = 1.0;
};

}  // namespace

template <class World, class Policy>
void roll_out(const World& world, const Policy& policy, const RolloutInput& input,
              const Stream& stream, int threads, double* returns) {
    std::vector<Stream> of_steps(input.steps, stream), first(input.steps);
    std::vector<std::uint32_t> numbers(input.steps);
    std::iota(numbers.begin(), numbers.end(), 0);
    vector_kernels().substreams(of_steps.data(), numbers.data(), input.steps, of_steps.data());
    std::fill(numbers.begin(), numbers.end(), 0);
    vector_kernels().substreams(of_steps.data(), numbers.data(), input.steps, first.data());
    std::vector<StepStreams> streams(input.steps);
    for (std::size_t step = 0; step < input.steps; ++step) {
        streams[step] = {of_steps[step], first[step]};
    }
    const std::size_t moves = input.samples * input.actions * (1 + input.members) *
                              std::min(input.steps, input.looks * input.interval);
    const double work = nanoseconds_of_a_move * static_cast<double>(moves);
    parallel_for(input.samples, threads_for(work, input.samples, threads), [&](std::size_t i) {
        Sample<World, Policy>(world, policy, input, streams, i, returns).run();
    });
}

void beliefs_without_truth(std::size_t actions, std::size_t samples, std::size_t count,
                           std::size_t dimension, std::size_t members_each, const double* states,
                           const std::int64_t* truths, const double* at, double negligible,
                           double* weights, double* means, std::int64_t* members) {
    std::vector<double> rest(count), columns(dimension * count);
    for (std::size_t n = 0; n < count; ++n) {
        for (std::size_t c = 0; c < dimension; ++c) {
            columns[c * count + n] = states[n * dimension + c];
        }
    }
    for (std::size_t row = 0; row < actions * samples; ++row) {
        check_interruption();
        double* own = weights + row * count;
        std::copy(own, own + count, rest.begin());
        rest[static_cast<std::size_t>(truths[row % samples])] = 0.0;
        const double total = vector_kernels().sum(rest.data(), count);
        if (total > negligible) {
            for (std::size_t n = 0; n < count; ++n) own[n] = rest[n] / total;
        }
        for (std::size_t c = 0; c < dimension; ++c) {
            means[row * dimension + c] =
                vector_kernels().weighted_sum(own, &columns[c * count], count);
        }
        std::size_t n = 0, last = 0;
        double cumulated = 0.0;
        for (std::size_t l = 0; l < members_each; ++l) {
            while (n < count && cumulated + own[n] <= at[row % samples * members_each + l]) {
                if (own[n] > 0.0) last = n;
                cumulated += own[n++];
            }
            members[row * members_each + l] = static_cast<std::int64_t>(n < count ? n : last);
        }
    }
}

#define HOLDFAST_INSTANTIATE(World, Policy)                                                 \
    template void roll_out<World, Policy>(const World&, const Policy&, const RolloutInput&, \
                                          const Stream&, int, double*);

HOLDFAST_INSTANTIATE(DiscWorld, ViaPointPolicy)
HOLDFAST_INSTANTIATE(RectangleWorld, PegPolicy2D)
HOLDFAST_INSTANTIATE(BoxWorld, PegPolicy3D)
#undef HOLDFAST_INSTANTIATE

}  // namespace holdfast
