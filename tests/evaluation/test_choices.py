"""What an evaluation chooses reaches where it acts: views, shares, encoders, networks, and answers that are kept."""

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sgwarp.datasets.base import Query, SceneData
from sgwarp.errors import InputError
from sgwarp.evaluation import cases, networks
from sgwarp.evaluation.answers import Answers
from sgwarp.evaluation.evaluator import Evaluation
from sgwarp.evaluation.networks import NetworkSettings
from sgwarp.evaluation.profiles.catalogue import find_profile
from sgwarp.evaluation.profiles.masks import score_phrases
from sgwarp.evaluation.report_files import headline
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.io.store import save_semantics
from sgwarp.lifting.lifter import lift
from sgwarp.runs.log import RunLog
from sgwarp.scene import View

LABELLED = ("1", "4", "8")


@pytest.mark.parametrize(
    ("split", "kind", "every", "lifted", "scored"),
    [
        ("split_by_number", "strict", 1, "1235679", "48"),
        ("split_by_number", "strict", 2, "1369", "48"),
        ("split_by_number", "released", 3, "0369", "48"),
        ("split_by_label", "strict", 1, "0235679", "148"),
        ("split_by_label", "strict", 3, "059", "148"),
        ("split_by_label", "released", 4, "048", "148"),
        ("split_by_every", "strict", 2, "02468", "1"),
        ("split_by_every", "released", 4, "048", "148"),
        ("split_without_views", "strict", 5, "05", ""),
    ],
)
def test_views_that_are_lifted_and_scored(scenes, split, kind, every, lifted, scored):
    camera = scenes.pinhole(8, 6, position=(0.0, 0.0, -1.0), target=(0.0, 0.0, 4.0))
    views = [View(str(number), camera) for number in range(10)]
    settings = Settings(views=kind, every=every, hold_out=4)
    found = getattr(cases, split)(SceneData("attic", Path("attic"), 10, labelled=LABELLED), views, settings)
    assert ["".join(view.stem for view in part) for part in found] == [lifted, scored]


@pytest.mark.parametrize("share", [1.0, 0.25, 0.04])
def test_a_share_of_the_gaussians_covers_as_much_surface(scenes, share):
    """Equal disks: their number times the square of their size stays."""
    cloud = scenes.cloud(400, seed=0, scale=(0.2, 0.2), opacity=(0.3, 1.0), degree=0)
    log = RunLog()
    kept = cases._subset(cloud, Settings(share_of_gaussians=share), log)
    assert len(kept) == 400 * share
    assert len(kept) * float(kept.scales[0, 0]) ** 2 == pytest.approx(400 * float(cloud.scales[0, 0]) ** 2, rel=1e-5)
    assert log.left_out.get("gaussians_by_share", 0) == 400 - len(kept)
    again, other = (cases._subset(cloud, Settings(share_of_gaussians=share, seed=seed), RunLog()) for seed in (0, 1))
    assert torch.equal(again.means, kept.means)
    assert torch.equal(other.means, kept.means) == (share == 1.0)


def test_phrases_are_for_the_encoder_that_lifted(stage, stage_files, tmp_path, monkeypatch):
    """The notes of the file say which, whatever the profile's own encoder is."""
    asked, path = [], tmp_path / "attic.safetensors"
    save_semantics(lift(stage_files.gaussians, stage.views, stage.dense), path, {"encoder": "clip:noted"})
    monkeypatch.setattr(cases, "text_encoder_for", lambda *call: asked.append(call) or "text")
    scene = SceneData("attic", tmp_path, 6, load_views=lambda: stage.views, gaussians=stage_files.scene)
    settings = Settings(encoder="clip:other", semantics=str(tmp_path / "{scene}.safetensors"))
    case = cases.prepare(scene, settings, cases.split_without_views, RunLog())
    assert asked == [("toy", "clip:noted", "cpu")]
    assert (case.text, case.sources) == ("text", [])


def test_answers_are_kept_for_one_list_of_classes(stage, stage_files):
    """The same answers as without those before, in whatever order classes and phrases are asked."""
    semantics = lift(stage_files.gaussians, stage.views, stage.one_hot)

    def case():
        found = {"semantics": [semantics], "predicted": None, "text": None, "settings": Settings()}
        return SimpleNamespace(gaussians=stage_files.gaussians, log=RunLog(), **found)

    answers, view = Answers(case()), stage.views[2]
    truth = stage.labels(view)
    for classes in (["1", "3"], ["4"], ["3", "1"], ["1", "2", "3", "4"]):
        found = answers.labels(view, classes)
        assert torch.equal(found, Answers(case()).labels(view, classes))
        for place, name in enumerate(classes):
            assert (found[truth == int(name)] == place).float().mean() > 0.9
    for texts in (["1", "3"], ["4"], ["3"], ["3", "1"]):
        found = answers.relevancy(view, texts)
        torch.testing.assert_close(found, Answers(case()).relevancy(view, texts))
        assert all(found[0, place][truth == int(name)].mean() > 0.8 for place, name in enumerate(texts))


@pytest.mark.parametrize("changed", [{}, {"epochs": 7}, {"arch": "18A"}, {"voxel": 0.3}])
def test_networks_are_trained_as_they_are_told(monkeypatch, tmp_path, changed):
    told = []

    def distill(scenes, settings, **options):
        told.append((scenes, settings, options))
        raise InputError("stopped here")

    monkeypatch.setattr(networks, "_lift", lambda *rest: None)
    monkeypatch.setattr(networks, "scenes_in", lambda paths: [path.name for path in paths])
    monkeypatch.setattr(networks, "distill", distill)
    network = replace(NetworkSettings(), **changed)
    with pytest.raises(InputError, match="stopped here"):
        networks.train_and_predict(
            *(find_profile("room"), tmp_path, tmp_path / "n" / "full", Settings(), ["a/b", "c"], "xyz-rgb", network)
        )
    ((scenes, settings, options),) = told
    assert scenes == ["a__b.ply", "c.ply"]
    shared = {field.name for field in fields(network)} - {"train"}
    assert {name: getattr(settings, name) for name in shared} == {name: getattr(network, name) for name in shared}
    assert (settings.inputs, settings.augment) == ("xyz-rgb", None)
    assert options == {"state": tmp_path / "n" / "full" / networks.STATE, "device": "cpu"}


@pytest.mark.parametrize("train", [None, "others"])
def test_networks_learn_from_the_scenes_that_are_named(monkeypatch, tmp_path, train):
    """The evaluated scenes themselves, or all of another data set."""
    lifted = []
    monkeypatch.setattr(networks, "_lift", lambda profile, root, *rest: lifted.append((root, rest[-1])))
    monkeypatch.setattr(networks, "find_reader", lambda name: SimpleNamespace(list_scenes=lambda root: ["x", "y", "z"]))
    monkeypatch.setattr(networks, "scenes_in", lambda paths: pytest.fail("reached"))
    network = NetworkSettings(train=None if train is None else tmp_path / train)
    with pytest.raises(pytest.fail.Exception, match="reached"):
        networks.train_and_predict(
            *(find_profile("room"), tmp_path / "data", tmp_path / "n" / "full", Settings(), ["a"], "full", network)
        )
    root = tmp_path / "data" if train is None else tmp_path / train
    assert lifted == [(root, name) for name in (["a"] if train is None else ["x", "y", "z"])]


def test_seconds_of_the_headline_are_those_of_a_scene():
    """Lifting and asking alone, each divided by the number of scenes."""
    seconds = {"read": 50.0, "encode": 70.0, "lift": 6.0, "query": 1.0, "answer": 2.0, "draw": 90.0}
    results = [SceneResult(name, {"miou": 0.5}, seconds=dict(seconds)) for name in ("a", "b")]
    found = Evaluation(find_profile("room"), Settings(), results, figures={"miou": 0.5})
    row = dict(zip(headline(found).columns, headline(found).rows[0], strict=True))
    assert (row["lifting [s]"], row["asking [s]"]) == ("6.00", "3.00")


OTHER = {
    **{"encoder": "files:x", "method": "center", "gaussians": "g", "semantics": "s", "predicted": "p"},
    **{"ensemble": "mean", "scoring": "cosine", "classes": ("a",), "threshold": 0.7, "views": "released"},
    **{"hold_out": 5, "every": 3, "share_of_views": 0.5, "share_of_gaussians": 0.5, "count": 7, "forgetting": 0.4},
    **{"sheets": 0, "seed": 9, "device": "cuda", "cache": "maps"},
}


@pytest.mark.parametrize("name", OTHER)
def test_results_belong_to_all_choices_but_where_they_are_computed_and_kept(name):
    plain, changed = Settings(), replace(Settings(), **{name: OTHER[name]})
    assert (changed.identity == plain.identity) == (name in ("device", "cache"))


def test_choices_are_complete():
    assert set(OTHER) | {"levels"} == {field.name for field in fields(Settings)}
    levels = [Settings(encoder="files:{level}", levels=one).identity for one in (("s",), ("m",))]
    assert levels[0] != levels[1]


@pytest.mark.parametrize(("threshold", "found"), [(-9.0, 1.0), (0.5, None), (9.0, 0.0)])
def test_a_phrase_is_where_the_scores_of_the_scene_exceed_the_threshold(stage, stage_files, toy_text, threshold, found):
    """Below all scores everything is the object, above all of them nothing: the mask is that of the threshold."""
    view = stage.views[2]
    truth = stage.labels(view) == 3
    queries = [Query(view.stem, "lamp", view.camera.size, lambda: truth, torch.zeros(0, 4))]
    case = SimpleNamespace(
        scene=SimpleNamespace(need=lambda what: lambda: queries, folder=Path("attic")),
        **{"settings": Settings(sheets=0, threshold=threshold), "scored": [view], "log": RunLog(), "predicted": None},
        **{"gaussians": stage_files.gaussians, "text": toy_text, "sources": []},
        semantics=[lift(stage_files.gaussians, stage.views, stage.dense)],
    )
    result = SceneResult("attic")
    score_phrases(case, result, Path("attic"))
    expected = {1.0: pytest.approx(float(truth.float().mean())), 0.0: 0.0}.get(found)
    assert result.figures["iou"] == expected if found is not None else result.figures["iou"] > 0.8
