// The policies, rewards and goals of the built-in problems, for one state at a time.
//
// The problems themselves are NumPy (holdfast/problems/); what a policy says is written there. Here
// it is once more, because a particle's way is many small steps: NumPy takes 20 microseconds for
// each, whatever the number of particles. Both give the same numbers, to the bit.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

namespace holdfast {

// A peg's reward: minus the length of its way.
template <std::size_t d>
double minus_norm(const double* action) {
    double squared = action[0] * action[0];
    for (std::size_t c = 1; c < d; ++c) squared += action[c] * action[c];
    return -std::sqrt(squared);
}

// A peg in the plane, (x, y, theta), goes through one hole after the other: to the hole's axis;
// near it also upright; once upright also down.
struct PegPolicy2D {
    static constexpr std::size_t dimension = 3;

    struct Stage {
        double axis;           // x of the hole
        double upright_limit;  // largest tilt at which the peg is lowered
        double passed_below;   // y of the peg's top below which the hole is passed
    };

    // Around the last hole's axis, and between two heights.
    struct Goal {
        double axis, tolerance, above, below;
    };

    std::vector<Stage> stages;
    double half_width, height;
    std::array<double, 3> limits;
    Goal goal;

    std::size_t num_stages() const { return stages.size(); }

    void executed(const double* state, std::size_t stage, double* action) const {
        const Stage& own = stages[stage];
        const double to_axis = own.axis - state[0];
        const bool near = std::abs(to_axis) < half_width;
        const bool upright = near && std::abs(state[2]) < own.upright_limit;
        action[0] = to_axis;
        action[1] = upright ? own.passed_below - state[1] - height : 0.0;
        action[2] = near ? -state[2] : 0.0;
        for (std::size_t c = 0; c < 3; ++c) {
            action[c] = std::min(std::max(action[c], -limits[c]), limits[c]);
        }
    }

    std::size_t next_stage(const double* state, std::size_t stage) const {
        const bool passed = state[1] + height < stages[stage].passed_below;
        return std::min(stage + (passed ? 1 : 0), stages.size() - 1);
    }

    template <class World>
    double reward(const World&, const double*, const double* action) const {
        return minus_norm<3>(action);
    }

    bool is_goal(const double* state) const {
        return std::abs(state[0] - goal.axis) < goal.tolerance && goal.above < state[1] &&
               state[1] < goal.below;
    }
};

// A peg in space, (x, y, z, yaw, pitch, roll): to the axis of the hole at the origin; near it also
// upright; once upright also down.
struct PegPolicy3D {
    static constexpr std::size_t dimension = 6;

    double half_width, upright_limit;
    std::array<double, 6> limits;
    double goal_tolerance;

    std::size_t num_stages() const { return 1; }

    void executed(const double* state, std::size_t, double* action) const {
        const bool near = std::sqrt(state[0] * state[0] + state[1] * state[1]) < half_width;
        const bool upright = near && std::sqrt(state[3] * state[3] + state[4] * state[4] +
                                               state[5] * state[5]) < upright_limit;
        action[0] = -state[0];
        action[1] = -state[1];
        action[2] = upright ? -state[2] : 0.0;
        for (std::size_t c = 3; c < 6; ++c) action[c] = near ? -state[c] : 0.0;
        for (std::size_t c = 0; c < 6; ++c) {
            action[c] = std::min(std::max(action[c], -limits[c]), limits[c]);
        }
    }

    std::size_t next_stage(const double*, std::size_t stage) const { return stage; }

    template <class World>
    double reward(const World&, const double*, const double* action) const {
        return minus_norm<6>(action);
    }

    bool is_goal(const double* state) const {
        return std::abs(state[0]) < goal_tolerance && std::abs(state[1]) < goal_tolerance &&
               std::abs(state[2]) < goal_tolerance;
    }
};

// A point in the plane, (x, y), goes to one target after the other, in proportion to the distance
// and with steps of a limited length.
struct ViaPointPolicy {
    static constexpr std::size_t dimension = 2;

    struct Stage {
        std::array<double, 2> center, gains;
        double squared_radius;
    };

    std::vector<Stage> stages;
    double step_size;

    explicit ViaPointPolicy(double limit) : step_size(limit) {}

    std::size_t num_stages() const { return stages.size(); }

    void executed(const double* state, std::size_t stage, double* action) const {
        const Stage& own = stages[stage];
        for (std::size_t c = 0; c < 2; ++c) {
            action[c] = own.gains[c] * (own.center[c] - state[c]);
        }
        const double norm = std::sqrt(action[0] * action[0] + action[1] * action[1]);
        const double shortened = step_size / std::max(norm, step_size);
        for (std::size_t c = 0; c < 2; ++c) action[c] *= shortened;
    }

    std::size_t next_stage(const double* state, std::size_t stage) const {
        return std::min(stage + (reached(state, stages[stage]) ? 1 : 0), stages.size() - 1);
    }

    template <class World>
    double reward(const World& world, const double* state, const double* action) const {
        const std::array<double, 2> ahead = {state[0] + action[0], state[1] + action[1]};
        return world.collides(ahead.data()) ? -1.0 : 0.0;
    }

    bool is_goal(const double* state) const { return reached(state, stages.back()); }

  private:
    static bool reached(const double* state, const Stage& target) {
        const double x = state[0] - target.center[0], y = state[1] - target.center[1];
        return x * x + y * y < target.squared_radius;
    }
};

}  // namespace holdfast
