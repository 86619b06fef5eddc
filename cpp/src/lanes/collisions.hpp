// Collision tests of many states side by side (one compilation per instruction set).
//
// Operation by operation those of `collides` in geometry_2d.cpp and geometry_3d.cpp, but for what
// adds zero, so the answers are the same.

#pragma once

#include "../vector_kernels.hpp"

namespace holdfast::inline HOLDFAST_ISA {

/// As std::min and std::max of `a` and `b`.
HOLDFAST_INLINE void least_and_greatest(Lanes a, Lanes b, Lanes& least, Lanes& greatest) {
    least = b;
    greatest = a;
    order(least, greatest);
}

HOLDFAST_INLINE Lanes size_of(const Lanes& x) {
    return select(x < 0.0, -x, x);
}

/// Coordinate `c` of eight states; behind the last one this is repeated.
HOLDFAST_INLINE Lanes coordinate(const double* states, std::size_t count, std::size_t begin,
                                 std::size_t dimension, std::size_t c) {
    Lanes result{};
    for (std::size_t lane = 0; lane < lane_count; ++lane) {
        const std::size_t i = begin + lane < count ? begin + lane : count - 1;
        result[lane] = states[i * dimension + c];
    }
    return result;
}

HOLDFAST_INLINE void put(std::uint8_t* out, std::size_t count, unsigned bits) {
    for (std::size_t lane = 0; lane < lane_count && lane < count; ++lane) {
        out[lane] = static_cast<std::uint8_t>(bits >> lane & 1u);
    }
}

/// Which of eight discs are in collision.
HOLDFAST_INLINE IntLanes discs_hit(const DiscShape& shape, const Lanes& x, const Lanes& y) {
    IntLanes hits = splat_int(0);
    for (std::size_t o = 0; o < shape.num_obstacles; ++o) {
        const double* limits = shape.obstacles + 4 * o;
        Lanes nearest_x, nearest_y, unused;
        least_and_greatest(x, splat(limits[0]), unused, nearest_x);
        least_and_greatest(nearest_x, splat(limits[2]), nearest_x, unused);
        least_and_greatest(y, splat(limits[1]), unused, nearest_y);
        least_and_greatest(nearest_y, splat(limits[3]), nearest_y, unused);
        const Lanes dx = x - nearest_x, dy = y - nearest_y;
        hits |= dx * dx + dy * dy < shape.radius_squared;
    }
    return hits;
}

/// Which of eight rectangles are in collision, as bits, of those that are asked for.
HOLDFAST_INLINE unsigned rectangles_hit(const RectangleShape& shape, const Lanes& x, const Lanes& y,
                                        const Lanes& angle, unsigned asked) {
    const double radius = shape.bounding_radius;
    const auto turn = sine_cosine_of(angle);
    const Lanes& sine = turn.sine;
    const Lanes& cosine = turn.cosine;
    const Lanes s = size_of(sine), c = size_of(cosine);
    const Lanes reach_x = c * shape.half_width + s * shape.half_height;
    const Lanes reach_y = s * shape.half_width + c * shape.half_height;
    unsigned hits = ~asked & 0xffu;
    for (std::size_t o = 0; o < shape.num_obstacles && hits != 0xffu; ++o) {
        const double* limits = shape.obstacles + 4 * o;
        const Lanes left = limits[0] - x, bottom = limits[1] - y;
        const Lanes right = limits[2] - x, top = limits[3] - y;
        IntLanes apart = (left >= radius) | (right <= -radius) | (bottom >= radius) |
                         (top <= -radius) | (left >= reach_x) | (right <= -reach_x) |
                         (bottom >= reach_y) | (top <= -reach_y);
        if ((hits | bits_of(apart)) == 0xffu) continue;
        Lanes low, high, lower, higher;
        least_and_greatest(left * cosine, right * cosine, low, high);
        least_and_greatest(bottom * sine, top * sine, lower, higher);
        apart |= (low + lower >= shape.half_width) | (high + higher <= -shape.half_width);
        least_and_greatest(left * -sine, right * -sine, low, high);
        least_and_greatest(bottom * cosine, top * cosine, lower, higher);
        apart |= (low + lower >= shape.half_height) | (high + higher <= -shape.half_height);
        hits |= ~bits_of(apart) & 0xffu;
    }
    return hits & asked;
}

/// Whether an obstacle's limits, seen from the centres of eight boxes that reach `reach` along a
/// direction, are beyond them.
HOLDFAST_INLINE IntLanes separated(const Lanes (&direction)[3], const Lanes& reach,
                                   const Lanes (&low)[3], const Lanes (&high)[3]) {
    Lanes least = splat(0.0), greatest = splat(0.0);
    for (std::size_t i = 0; i < 3; ++i) {
        Lanes a, b;
        least_and_greatest(direction[i] * low[i], direction[i] * high[i], a, b);
        least += a;
        greatest += b;
    }
    return (least >= reach) | (greatest <= -reach);
}

/// The normals to an edge of each of eight boxes and to one of an obstacle, which are the same for
/// all obstacles. A normal to the obstacle's edges along axis c has no coordinate c.
struct EdgeNormals {
    Lanes reach[3][3];
    IntLanes usable[3][3];

    HOLDFAST_INLINE void find(const BoxShape& shape, const Lanes (&axes)[3][3]) {
        for (std::size_t k = 0; k < 3; ++k) {
            const Lanes(&edge)[3] = axes[k];
            const std::size_t next = (k + 1) % 3, last = (k + 2) % 3;
            for (std::size_t c = 0; c < 3; ++c) {
                const std::size_t i = (c + 1) % 3, j = (c + 2) % 3;
                const auto along = [&](const Lanes(&axis)[3]) HOLDFAST_LAMBDA {
                    return size_of(edge[i] * axis[j] - edge[j] * axis[i]);
                };
                reach[k][c] = shape.half_size[next] * along(axes[next]) +
                              shape.half_size[last] * along(axes[last]);
                usable[k][c] = edge[i] * edge[i] + edge[j] * edge[j] >= shortest_axis_squared;
            }
        }
    }
};

/// Whether such a normal separates each of eight boxes, but for those in the bits `settled`, which
/// are of no interest.
HOLDFAST_INLINE IntLanes edges_separated(const EdgeNormals& normals, const Lanes (&axes)[3][3],
                                         const Lanes (&low)[3], const Lanes (&high)[3],
                                         unsigned settled) {
    IntLanes apart = splat_int(0);
    for (std::size_t k = 0; k < 3 && (settled | bits_of(apart)) != 0xffu; ++k) {
        for (std::size_t c = 0; c < 3; ++c) {
            const std::size_t i = (c + 1) % 3, j = (c + 2) % 3;
            Lanes least, greatest, other_least, other_greatest;
            least_and_greatest(-axes[k][j] * low[i], -axes[k][j] * high[i], least, greatest);
            least_and_greatest(axes[k][i] * low[j], axes[k][i] * high[j], other_least,
                               other_greatest);
            apart |= normals.usable[k][c] & ((least + other_least >= normals.reach[k][c]) |
                                             (greatest + other_greatest <= -normals.reach[k][c]));
        }
    }
    return apart;
}

/// Which of eight boxes are in collision, as bits, of those that are asked for.
static unsigned boxes_hit(const BoxShape& shape, const Lanes (&state)[6], unsigned asked) {
    const auto yaw = sine_cosine_of(state[3]);
    const auto pitch = sine_cosine_of(state[4]);
    const auto roll = sine_cosine_of(state[5]);
    const Lanes &sy = yaw.sine, &cy = yaw.cosine, &sp = pitch.sine, &cp = pitch.cosine;
    const Lanes &sr = roll.sine, &cr = roll.cosine;
    const Lanes axes[3][3] = {
        {cy * cp, sy * cp, -sp},
        {cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr},
        {cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr},
    };
    Lanes reach[3];
    for (std::size_t i = 0; i < 3; ++i) {
        reach[i] = shape.half_size[0] * size_of(axes[0][i]) +
                   shape.half_size[1] * size_of(axes[1][i]) +
                   shape.half_size[2] * size_of(axes[2][i]);
    }
    EdgeNormals normals;
    bool known = false;
    unsigned hits = ~asked & 0xffu;
    for (std::size_t o = 0; o < shape.num_obstacles && hits != 0xffu; ++o) {
        const double* limits = shape.obstacles + 6 * o;
        Lanes low[3], high[3];
        IntLanes apart = splat_int(0);
        for (std::size_t i = 0; i < 3; ++i) {
            low[i] = limits[i] - state[i];
            high[i] = limits[3 + i] - state[i];
            apart |= (low[i] >= shape.bounding_radius) | (high[i] <= -shape.bounding_radius) |
                     (low[i] >= reach[i]) | (high[i] <= -reach[i]);
        }
        if ((hits | bits_of(apart)) == 0xffu) continue;
        for (std::size_t k = 0; k < 3; ++k) {
            apart |= separated(axes[k], splat(shape.half_size[k]), low, high);
        }
        const unsigned settled = hits | bits_of(apart);
        if (settled == 0xffu) continue;
        if (!known) normals.find(shape, axes);
        known = true;
        apart |= edges_separated(normals, axes, low, high, settled);
        hits |= ~bits_of(apart) & 0xffu;
    }
    return hits & asked;
}

/// Which of eight states are in collision, as bits, of those that are asked for.
HOLDFAST_INLINE unsigned bits_hit(const DiscShape& shape, const Lanes (&state)[2], unsigned asked) {
    return bits_of(discs_hit(shape, state[0], state[1])) & asked;
}
HOLDFAST_INLINE unsigned bits_hit(const RectangleShape& shape, const Lanes (&state)[3],
                                  unsigned asked) {
    return rectangles_hit(shape, state[0], state[1], state[2], asked);
}
HOLDFAST_INLINE unsigned bits_hit(const BoxShape& shape, const Lanes (&state)[6], unsigned asked) {
    return boxes_hit(shape, state, asked);
}

/// Which of the states, [count][d], are in collision: out[count].
template <class Shape, std::size_t d>
static void states_collide(const Shape& shape, const double* states, std::size_t count,
                           std::uint8_t* out) {
    for (std::size_t begin = 0; begin < count; begin += lane_count) {
        Lanes state[d];
        for (std::size_t c = 0; c < d; ++c) state[c] = coordinate(states, count, begin, d, c);
        const std::size_t left = count - begin;
        const unsigned asked = left < lane_count ? (1u << left) - 1u : 0xffu;
        put(out + begin, left, bits_hit(shape, state, asked));
    }
}

/// Less than the gaps between eight balls and the nearest box by more than rounding can make.
template <std::size_t space_dimension, std::size_t d>
HOLDFAST_INLINE Lanes clearance(const RoundShape& shape, const Lanes (&state)[d]) {
    Lanes gap = splat(__builtin_inf()), unused;
    for (std::size_t o = 0; o < shape.num_obstacles; ++o) {
        const double* low = shape.obstacles + 2 * space_dimension * o;
        const double* high = low + space_dimension;
        Lanes widest = splat(-__builtin_inf());
        for (std::size_t c = 0; c < space_dimension; ++c) {
            least_and_greatest(low[c] - state[c], widest, unused, widest);
            least_and_greatest(state[c] - high[c], widest, unused, widest);
        }
        least_and_greatest(gap, widest, gap, unused);
    }
    Lanes size = splat(1.0 + shape.radius);
    for (std::size_t c = 0; c < space_dimension; ++c) size += size_of(state[c]);
    return gap - shape.radius - 1e-9 * size;
}

}  // namespace holdfast::inline HOLDFAST_ISA
