// Collision in the plane: a disc or a turned rectangle among axis-aligned rectangles.
//
// Two convex shapes are apart if and only if some line separates them. For a rectangle turned by
// theta and an axis-aligned one, the lines to try are normal to the four edge directions
// (Gottschalk, Lin and Manocha, "OBBTree", SIGGRAPH 1996, in two dimensions): project both shapes
// on each direction and see whether the intervals overlap. A disc meets a rectangle where the
// rectangle's point closest to the disc's centre is nearer than the radius.
//
// Where the shapes are further apart, or deeper in each other, than a sine of three digits can be
// wrong by, that decides: alike, as both ways are right there.
//
// Shapes that touch without overlapping are free: every comparison is strict, in exact arithmetic.
// Rounding moves the boundary by a few units in the last place of the coordinates.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "vector_kernels.hpp"

namespace holdfast {

struct AxisAlignedRectangle {
    double x_min, y_min, x_max, y_max;
};

// A disc among rectangles; its state is (x, y).
class DiscWorld {
  public:
    static constexpr std::size_t dimension = 2, space_dimension = 2;
    using Shape = DiscShape;

    DiscWorld(double radius, std::vector<AxisAlignedRectangle> obstacles);

    std::size_t num_obstacles() const { return obstacles_.size(); }

    bool collides(const double* state) const;

    // The same for each of `count` states.
    void collide_each(const double* states, std::size_t count, std::uint8_t* out) const;

    RoundShape round() const;
    Shape shape() const;

  private:
    double radius_, radius_squared_;
    std::vector<AxisAlignedRectangle> obstacles_;
};

// A rectangle among rectangles; its state is (x, y, theta) of its centre.
class RectangleWorld {
  public:
    static constexpr std::size_t dimension = 3, space_dimension = 2;
    using Shape = RectangleShape;

    RectangleWorld(double width, double height, std::vector<AxisAlignedRectangle> obstacles);

    std::size_t num_obstacles() const { return obstacles_.size(); }

    bool collides(const double* state) const;

    // The same for each of `count` states.
    void collide_each(const double* states, std::size_t count, std::uint8_t* out) const;

    RoundShape round() const;
    Shape shape() const;

  private:
    double half_width_, half_height_;
    double bounding_radius_;
    bool rough_;  // whether rounding is small enough to decide most tests by a rough angle
    std::vector<AxisAlignedRectangle> obstacles_;
};

}  // namespace holdfast
