#include "geometry_2d.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "deterministic_math.hpp"

namespace holdfast {

namespace {

constexpr double pi = 3.14159265358979323846;

// More than `rough_gap` errs by, in bounding radii.
constexpr double rough_error = 4e-3;

// Two parabolas through the extremes of the sine, for |x| <= pi; its error is below 1.2e-3.
double rough_sine(double x) {
    const double parabola = x * (4.0 / pi - 4.0 / (pi * pi) * std::abs(x));
    return parabola * (0.775 + 0.225 * std::abs(parabola));
}

// A rectangle turned by an angle known to three digits.
struct RoughTurn {
    double sine, cosine, half_width, half_height, reach_x, reach_y;
};

RoughTurn rough_turn(double angle, double half_width, double half_height) {
    const double sine = rough_sine(angle), cosine = rough_sine(0.5 * pi - std::abs(angle));
    return {sine,
            cosine,
            half_width,
            half_height,
            std::abs(cosine) * half_width + std::abs(sine) * half_height,
            std::abs(sine) * half_width + std::abs(cosine) * half_height};
}

// The greatest gap along the four edge directions between the rectangle and an obstacle seen from
// its centre: negative where they overlap along each. Only the part of the obstacle counts that is
// near, or the error of the angle would grow with its size.
double rough_gap(const RoughTurn& turn, double left, double right, double bottom, double top) {
    const double near = turn.half_width + turn.half_height;
    left = std::max(left, -near);
    right = std::min(right, near);
    bottom = std::max(bottom, -near);
    top = std::min(top, near);
    const double beside = std::max(left, -right) - turn.reach_x;
    const double above = std::max(bottom, -top) - turn.reach_y;
    // Middle and half size along the rectangle's own directions.
    const double x = 0.5 * (left + right), y = 0.5 * (bottom + top);
    const double wide = 0.5 * (right - left), high = 0.5 * (top - bottom);
    const double s = std::abs(turn.sine), c = std::abs(turn.cosine);
    const double along_width = std::abs(x * turn.cosine + y * turn.sine) - (wide * c + high * s);
    const double along_height = std::abs(y * turn.cosine - x * turn.sine) - (wide * s + high * c);
    return std::max(std::max(beside, above),
                    std::max(along_width - turn.half_width, along_height - turn.half_height));
}

}  // namespace

DiscWorld::DiscWorld(double radius, std::vector<AxisAlignedRectangle> obstacles)
    : radius_(radius), radius_squared_(radius * radius), obstacles_(std::move(obstacles)) {}

bool DiscWorld::collides(const double* state) const {
    const double x = state[0];
    const double y = state[1];
    for (const AxisAlignedRectangle& obstacle : obstacles_) {
        const double dx = x - std::min(std::max(x, obstacle.x_min), obstacle.x_max);
        const double dy = y - std::min(std::max(y, obstacle.y_min), obstacle.y_max);
        if (dx * dx + dy * dy < radius_squared_) return true;
    }
    return false;
}

void DiscWorld::collide_each(const double* states, std::size_t count, std::uint8_t* out) const {
    vector_kernels().discs_collide(shape(), states, count, out);
}

RoundShape DiscWorld::round() const {
    return {radius_, &obstacles_.data()->x_min, obstacles_.size()};
}

DiscShape DiscWorld::shape() const {
    return {radius_squared_, &obstacles_.data()->x_min, obstacles_.size()};
}

RectangleWorld::RectangleWorld(double width, double height,
                               std::vector<AxisAlignedRectangle> obstacles)
    : half_width_(0.5 * width),
      half_height_(0.5 * height),
      bounding_radius_(std::sqrt(half_width_ * half_width_ + half_height_ * half_height_)),
      rough_(true),
      obstacles_(std::move(obstacles)) {
    for (const AxisAlignedRectangle& each : obstacles_) {
        for (const double limit : {each.x_min, each.y_min, each.x_max, each.y_max}) {
            rough_ = rough_ && std::abs(limit) < 1e9 * bounding_radius_;
        }
    }
}

bool RectangleWorld::collides(const double* state) const {
    const double x = state[0];
    const double y = state[1];
    bool turned = false;  // sine and cosine are computed for the first obstacle that needs them
    double sine = 0.0, cosine = 1.0, reach_x = 0.0, reach_y = 0.0;
    const bool roughly = rough_ && std::abs(state[2]) <= pi;
    RoughTurn rough{};

    for (const AxisAlignedRectangle& obstacle : obstacles_) {
        // The obstacle seen from the rectangle's centre. Differences of limits rather than centre
        // and half size keep large obstacles (the ground) as exact as small ones.
        const double left = obstacle.x_min - x;
        const double right = obstacle.x_max - x;
        const double bottom = obstacle.y_min - y;
        const double top = obstacle.y_max - y;
        if (left >= bounding_radius_ || right <= -bounding_radius_ || bottom >= bounding_radius_ ||
            top <= -bounding_radius_) {
            continue;
        }
        if (roughly) {
            if (rough.reach_x == 0.0) rough = rough_turn(state[2], half_width_, half_height_);
            const double gap = rough_gap(rough, left, right, bottom, top);
            if (gap > rough_error * bounding_radius_) continue;
            if (gap < -rough_error * bounding_radius_) return true;
        }
        if (!turned) {
            sincos(state[2], sine, cosine);
            reach_x = std::abs(cosine) * half_width_ + std::abs(sine) * half_height_;
            reach_y = std::abs(sine) * half_width_ + std::abs(cosine) * half_height_;
            turned = true;
        }
        // The obstacle's edge directions.
        if (left >= reach_x || right <= -reach_x || bottom >= reach_y || top <= -reach_y) continue;
        // The rectangle's own: along its width (cos, sin), along its height (-sin, cos).
        const double left_cosine = left * cosine, right_cosine = right * cosine;
        const double bottom_sine = bottom * sine, top_sine = top * sine;
        const double width_low =
            std::min(left_cosine, right_cosine) + std::min(bottom_sine, top_sine);
        const double width_high =
            std::max(left_cosine, right_cosine) + std::max(bottom_sine, top_sine);
        if (width_low >= half_width_ || width_high <= -half_width_) continue;
        const double left_sine = left * -sine, right_sine = right * -sine;
        const double bottom_cosine = bottom * cosine, top_cosine = top * cosine;
        const double height_low =
            std::min(left_sine, right_sine) + std::min(bottom_cosine, top_cosine);
        const double height_high =
            std::max(left_sine, right_sine) + std::max(bottom_cosine, top_cosine);
        if (height_low >= half_height_ || height_high <= -half_height_) continue;
        return true;
    }
    return false;
}

void RectangleWorld::collide_each(const double* states, std::size_t count,
                                  std::uint8_t* out) const {
    vector_kernels().rectangles_collide(shape(), states, count, out);
}

RoundShape RectangleWorld::round() const {
    return {bounding_radius_, &obstacles_.data()->x_min, obstacles_.size()};
}

RectangleShape RectangleWorld::shape() const {
    return {half_width_, half_height_, bounding_radius_, &obstacles_.data()->x_min,
            obstacles_.size()};
}

}  // namespace holdfast
