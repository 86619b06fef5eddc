#include "geometry_3d.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "deterministic_math.hpp"

namespace holdfast {
namespace {

using Vector = std::array<double, 3>;

// The box's axes in world coordinates: axes[k] is column k of the rotation matrix.
struct Rotation {
    std::array<Vector, 3> axes;
};

Rotation rotation(double yaw, double pitch, double roll) {
    double sy, cy, sp, cp, sr, cr;
    sincos(yaw, sy, cy);
    sincos(pitch, sp, cp);
    sincos(roll, sr, cr);
    return {{{
        {cy * cp, sy * cp, -sp},
        {cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr},
        {cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr},
    }}};
}

double dot(const Vector& a, const Vector& b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// Whether the box about the origin, which reaches `reach` along the direction, and the obstacle,
// whose limits are relative to the box's centre, do not overlap along it.
bool separates(const Vector& direction, double reach, const AxisAlignedBox& obstacle) {
    double low = 0.0, high = 0.0;
    for (std::size_t i = 0; i < 3; ++i) {
        const double a = direction[i] * obstacle.low[i];
        const double b = direction[i] * obstacle.high[i];
        low += std::min(a, b);
        high += std::max(a, b);
    }
    return low >= reach || high <= -reach;
}

bool edges_separate(const Rotation& turn, const Vector& half_size, const AxisAlignedBox& obstacle) {
    for (std::size_t k = 0; k < 3; ++k) {
        const Vector& edge = turn.axes[k];
        const std::size_t next = (k + 1) % 3, last = (k + 2) % 3;
        const std::array<Vector, 3> directions = {{
            {0.0, -edge[2], edge[1]},  // e_x cross edge
            {edge[2], 0.0, -edge[0]},  // e_y cross edge
            {-edge[1], edge[0], 0.0},  // e_z cross edge
        }};
        for (const Vector& direction : directions) {
            if (dot(direction, direction) < shortest_axis_squared) continue;
            // The direction is normal to the edge, so that edge adds nothing to the reach.
            const double reach = half_size[next] * std::abs(dot(direction, turn.axes[next])) +
                                 half_size[last] * std::abs(dot(direction, turn.axes[last]));
            if (separates(direction, reach, obstacle)) return true;
        }
    }
    return false;
}

}  // namespace

BoxWorld::BoxWorld(const std::array<double, 3>& size, std::vector<AxisAlignedBox> obstacles)
    : half_size_{0.5 * size[0], 0.5 * size[1], 0.5 * size[2]},
      bounding_radius_(std::sqrt(dot(half_size_, half_size_))),
      obstacles_(std::move(obstacles)) {}

bool BoxWorld::collides(const double* state) const {
    bool turned = false;  // the rotation is computed for the first obstacle that is near
    Rotation turn{};
    Vector reach{};

    for (const AxisAlignedBox& box : obstacles_) {
        AxisAlignedBox obstacle;  // seen from the box's centre
        bool far = false;
        for (std::size_t i = 0; i < 3; ++i) {
            obstacle.low[i] = box.low[i] - state[i];
            obstacle.high[i] = box.high[i] - state[i];
            far =
                far || obstacle.low[i] >= bounding_radius_ || obstacle.high[i] <= -bounding_radius_;
        }
        if (far) continue;
        if (!turned) {
            turn = rotation(state[3], state[4], state[5]);
            for (std::size_t i = 0; i < 3; ++i) {
                reach[i] = half_size_[0] * std::abs(turn.axes[0][i]) +
                           half_size_[1] * std::abs(turn.axes[1][i]) +
                           half_size_[2] * std::abs(turn.axes[2][i]);
            }
            turned = true;
        }
        bool apart = false;
        for (std::size_t i = 0; i < 3; ++i) {
            apart = apart || obstacle.low[i] >= reach[i] || obstacle.high[i] <= -reach[i];
        }
        for (std::size_t k = 0; k < 3 && !apart; ++k) {
            apart = separates(turn.axes[k], half_size_[k], obstacle);
        }
        if (!apart && !edges_separate(turn, half_size_, obstacle)) return true;
    }
    return false;
}

void BoxWorld::collide_each(const double* states, std::size_t count, std::uint8_t* out) const {
    vector_kernels().boxes_collide(shape(), states, count, out);
}

RoundShape BoxWorld::round() const {
    return {bounding_radius_, obstacles_.data()->low.data(), obstacles_.size()};
}

BoxShape BoxWorld::shape() const {
    return {{half_size_[0], half_size_[1], half_size_[2]},
            bounding_radius_,
            obstacles_.data()->low.data(),
            obstacles_.size()};
}

}  // namespace holdfast
