// Motion that stops at contact, with noise that never ends inside an obstacle.
//
// A robot told to move into a wall moves up to the wall. The full action is tried first; if it ends
// in collision, bisection finds the largest fraction of it that does not, to within a tolerance.
// Then Gaussian noise is added, drawn again until the state is free of collision: the noise of a
// robot at a wall is the Gaussian cut off by the wall (rejection sampling).
//
// Attempt a at coordinate c of particle n takes the normal number n * dimension + c of substream a.
// So the bits of one particle depend neither on the others, nor on the order of work, nor on
// the number of threads.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "philox.hpp"

namespace holdfast {

// Draws of the noise before the particle is left where it is without noise.
inline constexpr std::size_t max_noise_attempts = 1000;

/// Told once the calling thread's move or draw proves to take long.
struct LongWork {
    virtual void begins() = 0;

  protected:
    ~LongWork() = default;
};
inline thread_local LongWork* long_work = nullptr;

// Below this number of particles one thread is faster than waking the others.
inline constexpr std::size_t parallel_threshold = 4096;

// Where an action leads without noise, stopped at contact.
template <class World>
void stop_at_contact(const World& world, const double* state, const double* action,
                     double tolerance, double* next) {
    constexpr std::size_t d = World::dimension;
    for (std::size_t c = 0; c < d; ++c) next[c] = state[c] + action[c];
    if (!world.collides(next)) return;

    double reached = 0.0, blocked = 1.0;
    while (blocked - reached > tolerance) {
        const double fraction = 0.5 * (reached + blocked);
        if (fraction <= reached || fraction >= blocked) break;  // no number lies between them
        for (std::size_t c = 0; c < d; ++c) next[c] = state[c] + fraction * action[c];
        (world.collides(next) ? blocked : reached) = fraction;
    }
    for (std::size_t c = 0; c < d; ++c) next[c] = state[c] + reached * action[c];
}

// Moves `count` states by executed actions. `action_stride` is the dimension, or 0 if there is one
// action for all. `tolerance` is a fraction of the action. `next` does not overlap the inputs.
//
// A state that is free before is free after. A state in collision may stay in collision.
template <class World>
void move(const World& world, std::size_t count, const double* states, const double* actions,
          std::size_t action_stride, const double* standard_deviation, double tolerance,
          const Stream& stream, double* next);

// The same for each of several beliefs of `count` states with an action and a stream of its own.
// The bits are those of as many calls of `move`. `threads` as everywhere: 0 is all.
template <class World>
void move_each(const World& world, std::size_t beliefs, std::size_t count, const double* states,
               const double* actions, const double* standard_deviation, double tolerance,
               const Stream* streams, int threads, double* next);

// Draws `count` states of N(mean, diag(standard_deviation^2)) that are free of collision. Returns
// how many found no free state; those are set to the mean.
template <class World>
std::size_t draw_free(const World& world, std::size_t count, const double* mean,
                      const double* standard_deviation, const Stream& stream, double* states);

// Follows a policy of policies.hpp without noise: in each step its action, stopped at contact, and
// the stage that follows. A tolerance of 0: obstacles do not stop it.
//
// `offsets` are numbers of steps, in ascending order. For each of them `stages_at[number][count]`
// is the stage after so many, and `rows_at[number][count]` where the particle is then, or with
// `commands` what the policy commands there, without the limits of a step.
template <class World, class Policy>
void follow(const World& world, const Policy& policy, std::size_t count, const double* states,
            std::size_t stage, const std::vector<std::uint32_t>& offsets, double tolerance,
            int threads, bool commands, double* rows_at, std::int64_t* stages_at);

}  // namespace holdfast
