"""Shapes of Gaussians under a map of space that is no rotation: the covariance goes with the map's Jacobian."""

import warp as wp

from sgwarp.kernels.gaussian import EXACT_OPTIONS, rotation_from_quaternion

wp.set_module_options(EXACT_OPTIONS)


@wp.kernel
def deform_shapes(
    # In:
    base: int,  # first Gaussian of this launch
    jacobians: wp.array[wp.mat33],  # [N] J of the map at each centre
    quats: wp.array[wp.vec4],  # [N] rotations (w, x, y, z)
    scales: wp.array[wp.vec3],  # [N] standard deviations [m]
    # Out:
    quats_out: wp.array[wp.vec4],  # [N]
    scales_out: wp.array[wp.vec3],  # [N] [m]
):
    """Sigma -> J Sigma J^T: the singular values of J R S are the new scales, its left singular vectors the new axes."""
    i = base + wp.tid()
    root = jacobians[i] * rotation_from_quaternion(quats[i])
    scale = scales[i]
    for column in range(3):
        for row in range(3):
            root[row, column] = root[row, column] * scale[column]
    # Scaled to order one: the decomposition works with absolute thresholds.
    size = wp.max(wp.max(wp.abs(root[0]), wp.abs(root[1])), wp.abs(root[2]))
    largest = wp.max(size)
    if largest == 0.0:
        quats_out[i] = quats[i]
        scales_out[i] = scale
        return
    axes, values, _right = wp.svd3(root / largest)
    if wp.determinant(axes) < 0.0:
        axes = -axes
    turn = wp.quat_from_matrix(axes)
    quats_out[i] = wp.vec4(turn[3], turn[0], turn[1], turn[2])
    scales_out[i] = largest * wp.abs(values)
