// Collision in space: a turned box among axis-aligned boxes.
//
// As in the plane, two boxes are apart if and only if some plane separates them, and it suffices to
// try 15 normals: the three face directions of either box and the nine cross products of their
// edges (Gottschalk, Lin and Manocha, "OBBTree", SIGGRAPH 1996). The box is turned by R = Rz(yaw)
// Ry(pitch) Rx(roll).
//
// Boxes that touch without overlapping are free. The cross product of two parallel edges is zero
// and separates nothing; below a length of 1e-8 it is left out, for the face directions then decide
// to within about 1e-8 times the size of the boxes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "vector_kernels.hpp"

namespace holdfast {

struct AxisAlignedBox {
    std::array<double, 3> low, high;
};

// A box among boxes; its state is (x, y, z, yaw, pitch, roll) of its centre.
class BoxWorld {
  public:
    static constexpr std::size_t dimension = 6, space_dimension = 3;
    using Shape = BoxShape;

    BoxWorld(const std::array<double, 3>& size, std::vector<AxisAlignedBox> obstacles);

    std::size_t num_obstacles() const { return obstacles_.size(); }

    bool collides(const double* state) const;

    // The same for each of `count` states.
    void collide_each(const double* states, std::size_t count, std::uint8_t* out) const;

    RoundShape round() const;
    Shape shape() const;

  private:
    std::array<double, 3> half_size_;
    double bounding_radius_;
    std::vector<AxisAlignedBox> obstacles_;
};

}  // namespace holdfast
