#include "motion.hpp"

#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <limits>
#include <utility>

#include "geometry_2d.hpp"
#include "geometry_3d.hpp"
#include "policies.hpp"
#include "thread_pool.hpp"

namespace holdfast {
namespace {

// Particles are worked on in blocks: large enough that the first draw of noise is one call, small
// enough that its numbers stay on the stack and in the cache.
constexpr std::size_t block_size = 128;

// States whose collisions are tested faster eight at a time than one by one.
constexpr std::size_t worth_testing_together = 4;

// Few particles that are not in an obstacle need more attempts to find a free place.
constexpr std::size_t attempts_of_long_work = 16;

// About what one particle takes; from it follows how many threads are worth their waking.
constexpr double nanoseconds_of_a_move = 80.0;

// Adds noise to the `count` states of one block, of which the first is particle `first`. Returns
// how many found no free state; those are left as they are.
template <class World>
std::size_t add_noise(const World& world, std::size_t first, std::size_t count,
                      const double* standard_deviation, const Stream& stream, double* states) {
    constexpr std::size_t d = World::dimension;
    std::array<double, block_size * d> noise;
    std::array<std::size_t, block_size> pending;
    std::size_t num_pending = 0;

    const auto place = [&](double* state, const double* normal_numbers) {
        std::array<double, d> candidate;
        for (std::size_t c = 0; c < d; ++c) {
            candidate[c] = state[c] + standard_deviation[c] * normal_numbers[c];
        }
        if (world.collides(candidate.data())) return false;
        std::copy(candidate.begin(), candidate.end(), state);
        return true;
    };

    normals(substream(stream, 0), first * d, count * d, noise.data());
    for (std::size_t i = 0; i < count; ++i) {
        if (!place(states + i * d, noise.data() + i * d)) pending[num_pending++] = i;
    }
    for (std::size_t attempt = 1; attempt < max_noise_attempts && num_pending > 0; ++attempt) {
        check_interruption();
        if (attempt == attempts_of_long_work && long_work != nullptr) long_work->begins();
        const Stream draws = substream(stream, attempt);
        std::size_t still_pending = 0;
        for (std::size_t p = 0; p < num_pending; ++p) {
            const std::size_t i = pending[p];
            normals(draws, (first + i) * d, d, noise.data());
            if (!place(states + i * d, noise.data())) pending[still_pending++] = i;
        }
        num_pending = still_pending;
    }
    return num_pending;
}

// Moves the block of `count` states of which the first is particle `first`.
template <class World>
void move_block(const World& world, std::size_t first, std::size_t count, const double* states,
                const double* actions, std::size_t action_stride, const double* standard_deviation,
                bool noisy, double tolerance, const Stream& stream, double* next) {
    constexpr std::size_t d = World::dimension;
    for (std::size_t n = first; n < first + count; ++n) {
        stop_at_contact(world, states + n * d, actions + n * action_stride, tolerance,
                        next + n * d);
    }
    if (noisy) add_noise(world, first, count, standard_deviation, stream, next + first * d);
}

int threads_for_particles(std::size_t count) {
    return count >= parallel_threshold ? thread_limit(0) : 1;
}

bool all_zero(const double* values, std::size_t count) {
    return std::all_of(values, values + count, [](double value) { return value == 0.0; });
}

}  // namespace

template <class World>
void move(const World& world, std::size_t count, const double* states, const double* actions,
          std::size_t action_stride, const double* standard_deviation, double tolerance,
          const Stream& stream, double* next) {
    constexpr std::size_t d = World::dimension;
    const bool noisy = !all_zero(standard_deviation, d);
    const std::size_t num_blocks = (count + block_size - 1) / block_size;

    parallel_for(num_blocks, threads_for_particles(count), [&](std::size_t block) {
        const std::size_t first = block * block_size;
        const std::size_t size = std::min(block_size, count - first);
        move_block(world, first, size, states, actions, action_stride, standard_deviation, noisy,
                   tolerance, stream, next);
    });
}

template <class World>
void move_each(const World& world, std::size_t beliefs, std::size_t count, const double* states,
               const double* actions, const double* standard_deviation, double tolerance,
               const Stream* streams, int threads, double* next) {
    constexpr std::size_t d = World::dimension;
    const bool noisy = !all_zero(standard_deviation, d);
    const std::size_t num_blocks = (count + block_size - 1) / block_size;
    const double work = nanoseconds_of_a_move * static_cast<double>(beliefs * count);

    parallel_for(beliefs * num_blocks, threads_for(work, beliefs * num_blocks, threads),
                 [&](std::size_t task) {
                     const std::size_t belief = task / num_blocks;
                     const std::size_t first = task % num_blocks * block_size;
                     const std::size_t size = std::min(block_size, count - first);
                     move_block(world, first, size, states + belief * count * d,
                                actions + belief * d, 0, standard_deviation, noisy, tolerance,
                                streams[belief], next + belief * count * d);
                 });
}

template <class World>
std::size_t draw_free(const World& world, std::size_t count, const double* mean,
                      const double* standard_deviation, const Stream& stream, double* states) {
    constexpr std::size_t d = World::dimension;
    const std::size_t num_blocks = (count + block_size - 1) / block_size;
    std::atomic<std::size_t> unplaced = 0;

    parallel_for(num_blocks, threads_for_particles(count), [&](std::size_t block) {
        const std::size_t first = block * block_size;
        const std::size_t size = std::min(block_size, count - first);
        for (std::size_t n = first; n < first + size; ++n)
            std::copy(mean, mean + d, states + n * d);
        unplaced += add_noise(world, first, size, standard_deviation, stream, states + first * d);
    });
    return unplaced;
}

template <class World, class Policy>
void follow(const World& world, const Policy& policy, std::size_t count, const double* states,
            std::size_t stage, const std::vector<std::uint32_t>& offsets, double tolerance,
            int threads, bool commands, double* rows_at, std::int64_t* stages_at) {
    constexpr std::size_t d = World::dimension;
    static_assert(Policy::dimension == d);
    const auto& steps = kernels_of(vector_kernels(), policy);
    const auto shape = world.shape();
    constexpr double cost_of_a_step = 20.0;
    const std::size_t num_blocks = (count + way_stride - 1) / way_stride;
    const double work =
        cost_of_a_step * static_cast<double>(count) * static_cast<double>(offsets.back());

    parallel_for(num_blocks, threads_for(work, num_blocks, threads), [&](std::size_t block) {
        const std::size_t first = block * way_stride;
        const std::size_t end = std::min(first + way_stride, count);
        const std::size_t own = end - first;
        // Step by step through the block: eight particles side by side.
        alignas(64) std::array<double, d * way_stride> state, action, next;
        alignas(64) std::array<double, way_stride> room;
        std::array<std::int64_t, way_stride> own_stage;
        std::array<std::array<double, d>, way_stride> tested;
        std::array<std::uint8_t, way_stride> collides;
        std::array<std::size_t, way_stride> near;
        std::array<double, way_stride> reached, blocked;  // fractions of the way
        // Less than any step, also than one that only turns.
        constexpr double unknown = -1.0;
        room.fill(tolerance == 0.0 ? std::numeric_limits<double>::infinity() : unknown);
        own_stage.fill(static_cast<std::int64_t>(stage));
        for (std::size_t i = 0; i < way_stride; ++i) {
            const double* from = states + (first + std::min(i, own - 1)) * d;
            for (std::size_t c = 0; c < d; ++c) state[c * way_stride + i] = from[c];
        }
        const Way way{own,         state.data(), action.data(), next.data(), own_stage.data(),
                      room.data(), world.round()};
        std::uint32_t moving = ~std::uint32_t{0} >> (way_stride - own);
        const auto test = [&](std::size_t number) {
            if (number >= worth_testing_together) {
                world.collide_each(tested[0].data(), number, collides.data());
                return;
            }
            for (std::size_t n = 0; n < number; ++n) collides[n] = world.collides(tested[n].data());
        };
        // Stops those that collide, as `stop_at_contact` does, but all of them together.
        const auto stop = [&](std::uint32_t hits) {
            std::size_t left = 0;
            for (; hits != 0; hits &= hits - 1) {
                const auto i = static_cast<std::size_t>(std::countr_zero(hits));
                reached[i] = 0.0;
                blocked[i] = 1.0;
                near[left++] = i;
            }
            while (left > 0) {
                const std::size_t num_near = std::exchange(left, 0);
                for (std::size_t n = 0; n < num_near; ++n) {
                    const std::size_t i = near[n];
                    const double fraction = 0.5 * (reached[i] + blocked[i]);
                    const bool goes_on = blocked[i] - reached[i] > tolerance &&
                                         fraction > reached[i] && fraction < blocked[i];
                    for (std::size_t c = 0; c < d; ++c) {
                        const std::size_t at = c * way_stride + i;
                        const double to =
                            state[at] + (goes_on ? fraction : reached[i]) * action[at];
                        (goes_on ? tested[left][c] : next[at]) = to;
                    }
                    if (goes_on) near[left++] = i;
                }
                test(left);
                for (std::size_t n = 0; n < left; ++n) {
                    const std::size_t i = near[n];
                    (collides[n] != 0 ? blocked : reached)[i] = 0.5 * (reached[i] + blocked[i]);
                }
            }
        };
        std::uint32_t step = 0;
        for (std::size_t k = 0; k < offsets.size(); ++k) {
            // Without noise, what stands still once does so for ever.
            for (; step < offsets[k] && moving != 0; ++step) {
                if (const auto hits = steps.act(policy, shape, way, moving); hits != 0) stop(hits);
                moving = steps.arrive(policy, way, moving);
            }
            if (commands) steps.command(policy, way);
            const auto& columns = commands ? action : state;
            for (std::size_t i = 0; i < own; ++i) {
                const std::size_t at = k * count + first + i;
                for (std::size_t c = 0; c < d; ++c) {
                    rows_at[at * d + c] = columns[c * way_stride + i];
                }
                stages_at[at] = own_stage[i];
            }
        }
    });
}

#define HOLDFAST_INSTANTIATE(World)                                                                \
    template void move<World>(const World&, std::size_t, const double*, const double*,             \
                              std::size_t, const double*, double, const Stream&, double*);         \
    template void move_each<World>(const World&, std::size_t, std::size_t, const double*,          \
                                   const double*, const double*, double, const Stream*, int,       \
                                   double*);                                                       \
    template std::size_t draw_free<World>(const World&, std::size_t, const double*, const double*, \
                                          const Stream&, double*);

#define HOLDFAST_INSTANTIATE_WAY(World, Policy)                                                  \
    template void follow<World, Policy>(const World&, const Policy&, std::size_t, const double*, \
                                        std::size_t, const std::vector<std::uint32_t>&, double,  \
                                        int, bool, double*, std::int64_t*);

HOLDFAST_INSTANTIATE(DiscWorld)
HOLDFAST_INSTANTIATE(RectangleWorld)
HOLDFAST_INSTANTIATE(BoxWorld)
HOLDFAST_INSTANTIATE_WAY(DiscWorld, ViaPointPolicy)
HOLDFAST_INSTANTIATE_WAY(RectangleWorld, PegPolicy2D)
HOLDFAST_INSTANTIATE_WAY(BoxWorld, PegPolicy3D)
#undef HOLDFAST_INSTANTIATE
#undef HOLDFAST_INSTANTIATE_WAY

}  // namespace holdfast
