"""gsplat's projection: Gaussians of many scenes seen by many cameras, packed or dense."""

from __future__ import annotations

from torch import Tensor

from sgwarp.compat.gsplat.checks import expect_shape
from sgwarp.compat.gsplat.meta import Images, SplatTable
from sgwarp.errors import InputError
from sgwarp.ops.planar.projection import (
    ProjectedSplats,
    ProjectionSettings,
    project_splats,
    rotation_matrices,
    unpack_symmetric,
)
from sgwarp.runs.isolation import isolated
from sgwarp.scene.checks import require_cameras


def project_images(
    images: Images,
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    settings: ProjectionSettings,
    sparse_grad: bool,
) -> list[ProjectedSplats]:
    """Project every scene into each of its cameras; `covars` are [..., N, 3, 3]."""
    batch, N, C = images.batch_dims, images.gaussians, images.cameras
    expect_shape("means", means, (*batch, N, 3))
    expect_shape("viewmats", viewmats, (*batch, C, 4, 4))
    expect_shape("Ks", Ks, (*batch, C, 3, 3))
    require_cameras(viewmats, Ks)
    if covars is None:
        expect_shape("quats", quats, (*batch, N, 4))
        expect_shape("scales", scales, (*batch, N, 3))
    if opacities is not None:
        expect_shape("opacities", opacities, (*batch, N))
    if sparse_grad and batch:
        raise InputError("sparse_grad: not supported with batch dimensions")

    def scene(tensor: Tensor | None) -> list[Tensor] | list[None]:
        return [None] * images.batches if tensor is None else images.scenes(tensor)

    parts = [scene(t) for t in (means, covars, quats, scales, opacities)]
    splats = []
    for i, (viewmat, K) in enumerate(zip(images.images(viewmats), images.images(Ks), strict=True)):
        mean, covar, quat, scale, opacity = (part[i // C] for part in parts)
        assert mean is not None
        shape = {"covars": covar} if covar is not None else {"quats": quat, "scales": scale}
        splats.append(
            project_splats(mean, viewmat, K, width, height, settings, opacities=opacity, sparse=sparse_grad, **shape)
        )
    return splats


@isolated
def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    packed: bool = False,
    sparse_grad: bool = False,
    calc_compensations: bool = False,
    camera_model: str = "pinhole",
    opacities: Tensor | None = None,
) -> tuple[Tensor | None, ...]:
    """Project Gaussians into the image plane, as `gsplat.fully_fused_projection` does.

    Gaussians that are not finite are left out (radii of zero). With a Gaussian left out, every output of its row is
    zero, and so are its gradients.

    Args:
        means: Centres [m], [..., N, 3].
        covars: Upper triangles (xx, xy, xz, yy, yz, zz) of the covariances [m^2], [..., N, 6]; or None, then:
        quats, scales: Rotations (w, x, y, z), [..., N, 4], and standard deviations [m], [..., N, 3].
        viewmats: World to camera, [..., C, 4, 4].
        Ks: Intrinsics [pixels], [..., C, 3, 3].
        width, height: Image size [pixels].
        eps2d: Added to both projected variances [pixels^2].
        near_plane, far_plane: Range of depth [m].
        radius_clip: Splats whose radii are at most this are left out [pixels].
        packed: Return only visible rows.
        sparse_grad: With `packed`: gradients of means, covars, quats and scales as sparse tensors.
        calc_compensations: Also return sqrt(area before / after the dilation).
        camera_model: "pinhole", "ortho" or "fisheye".
        opacities: For radii no larger than needed, [..., N].

    Returns:
        radii int32 [..., C, N, 2], means2d [..., C, N, 2], depths [..., C, N], conics [..., C, N, 3] and compensations
        [..., C, N] or None. With `packed`: batch_ids, camera_ids, gaussian_ids int64 [nnz] and then those, as
        [nnz, ...].

    Raises:
        InputError: Naming the argument that does not fit.
    """
    images = Images.of(means, viewmats)
    if covars is not None:
        expect_shape("covars", covars, (*images.batch_dims, images.gaussians, 6))
        covars = unpack_symmetric(covars)
    if sparse_grad and not packed:
        raise InputError("sparse_grad: only possible with packed=True")
    settings = ProjectionSettings(camera_model, near_plane, far_plane, eps2d, radius_clip, calc_compensations)
    splats = project_images(
        images, means, covars, quats, scales, opacities, viewmats, Ks, width, height, settings, sparse_grad
    )
    names = ("radii", "means2d", "depths", "conics", "compensations")
    columns = [[getattr(p, name) for p in splats] for name in names[: 5 if calc_compensations else 4]]
    table = SplatTable(images, splats, packed)
    ids = table.ids().values() if packed else ()
    return *ids, *(table.join(column) for column in columns), *([] if calc_compensations else [None])


@isolated
def quat_scale_to_covar_preci(
    quats: Tensor,
    scales: Tensor,
    compute_covar: bool = True,
    compute_preci: bool = True,
    triu: bool = False,
) -> tuple[Tensor | None, Tensor | None]:
    """Covariances R S S R^T and their inverses, as `gsplat.quat_scale_to_covar_preci` does.

    Args:
        quats: (w, x, y, z) of any length, [..., 4].
        scales: Standard deviations [m], [..., 3].
        compute_covar, compute_preci: Which of the two; None is returned for the other.
        triu: Return upper triangles (xx, xy, xz, yy, yz, zz), [..., 6], instead of matrices [..., 3, 3].
    """
    batch = tuple(quats.shape[:-1]) if isinstance(quats, Tensor) else ()
    expect_shape("quats", quats, (*batch, 4))
    expect_shape("scales", scales, (*batch, 3))
    R = rotation_matrices(quats)

    def squared(lengths: Tensor) -> Tensor:
        axes = R * lengths[..., None, :]
        matrices = axes @ axes.transpose(-1, -2)
        return matrices.flatten(-2)[..., [0, 1, 2, 4, 5, 8]] if triu else matrices

    return squared(scales) if compute_covar else None, squared(1.0 / scales) if compute_preci else None
