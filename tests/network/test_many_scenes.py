"""Training on the results of a batch: which scenes count, and that they are read one by one."""

import gc
import json
import weakref
from pathlib import Path

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.network.augmentation import Augmentation
from sgwarp.network.training import data
from sgwarp.network.training.data import TrainingScene, scenes_in
from sgwarp.network.training.settings import DistillSettings
from sgwarp.network.training.trainer import distill
from sgwarp.scene import Semantics

SETTINGS = DistillSettings(arch="tiny", voxel=0.12, epochs=1, augment=Augmentation(up=1, elastic=()))


def labeled(stage, chosen: torch.Tensor, path: Path | None = None) -> Semantics:
    """Perfect label semantics of a part of the stage; of the file that it was written to, if there is one."""
    ones = torch.ones(len(chosen))
    gaussians = stage.gaussians.subset(chosen) if path is None else load_gaussians(path)
    shares = torch.eye(4)[stage.classes[chosen] - 1]
    return Semantics(shares, ones, 2.0 * ones, "labels", gaussians.fingerprint, ("1", "2", "3", "4"))


@pytest.fixture(scope="module")
def results(stage, tmp_path_factory):
    """What a batch leaves: a scene that it fitted, one that it only lifted, one that failed after it had been done."""
    folder = tmp_path_factory.mktemp("results")
    chosen = torch.arange(0, len(stage.gaussians), 4)
    save_gaussians(stage.gaussians.subset(chosen), folder.parent / "given.ply")
    for name, fitted in (("a", True), ("b", False), ("c", True)):
        (folder / name).mkdir()
        scene = folder / name / "scene.ply" if fitted else folder.parent / "given.ply"
        save_gaussians(stage.gaussians.subset(chosen), scene)
        save_semantics(labeled(stage, chosen, scene), folder / name / "scene.safetensors")
        words = ["{out}/scene.ply" if fitted else str(scene), "--views", str(folder.parent / "photographs" / name)]
        record = {"options": {"lift": words}}
        (folder / name / ("failed.json" if name == "c" else "done.json")).write_text(json.dumps(record))
    (folder / "run.json").write_text("{}")
    (folder / ".d.partial").mkdir()
    return folder


def test_the_lifted_scenes_of_a_batch_count(results, caplog):
    scenes = scenes_in([results], masks=lambda folder: [folder])
    assert [scene.name for scene in scenes] == [str(results / "a" / "scene.ply"), str(results.parent / "given.ply")]
    assert [scene.masks() for scene in scenes] == [[results.parent / "photographs" / name] for name in "ab"]
    assert "1 of 3 scenes are not done" in caplog.text
    gaussians, semantics = scenes[1].load()
    semantics.require_scene(gaussians)


def test_folders_of_single_results_count_too(results):
    assert len(scenes_in([results / "a", results / "b", results / "c"])) == 2
    with pytest.raises(InputError, match="no scene of this batch is done"):
        scenes_in([results / "c"])


def test_a_batch_that_lifted_nothing_is_refused(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "done.json").write_text(json.dumps({"options": {"fit": []}}))
    with pytest.raises(InputError, match="add lift to its --do"):
        scenes_in([tmp_path])


def test_masks_of_few_scenes_stay(stage, tmp_path):
    chosen, made = torch.arange(0, len(stage.gaussians), 40), []
    for number in range(3 * data.KEPT):
        save_gaussians(stage.gaussians.subset(chosen), tmp_path / f"{number:02d}.ply")
        save_semantics(labeled(stage, chosen), tmp_path / f"{number:02d}.safetensors")

    class Masks(list):
        pass

    def masks(folder):
        found = Masks()
        made.append(weakref.ref(found))
        return found

    for scene in scenes_in([tmp_path], masks):
        scene.masks()
        scene.masks()
    gc.collect()
    assert len(made) == 3 * data.KEPT
    assert sum(found() is not None for found in made) <= data.KEPT


@pytest.mark.slow
@pytest.mark.usefixtures("tiny_architecture")
@pytest.mark.parametrize("count", [3, 30])
def test_no_more_scenes_are_in_memory_than_one_step_needs(stage, count):
    """The most scenes that live at the same time, counted whenever one is read."""
    chosen = torch.arange(0, len(stage.gaussians), 8)
    living, most, reads = weakref.WeakSet(), 0, 0

    def load():
        nonlocal most, reads
        gaussians, semantics = stage.gaussians.subset(chosen), labeled(stage, chosen)
        living.add(semantics)
        most, reads = max(most, len(living)), reads + 1
        return gaussians, semantics

    scenes = [TrainingScene(str(number), load) for number in range(count)]
    distill(scenes, SETTINGS)
    assert reads == count + 1  # the first one also says what the network predicts
    assert most <= 2
