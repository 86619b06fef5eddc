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

// Steps of free noise that are drawn together for a sample.
constexpr std::size_t steps_at_once = 4;

// Samples that a thread takes together: enough to fill the processor's registers.
constexpr std::size_t least_samples = 5, most_samples = 32;

// Streams of a step: its own, and that of the first attempt to place the noise.
struct StepStreams {
    Stream step, first;
};

// Coordinates of many states side by side, one row for each coordinate.
template <std::size_t d>
class Columns {
  public:
    void reserve(std::size_t states) {
        stride_ = (states + lane_count - 1) / lane_count * lane_count;
        values_.resize(stride_ * d);
    }
    std::size_t stride() const { return stride_; }
    double* data() { return values_.data(); }
    double& at(std::size_t state, std::size_t c) { return values_[c * stride_ + state]; }
    double at(std::size_t state, std::size_t c) const { return values_[c * stride_ + state]; }
    void set(std::size_t state, const std::array<double, d>& from) {
        for (std::size_t c = 0; c < d; ++c) at(state, c) = from[c];
    }
    std::array<double, d> get(std::size_t state) const {
        std::array<double, d> result;
        for (std::size_t c = 0; c < d; ++c) result[c] = at(state, c);
        return result;
    }
    void copy(std::size_t from, std::size_t to) {
        for (std::size_t c = 0; c < d; ++c) at(to, c) = at(from, c);
    }

  private:
    std::size_t stride_ = 0;
    std::vector<double> values_;
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
          shape_(world.shape()),
          steps_(kernels_of(vector_kernels(), policy)),
          input_(input),
          streams_(streams),
          first_(first),
          particles_(1 + input.members),
          noisy_(std::any_of(input.standard_deviation, input.standard_deviation + d,
                             [](double each) { return each != 0.0; })),
          active_(count),
          robots_(count * input.actions),
          clouds_(count * input.actions * input.members),
          first_noise_(count * particles_),
          more_noise_(count * particles_),
          free_noise_(count) {
        std::iota(active_.begin(), active_.end(), 0);
        for (Columns<d>* each : {&believed_, &actions_, &arrived_, &walking_, &walk_noise_}) {
            each->reserve(robots_.size());
        }
        stages_.resize(believed_.stride());
        walk_stages_.resize(believed_.stride());
        rewards_.resize(believed_.stride());
        walk_values_.resize(believed_.stride());
        goals_.resize(believed_.stride());
        moving_.reserve(robots_.size() * particles_);
        room_.resize(moving_.stride());
        for (std::size_t r = 0; r < robots_.size(); ++r) {
            Robot& robot = robots_[r];
            robot.sample = r / input.actions;
            const std::size_t belief = r % input.actions * input.samples + first + robot.sample;
            const double* state = input.true_states + (first + robot.sample) * d;
            const double* cloud = input.clouds + belief * input.members * d;
            robot.sum = &returns[belief];
            *robot.sum = 0.0;
            robot.stage = static_cast<std::int64_t>(input.stage);
            std::copy(state, state + d, robot.state.begin());
            for (std::size_t l = 0; l < input.members; ++l) {
                std::copy(cloud + l * d, cloud + (l + 1) * d,
                          clouds_[r * input.members + l].begin());
            }
            const State mean = mean_of_cloud(r);
            for (std::size_t c = 0; c < d; ++c) {
                robot.offset[c] = input.estimates[belief * d + c] - mean[c];
            }
            arrived_.set(r, robot.state);
        }
        judge(robots_.size(), nullptr);
        for (std::size_t r = 0; r < robots_.size(); ++r) robots_[r].share = goals_[r] ? 0.0 : 1.0;
    }

    void run() {
        for (std::size_t step = 0; step < input_.steps; ++step) {
            if (step % steps_of_long_work == 0) check_interruption();
            if (step > 0 && step % input_.interval == 0) sense(step / input_.interval);
            going_.clear();
            std::erase_if(active_, [&](std::size_t i) {
                const std::size_t before = going_.size();
                for (std::size_t r = i * input_.actions; r < (i + 1) * input_.actions; ++r) {
                    if (goes_on(robots_[r])) going_.push_back(r);
                }
                return going_.size() == before;
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
        State action;  // executed in the state
        std::size_t sample;
        std::int64_t stage;
        double share;  // the probability that its state is not known; 0 where the goal is reached
        double value;  // of its state, when it last could become known
        double* sum;   // its return so far
        const Robot* alike;  // an earlier one of its sample in the same state, or null
    };
    static bool goes_on(const Robot& robot) { return robot.share > 0.0; }

    // A state that an action moves; `noise` is its place in first_noise_.
    struct Mover {
        State* state;
        const State* action;
        std::size_t noise;
        State next;
        double room, way;
        double reached, blocked;  // fractions of the way
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
        for (const Robot* other = &robots_[robot.sample * input_.actions]; other < &robot;
             ++other) {
            if (goes_on(*other) && equal(*other)) return other;
        }
        return nullptr;
    }

    // Answers in goals_ and rewards_ for the first `count` of arrived_.
    void judge(std::size_t count, double* rewards) {
        steps_.judge(policy_, shape_, arrived_.data(), actions_.data(), arrived_.stride(), count,
                     rewards, goals_.data());
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
            if (robot.alike != nullptr) continue;
            const std::size_t w = walkers_.size();
            walking_.set(w, robot.state);
            walk_stages_[w] = robot.stage;
            walk_values_[w] = 0.0;
            walkers_.push_back(&robot);
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
        FreeWalk way{walking_.stride(),
                     0,
                     walking_.data(),
                     walk_stages_.data(),
                     walk_noise_.data(),
                     walk_values_.data(),
                     1.0,
                     0.0,
                     false,
                     input_.counts_steps,
                     goals_.data()};
        for (std::size_t step = from; step < input_.steps && !walkers_.empty(); ++step) {
            if ((step - from) % steps_of_long_work == 0) check_interruption();
            draw_free_noise(step);
            way.count = walkers_.size();
            way.pays = step > from && step % input_.interval == 0;
            way.price = way.factor * input_.price;
            steps_.walk(policy_, shape_, way);
            way.factor *= input_.discount;
            // The last one takes the place of one that has arrived.
            for (std::size_t w = walkers_.size(); w-- > 0;) {
                if (goals_[w] == 0) continue;
                walkers_[w]->value = walk_values_[w];
                const std::size_t last = walkers_.size() - 1;
                walkers_[w] = walkers_[last];
                walking_.copy(last, w);
                walk_stages_[w] = walk_stages_[last];
                walk_values_[w] = walk_values_[last];
                walkers_.pop_back();
            }
        }
        for (std::size_t w = 0; w < walkers_.size(); ++w) walkers_[w]->value = walk_values_[w];
    }

    // The true state's noise where it is drawn once, for all robots of a sample.
    void draw_free_noise(std::size_t step) {
        const std::size_t at = step - input_.interval;  // known states begin at the first interval
        for (const Robot* own : walkers_) {
            std::vector<State>& noise = free_noise_[own->sample];
            if (noise.size() > at) continue;
            const std::size_t end = std::min(at + steps_at_once, input_.steps - input_.interval);
            while (noise.size() < end) {
                const Stream& stream = streams_[input_.interval + noise.size()].first;
                ask(stream, own->sample * particles_, noise);
            }
        }
        draw();
        for (std::size_t w = 0; w < walkers_.size(); ++w) {
            walk_noise_.set(w, free_noise_[walkers_[w]->sample][at]);
        }
    }

    // Draws the noise of a particle together with what else is asked for, at the end of `to`.
    void ask(const Stream& stream, std::size_t particle, std::vector<State>& to) {
        asked_.push_back(stream);
        firsts_.push_back(static_cast<std::uint32_t>((first_ * particles_ + particle) * d / 2));
        to.emplace_back();
        targets_.push_back({&to, to.size() - 1, (first_ * particles_ + particle) * d % 2});
    }

    void draw() {
        if (asked_.empty()) return;
        constexpr std::size_t each = (d + 1) / 2;  // blocks with d draws from any first one on
        drawn_.resize(asked_.size() * 2 * each);
        vector_kernels().normal_blocks(asked_.data(), firsts_.data(), asked_.size(), each,
                                       drawn_.data());
        for (std::size_t i = 0; i < asked_.size(); ++i) {
            const auto& [to, index, odd] = targets_[i];
            scale_noise(&drawn_[i * 2 * each + odd], (*to)[index]);
        }
        asked_.clear();
        firsts_.clear();
        targets_.clear();
    }

    void scale_noise(const double* drawn, State& noise) const {
        for (std::size_t c = 0; c < d; ++c) noise[c] = input_.standard_deviation[c] * drawn[c];
    }

    // Draws a step's first noise of all particles of samples that go on.
    void draw_first_noise(const Stream& stream) {
        for (std::size_t a = 0; a < active_.size();) {
            std::size_t end = a + 1;
            while (end < active_.size() && active_[end] == active_[end - 1] + 1) ++end;
            const std::size_t begin = active_[a] * particles_, count = (end - a) * particles_;
            drawn_.resize(count * d);
            normals(stream, (first_ * particles_ + begin) * d, count * d, drawn_.data());
            for (std::size_t p = 0; p < count; ++p) {
                scale_noise(&drawn_[p * d], first_noise_[begin + p]);
                more_noise_[begin + p].clear();
            }
            a = end;
        }
    }

    void act(const StepStreams& streams) {
        decide();
        move(streams);
        for (std::size_t k = 0; k < going_.size(); ++k) {
            Robot& robot = robots_[going_[k]];
            if (robot.alike != nullptr) robot.state = robot.alike->state;
            arrived_.set(k, robot.state);
        }
        judge(going_.size(), input_.counts_steps ? nullptr : rewards_.data());
        for (std::size_t k = 0; k < going_.size(); ++k) {
            Robot& robot = robots_[going_[k]];
            add(robot, robot.share * (input_.counts_steps ? -1.0 : rewards_[k]));
            if (goals_[k] != 0) robot.share = 0.0;
        }
    }

    // Chooses the actions of robots, by which they and their particles move.
    void decide() {
        for (std::size_t k = 0; k < going_.size(); ++k) {
            const Robot& robot = robots_[going_[k]];
            const State mean = mean_of_cloud(going_[k]);
            for (std::size_t c = 0; c < d; ++c) believed_.at(k, c) = mean[c] + robot.offset[c];
            stages_[k] = robot.stage;
        }
        steps_.decide(policy_, believed_.data(), believed_.stride(), going_.size(), stages_.data(),
                      actions_.data());
        movers_.clear();
        for (std::size_t k = 0; k < going_.size(); ++k) {
            const std::size_t r = going_[k];
            Robot& robot = robots_[r];
            robot.stage = stages_[k];
            robot.action = actions_.get(k);
            const std::size_t own = robot.sample * particles_;
            for (std::size_t l = 0; l < input_.members; ++l) {
                add_mover(clouds_[r * input_.members + l], robot.action, own + 1 + l);
            }
            // The same action in the same state, and the same noise.
            robot.alike = alike_of(robot, [&](const Robot& other) {
                return other.state == robot.state && other.action == robot.action;
            });
            if (robot.alike == nullptr) add_mover(robot.state, robot.action, own);
        }
    }

    // In place: what is copied right after it was written makes the processor wait.
    void add_mover(State& state, const State& action, std::size_t noise) {
        moving_.set(movers_.size(), state);
        Mover& own = movers_.emplace_back();
        own.state = &state;
        own.action = &action;
        own.noise = noise;
    }

    // As `move` has it.
    void move(const StepStreams& streams) {
        pending_.clear();
        steps_.clearances(world_.round(), moving_.data(), moving_.stride(), movers_.size(),
                          room_.data());
        for (std::size_t m = 0; m < movers_.size(); ++m) {
            Mover& own = movers_[m];
            own.way = greatest(*own.action);
            own.room = room_[m];
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
        draw_first_noise(streams.first);
        attempts_.assign(1, streams.first);
        pending_.resize(movers_.size());
        std::iota(pending_.begin(), pending_.end(), 0);
        // What stays clear of obstacles asks for no collision.
        keep_pending([&](std::size_t, Mover& own) {
            const State& noise = first_noise_[own.noise];
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
                    const State& noise = noise_of(own, a);
                    for (std::size_t c = 0; c < d; ++c) placed[c] = own.next[c] + noise[c];
                }
            }
            test_candidates();
            keep_pending([&](std::size_t p, Mover& own) {
                for (std::size_t a = 0; a < at_once; ++a) {
                    if (collides_[p * at_once + a] != 0) continue;
                    const State& noise = noise_of(own, attempt + a);
                    for (std::size_t c = 0; c < d; ++c) own.next[c] = own.next[c] + noise[c];
                    return false;
                }
                return true;
            });
        }
    }

    const State& noise_of(const Mover& own, std::size_t attempt) const {
        return attempt == 0 ? first_noise_[own.noise] : more_noise_[own.noise][attempt - 1];
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
            std::vector<State>& noise = more_noise_[particle];
            while (noise.size() + 1 < count) ask(attempts_[noise.size() + 1], particle, noise);
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
    typename World::Shape shape_;
    const PolicyKernels<Policy, typename World::Shape>& steps_;
    const RolloutInput& input_;
    const std::vector<StepStreams>& streams_;
    std::size_t first_, particles_;  // the first sample; particles with noise of their own in each
    bool noisy_;
    std::vector<std::size_t> active_, going_;     // samples, from 0; robots
    std::vector<Robot> robots_;                   // [sample][action]
    std::vector<State> clouds_;                   // [sample][action][member]
    std::vector<State> first_noise_;              // [sample][particle]
    std::vector<std::vector<State>> more_noise_;  // [sample][particle][attempt after the first]
    std::vector<std::vector<State>> free_noise_;  // [sample][step from the first interval on]
    Columns<d> believed_, actions_, arrived_;     // of the robots that go on
    std::vector<std::int64_t> stages_;
    std::vector<double> rewards_;
    std::vector<std::uint8_t> goals_;
    std::vector<Mover> movers_;
    Columns<d> moving_;  // their states
    std::vector<double> room_;
    std::vector<Robot*> walkers_;  // robots from where their state became known
    Columns<d> walking_, walk_noise_;
    std::vector<std::int64_t> walk_stages_;
    std::vector<double> walk_values_;
    std::vector<std::size_t> pending_;  // of the movers
    std::vector<State> candidates_;
    std::vector<std::uint8_t> collides_;
    std::vector<Stream> attempts_, asked_;
    std::vector<std::uint32_t> firsts_;
    struct Target {
        std::vector<State>* to;
        std::size_t index, odd;  // in `to`; whether its draws begin in the middle of a block
    };
    std::vector<Target> targets_;
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
