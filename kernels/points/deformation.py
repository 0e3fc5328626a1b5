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
        scales_out[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    axes, values, _right = wp.svd3(root / largest)
    # The decomposition sorts; each axis goes back to the place and the direction that it turned away from least, so
    # that a map close to the identity leaves quaternion and scales where they were.
    old = rotation_from_quaternion(quats[i])
    near = wp.transpose(old) * axes  # cosines of old (row) and new (column) axes
    taken = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.mat33()
    kept = wp.vec3()
    for column in range(3):
        best = int(-1)
        closest = float(-1.0)
        for other in range(3):
            cosine = wp.abs(near[column, other])
            if taken[other] == 0.0 and cosine > closest:
                closest = cosine
                best = other
        taken[best] = 1.0
        kept[column] = largest * wp.abs(values[best])
        direction = wp.where(near[column, best] < 0.0, -1.0, 1.0)
        for row in range(3):
            turned[row, column] = direction * axes[row, best]
    if wp.determinant(turned) < 0.0:  # a mirrored axis is the same ellipsoid's
        for row in range(3):
            turned[row, 2] = -turned[row, 2]
    turn = wp.quat_from_matrix(turned)
    quat = wp.vec4(turn[3], turn[0], turn[1], turn[2])
    quats_out[i] = wp.where(wp.dot(quat, quats[i]) < 0.0, -quat, quat)
    scales_out[i] = kept
