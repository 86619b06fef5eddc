// One compilation of the inner loops: CMake sets HOLDFAST_ISA (the namespace) and the -m flags.
//
// No standard-library template is instantiated here: the linker would keep one copy of it for all
// instruction sets, and it might be this one.

#define HOLDFAST_LAMBDA __attribute__((always_inline))

#include "block_entropy.hpp"
#include "collisions.hpp"
#include "compact_entropy.hpp"
#include "elementwise.hpp"
#include "few_points.hpp"
#include "group_entropy.hpp"
#include "policy_steps.hpp"
#include "posterior.hpp"
#include "prior_block.hpp"

namespace holdfast::inline HOLDFAST_ISA {

extern const VectorKernels table;
const VectorKernels table = {
    HOLDFAST_ISA_NAME,
    exp_array,
    log_array,
    sin_array,
    cos_array,
    normals_array,
    normal_blocks,
    substreams,
    states_collide<DiscShape, 2>,
    states_collide<RectangleShape, 3>,
    states_collide<BoxShape, 6>,
    steps_of<PegPolicy2D, RectangleShape>,
    steps_of<PegPolicy3D, BoxShape>,
    steps_of<ViaPointPolicy, DiscShape>,
    sum_array,
    weighted_sum,
    weighted_sums,
    posterior,
    normalize,
    compact_nearest,
    few_nearest,
    compact_mixture,
    group_nearest,
    block_nearest,
    group_mixture,
    prior_block,
};

}  // namespace holdfast::inline HOLDFAST_ISA
