// The policies of the built-in problems: the numbers that the kernel's ways and rollouts take.
//
// The problems themselves are NumPy (holdfast/problems/); what a policy says is written there. In
// lanes/policy_steps.hpp it is once more, for eight states side by side, because a particle's way
// is many small steps: NumPy takes 20 microseconds for each, whatever the number of particles. Both
// give the same numbers, to the bit.
#pragma once

#include <cstddef>
#include <utility>
#include <vector>

namespace holdfast {

// A peg in the plane, (x, y, theta), goes through one hole after the other: to the hole's axis;
// near it also upright; once upright also down.
//
// Numbers of a stage: the hole's axis; the tilt below which the peg is lowered; the height of its
// top below which the hole is passed.
struct PegPolicy2D {
    static constexpr std::size_t dimension = 3, space_dimension = 2, stage_size = 3;

    // Around the last hole's axis, and between two heights.
    struct Goal {
        double axis, tolerance, above, below;
    };

    double half_width, height;
    double limits[3];
    Goal goal;
    const double* stages = nullptr;  // [num_stages][stage_size], as in the other policies
    std::size_t num_stages = 1;
};

// A peg in space, (x, y, z, yaw, pitch, roll): to the axis of the hole at the origin; near it also
// upright; once upright also down. It has one stage.
struct PegPolicy3D {
    static constexpr std::size_t dimension = 6, space_dimension = 3, stage_size = 0;

    double half_width, upright_limit;
    double limits[6];
    double goal_tolerance;
    const double* stages = nullptr;
    std::size_t num_stages = 1;
};

// A point in the plane, (x, y), goes to one target after the other, in proportion to the distance
// and with steps of a limited length; the last target is the goal.
//
// Numbers of a stage: the target's centre, the gains along x and y, the square of its radius.
struct ViaPointPolicy {
    static constexpr std::size_t dimension = 2, space_dimension = 2, stage_size = 5;

    double step_size;
    const double* stages = nullptr;
    std::size_t num_stages = 1;
};

// A policy with the numbers of its stages.
template <class Policy>
class OwnedPolicy : public Policy {
  public:
    OwnedPolicy(const Policy& policy, std::vector<double> numbers)
        : Policy(policy), numbers_(std::move(numbers)) {
        this->stages = numbers_.data();
        if constexpr (Policy::stage_size > 0) {
            this->num_stages = numbers_.size() / Policy::stage_size;
        }
    }
    OwnedPolicy(const OwnedPolicy&) = delete;
    OwnedPolicy& operator=(const OwnedPolicy&) = delete;

  private:
    std::vector<double> numbers_;
};

}  // namespace holdfast
