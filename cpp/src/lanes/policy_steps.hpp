// What the policies say of eight states side by side (one compilation per instruction set).
//
// Comparisons choose as std::min and std::max do, so a state that is not a number stays one.

#pragma once

#include "../vector_kernels.hpp"
#include "collisions.hpp"

namespace holdfast::inline HOLDFAST_ISA {

HOLDFAST_INLINE Lanes limited(const Lanes& x, double limit) {
    const Lanes above = select(x < -limit, splat(-limit), x);
    return select(above > limit, splat(limit), above);
}

template <std::size_t d>
HOLDFAST_INLINE Lanes minus_norm(const Lanes (&x)[d]) {
    Lanes squared = x[0] * x[0];
    for (std::size_t c = 1; c < d; ++c) squared += x[c] * x[c];
    return -square_root(squared);
}

/// The numbers of the stages that eight states are in, [stage_size].
template <class Policy>
struct StageLanes {
    Lanes number[Policy::stage_size > 0 ? Policy::stage_size : 1];

    HOLDFAST_INLINE StageLanes(const Policy& policy, const std::int64_t* stages) {
        constexpr std::size_t size = Policy::stage_size;
        bool alike = true;
        for (std::size_t lane = 1; lane < lane_count; ++lane) alike &= stages[lane] == stages[0];
        for (std::size_t c = 0; c < size; ++c) {
            number[c] = splat(policy.stages[static_cast<std::size_t>(stages[0]) * size + c]);
        }
        if (alike || size == 0) return;
        for (std::size_t lane = 1; lane < lane_count; ++lane) {
            const double* own = policy.stages + static_cast<std::size_t>(stages[lane]) * size;
            for (std::size_t c = 0; c < size; ++c) number[c][lane] = own[c];
        }
    }
};

HOLDFAST_INLINE void commanded(const PegPolicy2D& policy, const StageLanes<PegPolicy2D>& stage,
                               const Lanes (&state)[3], Lanes (&action)[3]) {
    const Lanes to_axis = stage.number[0] - state[0];
    const IntLanes near = size_of(to_axis) < policy.half_width;
    const IntLanes upright = near & (size_of(state[2]) < stage.number[1]);
    const Lanes none = splat(0.0);
    action[0] = to_axis;
    action[1] = select(upright, stage.number[2] - state[1] - policy.height, none);
    action[2] = select(near, -state[2], none);
}

/// The limits of a peg: each component on its own.
template <class Policy>
HOLDFAST_INLINE void limit(const Policy& policy, Lanes (&action)[Policy::dimension]) {
    for (std::size_t c = 0; c < Policy::dimension; ++c) {
        action[c] = limited(action[c], policy.limits[c]);
    }
}

HOLDFAST_INLINE IntLanes passed(const PegPolicy2D& policy, const StageLanes<PegPolicy2D>& stage,
                                const Lanes (&state)[3]) {
    return state[1] + policy.height < stage.number[2];
}

HOLDFAST_INLINE IntLanes at_goal(const PegPolicy2D& policy, const Lanes (&state)[3]) {
    const PegPolicy2D::Goal& goal = policy.goal;
    return (size_of(state[0] - goal.axis) < goal.tolerance) & (state[1] > goal.above) &
           (state[1] < goal.below);
}

HOLDFAST_INLINE Lanes reward(const PegPolicy2D&, const RectangleShape&, const Lanes (&)[3],
                             const Lanes (&action)[3]) {
    return minus_norm(action);
}

HOLDFAST_INLINE void commanded(const PegPolicy3D& policy, const StageLanes<PegPolicy3D>&,
                               const Lanes (&state)[6], Lanes (&action)[6]) {
    const IntLanes near =
        square_root(state[0] * state[0] + state[1] * state[1]) < policy.half_width;
    const IntLanes upright = near & (square_root(state[3] * state[3] + state[4] * state[4] +
                                                 state[5] * state[5]) < policy.upright_limit);
    const Lanes none = splat(0.0);
    action[0] = -state[0];
    action[1] = -state[1];
    action[2] = select(upright, -state[2], none);
    for (std::size_t c = 3; c < 6; ++c) action[c] = select(near, -state[c], none);
}

HOLDFAST_INLINE IntLanes passed(const PegPolicy3D&, const StageLanes<PegPolicy3D>&,
                                const Lanes (&)[6]) {
    return splat_int(0);
}

HOLDFAST_INLINE IntLanes at_goal(const PegPolicy3D& policy, const Lanes (&state)[6]) {
    const double tolerance = policy.goal_tolerance;
    return (size_of(state[0]) < tolerance) & (size_of(state[1]) < tolerance) &
           (size_of(state[2]) < tolerance);
}

HOLDFAST_INLINE Lanes reward(const PegPolicy3D&, const BoxShape&, const Lanes (&)[6],
                             const Lanes (&action)[6]) {
    return minus_norm(action);
}

HOLDFAST_INLINE void commanded(const ViaPointPolicy&, const StageLanes<ViaPointPolicy>& stage,
                               const Lanes (&state)[2], Lanes (&action)[2]) {
    action[0] = stage.number[2] * (stage.number[0] - state[0]);
    action[1] = stage.number[3] * (stage.number[1] - state[1]);
}

HOLDFAST_INLINE void limit(const ViaPointPolicy& policy, Lanes (&action)[2]) {
    const Lanes x = action[0], y = action[1];
    const Lanes norm = square_root(x * x + y * y);
    const Lanes longest = splat(policy.step_size);
    const Lanes shortened = longest / select(norm < longest, longest, norm);
    action[0] = x * shortened;
    action[1] = y * shortened;
}

HOLDFAST_INLINE IntLanes within(const Lanes (&state)[2], const Lanes& center_x,
                                const Lanes& center_y, const Lanes& squared_radius) {
    const Lanes x = state[0] - center_x, y = state[1] - center_y;
    return x * x + y * y < squared_radius;
}

HOLDFAST_INLINE IntLanes passed(const ViaPointPolicy&, const StageLanes<ViaPointPolicy>& stage,
                                const Lanes (&state)[2]) {
    return within(state, stage.number[0], stage.number[1], stage.number[4]);
}

HOLDFAST_INLINE IntLanes at_goal(const ViaPointPolicy& policy, const Lanes (&state)[2]) {
    const double* last = policy.stages + (policy.num_stages - 1) * ViaPointPolicy::stage_size;
    return within(state, splat(last[0]), splat(last[1]), splat(last[4]));
}

HOLDFAST_INLINE Lanes reward(const ViaPointPolicy&, const DiscShape& shape, const Lanes (&state)[2],
                             const Lanes (&action)[2]) {
    const IntLanes hits = discs_hit(shape, state[0] + action[0], state[1] + action[1]);
    return select(hits, splat(-1.0), splat(0.0));
}

template <class Policy>
HOLDFAST_INLINE void executed(const Policy& policy, const StageLanes<Policy>& stage,
                              const Lanes (&state)[Policy::dimension],
                              Lanes (&action)[Policy::dimension]) {
    commanded(policy, stage, state, action);
    limit(policy, action);
}

/// The states and actions of `Policy` at [begin, begin + 8), side by side.
template <std::size_t d>
HOLDFAST_INLINE void load_columns(const double* columns, std::size_t stride, std::size_t begin,
                                  Lanes (&to)[d]) {
    for (std::size_t c = 0; c < d; ++c) to[c] = load(columns + c * stride + begin);
}
template <std::size_t d>
HOLDFAST_INLINE void store_columns(double* columns, std::size_t stride, std::size_t begin,
                                   const Lanes (&from)[d]) {
    for (std::size_t c = 0; c < d; ++c) store(columns + c * stride + begin, from[c]);
}

HOLDFAST_INLINE IntLanes load_integers(const std::int64_t* from) {
    IntLanes result;
    std::memcpy(&result, from, sizeof result);
    return result;
}

/// Moves on the stages of those of eight states that have passed them, among those in `bits`.
/// Returns which did.
template <class Policy>
HOLDFAST_INLINE unsigned pass_stages(const Policy& policy, const StageLanes<Policy>& stage,
                                     const Lanes (&state)[Policy::dimension], unsigned bits,
                                     std::int64_t* stages) {
    if (policy.num_stages == 1) return 0;
    const auto last = static_cast<std::int64_t>(policy.num_stages - 1);
    unsigned changed = 0;
    bits &= bits_of(passed(policy, stage, state));
    for (std::size_t lane = 0; bits >> lane != 0; ++lane) {
        if ((bits >> lane & 1u) == 0 || stages[lane] == last) continue;
        ++stages[lane];
        changed |= 1u << lane;
    }
    return changed;
}

/// The stages that follow in eight states, and the actions executed there.
template <class Policy>
HOLDFAST_INLINE void decide_eight(const Policy& policy, const Lanes (&state)[Policy::dimension],
                                  std::int64_t* stages, Lanes (&action)[Policy::dimension]) {
    StageLanes<Policy> stage(policy, stages);
    if (pass_stages(policy, stage, state, 0xffu, stages) != 0) {
        stage = StageLanes<Policy>(policy, stages);
    }
    executed(policy, stage, state, action);
}

template <class Policy>
static void decide(const Policy& policy, const double* states, std::size_t stride,
                   std::size_t count, std::int64_t* stages, double* actions) {
    for (std::size_t begin = 0; begin < count; begin += lane_count) {
        Lanes state[Policy::dimension], action[Policy::dimension];
        load_columns(states, stride, begin, state);
        decide_eight(policy, state, stages + begin, action);
        store_columns(actions, stride, begin, action);
    }
}

template <class Policy, class Shape>
static void judge(const Policy& policy, const Shape& shape, const double* states,
                  const double* actions, std::size_t stride, std::size_t count, double* rewards,
                  std::uint8_t* goals) {
    for (std::size_t begin = 0; begin < count; begin += lane_count) {
        Lanes state[Policy::dimension], action[Policy::dimension];
        load_columns(states, stride, begin, state);
        load_columns(actions, stride, begin, action);
        if (rewards != nullptr) store(rewards + begin, reward(policy, shape, state, action));
        put(goals + begin, lane_count, bits_of(at_goal(policy, state)));
    }
}

template <class Policy, class Shape>
static void walk(const Policy& policy, const Shape& shape, const FreeWalk& way) {
    for (std::size_t begin = 0; begin < way.count; begin += lane_count) {
        constexpr std::size_t d = Policy::dimension;
        Lanes state[d], action[d], noise[d];
        load_columns(way.states, way.stride, begin, state);
        load_columns(way.noise, way.stride, begin, noise);
        decide_eight(policy, state, way.stages + begin, action);
        for (std::size_t c = 0; c < d; ++c) state[c] = state[c] + action[c] + noise[c];
        store_columns(way.states, way.stride, begin, state);
        Lanes value = load(way.values + begin);
        if (way.pays) value -= splat(way.price);
        value +=
            way.factor * (way.counts_steps ? splat(-1.0) : reward(policy, shape, state, action));
        store(way.values + begin, value);
        put(way.goals + begin, lane_count, bits_of(at_goal(policy, state)));
    }
}

template <class Policy, class Shape>
static std::uint32_t act(const Policy& policy, const Shape& shape, const Way& way,
                         std::uint32_t moving) {
    std::uint32_t hits = 0;
    for (std::size_t begin = 0; begin < way.count; begin += lane_count) {
        constexpr std::size_t d = Policy::dimension;
        const unsigned own = moving >> begin & 0xffu;
        if (own == 0) continue;
        Lanes state[d], action[d], next[d];
        load_columns(way.states, way_stride, begin, state);
        executed(policy, StageLanes<Policy>(policy, way.stages + begin), state, action);
        store_columns(way.actions, way_stride, begin, action);
        for (std::size_t c = 0; c < d; ++c) next[c] = state[c] + action[c];
        store_columns(way.next, way_stride, begin, next);
        Lanes farthest = size_of(action[0]);
        for (std::size_t c = 1; c < Policy::space_dimension; ++c) {
            const Lanes other = size_of(action[c]);
            farthest = select(farthest < other, other, farthest);
        }
        Lanes room = load(way.room + begin);
        if ((bits_of(room < farthest) & own) == 0) {
            store(way.room + begin, room - farthest);
            continue;
        }
        room = clearance<Policy::space_dimension>(way.round, state);
        const IntLanes near = room <= farthest;
        // Who is near asks again, also after a step that only turns.
        store(way.room + begin, select(near, splat(-1.0), room - farthest));
        if (const unsigned bits = bits_of(near) & own; bits != 0) {
            hits |= static_cast<std::uint32_t>(bits_hit(shape, next, bits)) << begin;
        }
    }
    return hits;
}

template <class Policy>
static void command(const Policy& policy, const Way& way) {
    for (std::size_t begin = 0; begin < way.count; begin += lane_count) {
        Lanes state[Policy::dimension], action[Policy::dimension];
        load_columns(way.states, way_stride, begin, state);
        commanded(policy, StageLanes<Policy>(policy, way.stages + begin), state, action);
        store_columns(way.actions, way_stride, begin, action);
    }
}

template <class Policy>
static std::uint32_t arrive(const Policy& policy, const Way& way, std::uint32_t moving) {
    std::uint32_t still_moving = 0;
    for (std::size_t begin = 0; begin < way.count; begin += lane_count) {
        constexpr std::size_t d = Policy::dimension;
        const unsigned own = moving >> begin & 0xffu;
        if (own == 0) continue;
        Lanes state[d], next[d];
        load_columns(way.states, way_stride, begin, state);
        load_columns(way.next, way_stride, begin, next);
        IntLanes same = next[0] == state[0];
        for (std::size_t c = 1; c < d; ++c) same = same & (next[c] == state[c]);
        std::int64_t* stages = way.stages + begin;
        unsigned changed = ~bits_of(same);
        if (policy.num_stages > 1) {
            changed |= pass_stages(policy, StageLanes<Policy>(policy, stages), next, own, stages);
        }
        if (own != 0xffu) {
            const IntLanes moves = lanes_of(own);
            for (std::size_t c = 0; c < d; ++c) next[c] = select(moves, next[c], state[c]);
        }
        store_columns(way.states, way_stride, begin, next);
        still_moving |= static_cast<std::uint32_t>(own & changed) << begin;
    }
    return still_moving;
}

template <class Policy>
static void clearances(const RoundShape& shape, const double* states, std::size_t stride,
                       std::size_t count, double* out) {
    for (std::size_t begin = 0; begin < count; begin += lane_count) {
        Lanes state[Policy::dimension];
        load_columns(states, stride, begin, state);
        store(out + begin, clearance<Policy::space_dimension>(shape, state));
    }
}

template <class Policy, class Shape>
constexpr PolicyKernels<Policy, Shape> steps_of{
    decide<Policy>,     judge<Policy, Shape>, walk<Policy, Shape>, clearances<Policy>,
    act<Policy, Shape>, arrive<Policy>,       command<Policy>,
};

}  // namespace holdfast::inline HOLDFAST_ISA
