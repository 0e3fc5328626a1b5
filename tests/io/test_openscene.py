"""Fused features per Gaussian, as others store them."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.openscene import load_openscene


@pytest.fixture
def scene(make_scene):
    return make_scene("random_cloud").gaussians


def test_features_of_the_seen_points(scene, tmp_path):
    mask = torch.arange(len(scene)) % 3 == 0
    features = torch.randn(int(mask.sum()), 5).half()
    torch.save({"feat": features, "mask_full": mask}, tmp_path / "scene_0.pt")
    found = load_openscene(tmp_path / "scene_0.pt", scene, "clip-5")
    assert (found.space, found.features.dtype) == ("clip-5", torch.float16)
    assert torch.equal(found.seen, mask)
    assert torch.equal(found.features[mask], features)
    assert (found.features[~mask] == 0).all()
    found.require_scene(scene)
    assert load_openscene(tmp_path / "scene_0.pt", scene).space == "files:5"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"feat": torch.zeros(2, 3)}, r"is no \.pt with feat and mask_full"),
        ([1, 2], r"is no \.pt with feat and mask_full"),
        ({"feat": torch.zeros(2, 3), "mask_full": torch.zeros(4)}, "mask_full, bool"),
        ({"feat": torch.zeros(2, 3), "mask_full": torch.tensor([True] * 3)}, "expected one row of feat for each point"),
        ({"feat": torch.zeros(3, 3), "mask_full": torch.tensor([True] * 3)}, "made for 3 points, the scene has"),
    ],
)
def test_files_that_do_not_fit(scene, tmp_path, content, message):
    torch.save(content, tmp_path / "x.pt")
    with pytest.raises(InputError, match=message):
        load_openscene(tmp_path / "x.pt", scene)


def test_missing_and_damaged(scene, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_openscene(tmp_path / "none.pt", scene)
    (tmp_path / "x.pt").write_bytes(b"PK not a checkpoint")
    with pytest.raises(InputError, match="is damaged"):
        load_openscene(tmp_path / "x.pt", scene)
