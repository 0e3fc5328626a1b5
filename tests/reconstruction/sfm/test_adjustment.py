"""The last adjustment of poses, against COLMAP's own made-up scenes, whose poses are known."""

import numpy as np
import pytest

from sgwarp.io.world import similarity_between
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.poses import _adjust

pycolmap = pytest.importorskip("pycolmap")
NOISE, WRONG, SHARE = 0.2, (3.5, 2.0), 0.1  # of features: deviation, error of wrong ones [pixels], how many are wrong


def centers(model) -> np.ndarray:
    images = sorted((model.image(number) for number in model.reg_image_ids()), key=lambda image: image.name)
    return np.stack([image.projection_center() for image in images])


def distance(model, truth: np.ndarray) -> float:
    """Root mean square distance of the cameras from where they are, up to a similarity, relative to their extent."""
    found = centers(model)
    matrix = similarity_between(found, truth)
    apart = found @ matrix[:3, :3].T + matrix[:3, 3] - truth
    return float(np.sqrt((apart**2).sum(axis=1).mean()) / truth.std(axis=0).max())


@pytest.fixture
def made_up(tmp_path):
    """A model whose features are noisy and one in ten wrong, adjusted to squared errors as the mapper does it."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 10, 400
    model = pycolmap.synthesize_dataset(options)
    truth, random = centers(model), np.random.default_rng(0)
    for image in model.images.values():
        for point in image.points2D:
            wrong = random.random() < SHARE
            point.xy = point.xy + random.normal(0, NOISE, 2) + wrong * np.array(WRONG)
    squares = pycolmap.BundleAdjustmentOptions()
    squares.print_summary = False
    pycolmap.bundle_adjustment(model, squares)
    return model, truth, tmp_path / "database.db"


def test_wrong_matches_do_not_pull_at_the_poses(made_up):
    model, truth, database = made_up
    before = distance(model, truth)
    _adjust(model, SfmSettings(threads=1), database)
    assert before > 3e-4  # what the wrong features do
    assert distance(model, truth) < before / 2


def test_the_principal_point_stays_and_errors_are_those_of_the_adjusted_points(made_up):
    model, _, database = made_up
    given = [camera.params[1:3].copy() for camera in model.cameras.values()]
    _adjust(model, SfmSettings(threads=1), database)
    for camera, point in zip(model.cameras.values(), given, strict=True):
        np.testing.assert_array_equal(camera.params[1:3], point)
    known = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() == pytest.approx(known)
