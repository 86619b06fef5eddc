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

constexpr double nanoseconds_of_a_move = 40.0;
constexpr std::size_t steps_of_long_work = 64;

// Attempts to place noise that are tried together, when few are left that need one.
constexpr std::size_t attempts_at_once = 8;

// Samples that a thread takes together: enough to fill the processor's registers.
constexpr std::size_t least_samples = 5, most_samples = 32;

// Streams of a step: its own, and that of the first attempt to place the noise.
struct StepStreams {
    Stream step, first;
};

// Some samples, step by step: what all their robots do in a step is one round of work.
template <class World, class Policy>
class Samples {
  public:
    static constexpr std::size_t d = World::dimension;
    static_assert(Policy::dimension == d);
    using State = std::array<double, d>;

    Samples(const World& world, const Policy& policy, const RolloutInput& input,
            const std::vector<StepStreams>& streams, std::size_t first, std::size_t count,
            double* returns)
        : world_(world),
          policy_(policy),
          input_(input),
          streams_(streams),
          first_(first),
          particles_(1 + input.members),
          noisy_(std::any_of(input.standard_deviation, input.standard_deviation + d,
                             [](double each) { return each != 0.0; })),
          active_(count),
          robots_(count * input.actions),
          clouds_(count * input.actions * input.members),
          noise_(count * particles_),
          free_noise_(count) {
        std::iota(active_.begin(), active_.end(), 0);
        for (std::size_t r = 0; r < robots_.size(); ++r) {
            Robot& robot = robots_[r];
            robot.sample = r / input.actions;
            const std::size_t belief = r % input.actions * input.samples + first + robot.sample;
            const double* state = input.true_states + (first + robot.sample) * d;
            const double* cloud = input.clouds + belief * input.members * d;
            robot.sum = &returns[belief];
            *robot.sum = 0.0;
            robot.stage = input.stage;
            robot.share = policy.is_goal(state) ? 0.0 : 1.0;
            std::copy(state, state + d, robot.state.begin());
            for (std::size_t l = 0; l < input.members; ++l) {
                std::copy(cloud + l * d, cloud + (l + 1) * d,
                          clouds_[r * input.members + l].begin());
            }
            const State mean = mean_of_cloud(r);
            for (std::size_t c = 0; c < d; ++c) {
                robot.offset[c] = input.estimates[belief * d + c] - mean[c];
            }
        }
    }

    void run() {
        for (std::size_t step = 0; step < input_.steps; ++step) {
            if (step % steps_of_long_work == 0) check_interruption();
            if (step > 0 && step % input_.interval == 0) sense(step / input_.interval);
            std::erase_if(active_, [&](std::size_t i) {
                const auto own = robots_.begin() + static_cast<std::ptrdiff_t>(i * input_.actions);
                return std::none_of(own, own + static_cast<std::ptrdiff_t>(input_.actions),
                                    goes_on);
            });
            if (active_.empty() || factor_ == 0.0) return;
            act(streams_[step]);
            factor_ *= input_.discount;
        }
    }

  private:
    // A robot that acts on its belief, after one sensing action.
    struct Robot {
        State state, offset;
        State before, action;  // the last state, and the action executed in it
        std::size_t sample, stage;
        double share;  // the probability that its state is not known; 0 where the goal is reached
        double value;  // of its state, when it last could become known
        double* sum;   // its return so far
        const Robot* alike;  // an earlier one of its sample in the same state, or null
    };
    static bool goes_on(const Robot& robot) { return robot.share > 0.0; }

    // A state that an action moves; `noise` is its place in noise_.
    struct Mover {
        State* state;
        const State* action;
        std::size_t noise;
        State next;
        double room, way;
        double reached, blocked;  // fractions of the way
    };

    // A robot from where its state became known.
    struct Walker {
        Robot* robot;
        State state;
        std::size_t stage;
    };

    State mean_of_cloud(std::size_t robot) const {
        const State* cloud = &clouds_[robot * input_.members];
        State mean = cloud[0];
        for (std::size_t l = 1; l < input_.members; ++l) {
            for (std::size_t c = 0; c < d; ++c) mean[c] += cloud[l][c];
        }
        for (double& each : mean) each /= static_cast<double>(input_.members);
        return mean;
    }

    void add(Robot& robot, double value) { *robot.sum += factor_ * value; }

    // Finds the first robot of the same sample that equals this one, if it is an earlier one.
    template <class Equal>
    const Robot* alike_of(const Robot& robot, Equal&& equal) const {
        const Robot* first = &robots_[robot.sample * input_.actions];
        const Robot* found = std::find_if(first, &robot, equal);
        return found == &robot ? nullptr : found;
    }

    // Pays for a later sensing step; at the first ones the state may become known.
    void sense(std::size_t later) {
        for (Robot& robot : robots_) add(robot, -input_.price * robot.share);
        if (later > input_.looks) return;
        const double chance = later == input_.looks ? 1.0 : 1.0 / static_cast<double>(input_.looks);
        walkers_.clear();
        for (Robot& robot : robots_) {
            if (!goes_on(robot)) continue;
            robot.alike = alike_of(robot, [&](const Robot& other) {
                return other.state == robot.state && other.stage == robot.stage;
            });
            robot.value = 0.0;
            if (robot.alike == nullptr) walkers_.push_back({&robot, robot.state, robot.stage});
        }
        find_known_values(later * input_.interval);
        for (Robot& robot : robots_) {
            if (!goes_on(robot)) continue;
            if (robot.alike != nullptr) robot.value = robot.alike->value;
            const double share = robot.share * chance;
            robot.share -= share;
            add(robot, share * robot.value);
        }
    }

    // What is earned from the step on by robots that know their state, without obstacles.
    void find_known_values(std::size_t from) {
        double factor = 1.0;
        for (std::size_t step = from; step < input_.steps && !walkers_.empty(); ++step) {
            if ((step - from) % steps_of_long_work == 0) check_interruption();
            const bool pays = step > from && step % input_.interval == 0;
            draw_free_noise(step);
            std::erase_if(walkers_, [&](Walker& own) {
                double& value = own.robot->value;
                if (pays) value -= factor * input_.price;
                State action;
                own.stage = policy_.next_stage(own.state.data(), own.stage);
                policy_.executed(own.state.data(), own.stage, action.data());
                const State& noise = free_noise_[own.robot->sample][step];
                for (std::size_t c = 0; c < d; ++c) {
                    own.state[c] = own.state[c] + action[c] + noise[c];
                }
                value += factor * reward(own.state, action);
                return policy_.is_goal(own.state.data());
            });
            factor *= input_.discount;
        }
    }

    // The true state's noise where it is drawn once, for all robots of a sample.
    void draw_free_noise(std::size_t step) {
        for (const Walker& own : walkers_) {
            std::vector<State>& noise = free_noise_[own.robot->sample];
            while (noise.size() <= step) {
                ask(streams_[noise.size()].first, own.robot->sample * particles_, noise);
            }
        }
        draw();
    }

    // Draws the noise of a particle together with what else is asked for, at the end of `to`.
    void ask(const Stream& stream, std::size_t particle, std::vector<State>& to) {
        asked_.push_back(stream);
        places_.push_back((first_ * particles_ + particle) * d);
        to.emplace_back();
        targets_.push_back({&to, to.size() - 1});
    }

    void draw() {
        drawn_.resize(asked_.size() * d);
        vector_kernels().normals_of_each(asked_.data(), places_.data(), asked_.size(), d,
                                         drawn_.data());
        for (std::size_t i = 0; i < asked_.size(); ++i) {
            State& noise = (*targets_[i].first)[targets_[i].second];
            for (std::size_t c = 0; c < d; ++c) {
                noise[c] = input_.standard_deviation[c] * drawn_[i * d + c];
            }
        }
        asked_.clear();
        places_.clear();
        targets_.clear();
    }

    void act(const StepStreams& streams) {
        movers_.clear();
        for (const std::size_t i : active_) {
            for (std::size_t r = i * input_.actions; r < (i + 1) * input_.actions; ++r) {
                decide(r);
            }
        }
        move(streams);
        for (const std::size_t i : active_) {
            for (std::size_t r = i * input_.actions; r < (i + 1) * input_.actions; ++r) {
                Robot& robot = robots_[r];
                if (!goes_on(robot)) continue;
                if (robot.alike != nullptr) robot.state = robot.alike->state;
                add(robot, robot.share * reward(robot.state, robot.action));
                if (policy_.is_goal(robot.state.data())) robot.share = 0.0;
            }
        }
    }

    // Chooses the action of a robot, by which it and its particles move.
    void decide(std::size_t r) {
        Robot& robot = robots_[r];
        if (!goes_on(robot)) {
            robot.before.fill(std::numeric_limits<double>::infinity());
            return;
        }
        State believed = mean_of_cloud(r);
        for (std::size_t c = 0; c < d; ++c) believed[c] += robot.offset[c];
        robot.stage = policy_.next_stage(believed.data(), robot.stage);
        policy_.executed(believed.data(), robot.stage, robot.action.data());
        const std::size_t own = robot.sample * particles_;
        for (std::size_t l = 0; l < input_.members; ++l) {
            add_mover(clouds_[r * input_.members + l], robot.action, own + 1 + l);
        }
        robot.before = robot.state;
        // The same action in the same state, and the same noise.
        robot.alike = alike_of(robot, [&](const Robot& other) {
            return other.before == robot.before && other.action == robot.action;
        });
        if (robot.alike == nullptr) add_mover(robot.state, robot.action, own);
    }

    // In place: what is copied right after it was written makes the processor wait.
    void add_mover(State& state, const State& action, std::size_t noise) {
        Mover& own = movers_.emplace_back();
        own.state = &state;
        own.action = &action;
        own.noise = noise;
    }

    double reward(const State& state, const State& action) const {
        return input_.counts_steps ? -1.0 : policy_.reward(world_, state.data(), action.data());
    }

    // As `move` has it.
    void move(const StepStreams& streams) {
        pending_.clear();
        for (std::size_t m = 0; m < movers_.size(); ++m) {
            Mover& own = movers_[m];
            own.way = greatest(*own.action);
            own.room = world_.clearance(own.state->data());
            for (std::size_t c = 0; c < d; ++c) own.next[c] = (*own.state)[c] + (*own.action)[c];
            if (own.way >= own.room) pending_.push_back(m);
        }
        stop_at_contact();
        if (noisy_) add_noise(streams);
        for (Mover& own : movers_) *own.state = own.next;
    }

    // Stops those that would collide, as `stop_at_contact` of motion.hpp does.
    void stop_at_contact() {
        for (const std::size_t m : pending_) candidates_.push_back(movers_[m].next);
        test_candidates();
        keep_pending([&](std::size_t p, Mover& own) {
            own.reached = 0.0;
            own.blocked = 1.0;
            return collides_[p] != 0;
        });
        while (true) {
            keep_pending([&](std::size_t, Mover& own) {
                const double fraction = 0.5 * (own.reached + own.blocked);
                const bool ends = own.blocked - own.reached <= input_.tolerance ||
                                  fraction <= own.reached || fraction >= own.blocked;
                go(own, ends ? own.reached : fraction,
                   ends ? own.next : candidates_.emplace_back());
                return !ends;
            });
            if (pending_.empty()) return;
            test_candidates();
            keep_pending([&](std::size_t p, Mover& own) {
                (collides_[p] != 0 ? own.blocked : own.reached) = 0.5 * (own.reached + own.blocked);
                return true;
            });
        }
    }

    static void go(const Mover& own, double fraction, State& to) {
        for (std::size_t c = 0; c < d; ++c) to[c] = (*own.state)[c] + fraction * (*own.action)[c];
    }

    // Adds noise that leads to no collision. Attempts after the first are rare.
    void add_noise(const StepStreams& streams) {
        for (const std::size_t i : active_) {
            for (std::size_t p = i * particles_; p < (i + 1) * particles_; ++p) {
                noise_[p].clear();
                ask(streams.first, p, noise_[p]);
            }
        }
        draw();
        attempts_.assign(1, streams.first);
        pending_.resize(movers_.size());
        std::iota(pending_.begin(), pending_.end(), 0);
        // What stays clear of obstacles asks for no collision.
        keep_pending([&](std::size_t, Mover& own) {
            const State& noise = noise_[own.noise][0];
            if (own.way + greatest(noise) >= own.room) return true;
            for (std::size_t c = 0; c < d; ++c) own.next[c] = own.next[c] + noise[c];
            return false;
        });
        std::size_t at_once = 1;
        for (std::size_t attempt = 0; attempt < max_noise_attempts && !pending_.empty();
             attempt += at_once) {
            if (attempt > 0) {
                check_interruption();
                at_once = std::clamp<std::size_t>(attempts_at_once / pending_.size(), 1,
                                                  max_noise_attempts - attempt);
                draw_attempts(streams.step, attempt + at_once);
            }
            for (const std::size_t m : pending_) {
                for (std::size_t a = attempt; a < attempt + at_once; ++a) {
                    State& placed = candidates_.emplace_back();
                    const Mover& own = movers_[m];
                    const State& noise = noise_[own.noise][a];
                    for (std::size_t c = 0; c < d; ++c) placed[c] = own.next[c] + noise[c];
                }
            }
            test_candidates();
            keep_pending([&](std::size_t p, Mover& own) {
                for (std::size_t a = 0; a < at_once; ++a) {
                    if (collides_[p * at_once + a] != 0) continue;
                    const State& noise = noise_[own.noise][attempt + a];
                    for (std::size_t c = 0; c < d; ++c) own.next[c] = own.next[c] + noise[c];
                    return false;
                }
                return true;
            });
        }
    }

    // Draws the noise of so many attempts for what is pending.
    void draw_attempts(const Stream& step, std::size_t count) {
        if (const std::size_t known = attempts_.size(); known < count) {
            std::vector<std::uint32_t> numbers(std::max(count - known, lane_count));
            std::iota(numbers.begin(), numbers.end(), static_cast<std::uint32_t>(known));
            attempts_.resize(known + numbers.size(), step);
            vector_kernels().substreams(&attempts_[known], numbers.data(), numbers.size(),
                                        &attempts_[known]);
        }
        for (const std::size_t m : pending_) {
            const std::size_t particle = movers_[m].noise;
            std::vector<State>& noise = noise_[particle];
            while (noise.size() < count) ask(attempts_[noise.size()], particle, noise);
        }
        draw();
    }

    // Answers in collides_ which of the candidates are in collision, and forgets these.
    void test_candidates() {
        collides_.resize(candidates_.size());
        if (!candidates_.empty()) {
            world_.collide_each(candidates_.data()->data(), candidates_.size(), collides_.data());
        }
        candidates_.clear();
    }

    // Keeps of what is pending those that keep(place, mover) says.
    template <class Keep>
    void keep_pending(Keep&& keep) {
        std::size_t kept = 0;
        for (std::size_t p = 0; p < pending_.size(); ++p) {
            if (keep(p, movers_[pending_[p]])) pending_[kept++] = pending_[p];
        }
        pending_.resize(kept);
    }

    static double greatest(const State& way) {
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
    std::size_t first_, particles_;  // the first sample; particles with noise of their own in each
    bool noisy_;
    std::vector<std::size_t> active_;             // samples, from 0
    std::vector<Robot> robots_;                   // [sample][action]
    std::vector<State> clouds_;                   // [sample][action][member]
    std::vector<std::vector<State>> noise_;       // [sample][particle][attempt]
    std::vector<std::vector<State>> free_noise_;  // [sample][step]
    std::vector<Mover> movers_;
    std::vector<Walker> walkers_;
    std::vector<std::size_t> pending_;  // of the movers
    std::vector<State> candidates_;
    std::vector<std::uint8_t> collides_;
    std::vector<Stream> attempts_, asked_;
    std::vector<std::uint64_t> places_;
    std::vector<std::pair<std::vector<State>*, std::size_t>> targets_;
    std::vector<double> drawn_;
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
    const std::size_t most = (input.samples + least_samples - 1) / least_samples;
    const auto wanted = static_cast<std::size_t>(threads_for(work, most, threads));
    const std::size_t size = std::min((input.samples + wanted - 1) / wanted, most_samples);
    parallel_for((input.samples + size - 1) / size, static_cast<int>(wanted), [&](std::size_t i) {
        const std::size_t begin = i * size, count = std::min(size, input.samples - begin);
        Samples<World, Policy>(world, policy, input, streams, begin, count, returns).run();
    });
}

bool beliefs_without_truth(std::size_t actions, std::size_t samples, std::size_t count,
                           std::size_t dimension, std::size_t members_each, const double* states,
                           const std::int64_t* truths, const Stream& stream, double negligible,
                           double* weights, double* means, double* clouds) {
    std::vector<double> rest(count), columns(dimension * count), at(samples);
    for (std::size_t n = 0; n < count; ++n) {
        for (std::size_t c = 0; c < dimension; ++c) {
            columns[c * count + n] = states[n * dimension + c];
        }
    }
    uniforms(stream, 0, samples, at.data());
    for (std::size_t row = 0; row < actions * samples; ++row) {
        check_interruption();
        double* own = weights + row * count;
        const auto truth = static_cast<std::size_t>(truths[row % samples]);
        if (!(own[truth] >= 0.0)) return false;  // also a NaN
        std::copy(own, own + count, rest.begin());
        rest[truth] = 0.0;
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
            const double place =
                (static_cast<double>(l) + at[row % samples]) / static_cast<double>(members_each);
            while (n < count && cumulated + own[n] <= place) {
                if (own[n] > 0.0) last = n;
                cumulated += own[n++];
            }
            const double* member = states + (n < count ? n : last) * dimension;
            std::copy(member, member + dimension, clouds + (row * members_each + l) * dimension);
        }
    }
    return true;
}

#define HOLDFAST_INSTANTIATE(World, Policy)                                                 \
    template void roll_out<World, Policy>(const World&, const Policy&, const RolloutInput&, \
                                          const Stream&, int, double*);

HOLDFAST_INSTANTIATE(DiscWorld, ViaPointPolicy)
HOLDFAST_INSTANTIATE(RectangleWorld, PegPolicy2D)
HOLDFAST_INSTANTIATE(BoxWorld, PegPolicy3D)
#undef HOLDFAST_INSTANTIATE

}  // namespace holdfast
