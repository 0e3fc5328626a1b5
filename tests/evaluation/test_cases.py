"""Which scene a case takes, and which views it lifts."""

from dataclasses import replace
from pathlib import Path

import pytest

from sgwarp.datasets.base import SceneData
from sgwarp.evaluation.cases import _gaussians
from sgwarp.evaluation.profiles.parts import split_parts
from sgwarp.evaluation.settings import Settings
from sgwarp.io.scenes import save_gaussians
from sgwarp.runs.log import RunLog
from sgwarp.scene import View


def test_named_scenes_go_before_those_that_lie_with_the_data(scenes, tmp_path):
    for count, name in ((3, "data"), (5, "attic")):
        cloud = scenes.cloud(count, seed=0, scale=(0.1, 0.4), opacity=(0.3, 1.0), degree=0)
        save_gaussians(cloud, tmp_path / f"{name}.ply")
    scene = SceneData("attic", tmp_path, 1, gaussians=tmp_path / "data.ply")
    named = Settings(gaussians=str(tmp_path / "{scene}.ply"))
    assert len(_gaussians(scene, Settings(), [], RunLog())) == 3
    assert len(_gaussians(scene, named, [], RunLog())) == 5
    assert len(_gaussians(replace(scene, gaussians=None), named, [], RunLog())) == 5


@pytest.mark.parametrize(
    ("kind", "every", "lifted"),
    [("strict", 1, [1, 2, 3, 5, 6, 7, 9]), ("strict", 3, [1, 5, 9]), ("released", 3, [0, 3, 6, 9])],
)
def test_parts_without_truth_are_lifted_from_every_so_many(scenes, kind, every, lifted):
    camera = scenes.pinhole(8, 6, position=(0.0, 0.0, -1.0), target=(0.0, 0.0, 4.0))
    views = [View(str(number), camera) for number in range(10)]
    settings = Settings(views=kind, every=every, hold_out=4)
    one, other = split_parts(SceneData("attic", Path("attic"), 10), views, settings)
    assert [int(view.stem) for view in one] == lifted
    assert [int(view.stem) for view in other] == [0, 4, 8]
