"""A network on disk, what it predicts, and how its prediction is rendered."""

import pytest
import torch

import sgwarp as sg
from sgwarp.cli import main
from sgwarp.errors import InputError
from sgwarp.io.store import load_semantics, save_semantics
from sgwarp.network.inputs import voxelize
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.prediction import predict
from sgwarp.network.semantic_network import SemanticNetwork, load_network, save_network
from sgwarp.rendering.renderer import render
from sgwarp.runs.log import RunLog
from sgwarp.scene import Gaussians

LABELS = ("1", "2", "3", "4")


def network(inputs="full", channels=(10, 5), labels=None) -> SemanticNetwork:
    torch.manual_seed(0)
    return SemanticNetwork(MinkUNet(*channels, "14A").eval(), inputs, 0.12, "toy", labels)


@pytest.fixture(autouse=True)
def one_thread():
    """Waiting for a second thread costs more than these small products."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def net() -> SemanticNetwork:
    return network()


def test_a_network_predicts_the_same_after_saving(net, stage, tmp_path):
    before = predict(stage.gaussians, net).semantics()
    save_network(net, tmp_path / "net.safetensors", {"epochs": 3})
    loaded = load_network(tmp_path / "net.safetensors")
    assert (loaded.inputs, loaded.voxel, loaded.space, loaded.labels) == ("full", 0.12, "toy", None)
    after = predict(stage.gaussians, loaded).semantics()
    assert torch.equal(before.features, after.features)
    assert bool(before.features.abs().max() > 0)


def test_a_checkpoint_of_the_paper_predicts_the_same(stage, tmp_path):
    """Bare weights on 56 channels, as the release saves them, and under OpenScene's names."""
    raw = network("raw56", (56, 5))
    before = predict(stage.gaussians, raw).semantics()
    state = raw.net.state_dict()
    torch.save(state, tmp_path / "bare.pth")
    torch.save({"state_dict": {f"module.net3d.{name}": t for name, t in state.items()}}, tmp_path / "wrapped.pth")
    for name in ("bare", "wrapped"):
        loaded = load_network(tmp_path / f"{name}.pth", voxel=0.12)
        assert (loaded.inputs, loaded.space) == ("raw56", name)
        assert torch.equal(predict(stage.gaussians, loaded).semantics().features, before.features)
    assert load_network(tmp_path / "bare.pth").voxel == 0.02


def test_what_a_file_says_is_not_contradicted(net, tmp_path):
    save_network(net, tmp_path / "net.safetensors")
    assert load_network(tmp_path / "net.safetensors", voxel=0.12).voxel == 0.12
    with pytest.raises(InputError, match=r"trained with voxel 0\.12, not 0\.02"):
        load_network(tmp_path / "net.safetensors", voxel=0.02)
    with pytest.raises(InputError, match="choose inputs full"):
        SemanticNetwork(net.net, "raw56", 0.1, "toy")
    with pytest.raises(InputError, match="4 names for 5"):
        SemanticNetwork(net.net, "full", 0.1, "toy", LABELS)
    with pytest.raises(InputError, match="change the name"):
        save_network(net, tmp_path / "net.pth")


def test_files_of_another_kind_or_version(net, tmp_path, stage):
    from safetensors.torch import load_file, save_file

    path = tmp_path / "net.safetensors"
    save_network(net, path)
    weights = load_file(path)
    save_file(weights, path, metadata={"format": "sgwarp-network", "version": "99"})
    with pytest.raises(InputError, match="version 99"):
        load_network(path)
    save_file(weights, path, metadata={"format": "sgwarp-network", "version": "1"})
    with pytest.raises(InputError, match="metadata is damaged"):
        load_network(path)
    save_file(weights, path)  # bare weights of our own format are a checkpoint like any other
    assert load_network(path, space="toy", voxel=0.12).inputs == "full"
    save_semantics(predict(stage.gaussians, net).semantics(), path)
    with pytest.raises(InputError, match="no MinkUNet"):
        load_network(path)


def test_gaussians_that_share_a_voxel_share_the_prediction(net, stage):
    log = RunLog()
    prediction = predict(stage.gaussians, net, log=log)
    assert len(prediction.hidden) < len(stage.gaussians)
    features = prediction.semantics().features
    for row in (0, 5, 17):
        alike = features[prediction.rows == row]
        assert torch.equal(alike, alike[:1].expand_as(alike))
    assert log.left_out["gaussians_that_share_a_voxel"] == len(stage.gaussians) - len(prediction.hidden)
    assert {"voxelize", "network"} <= set(log.stages)


def test_gaussians_that_are_not_finite_have_no_prediction(net, stage):
    g = stage.gaussians
    means = g.means.clone()
    means[3] = float("nan")
    log = RunLog()
    semantics = predict(Gaussians(means, g.quats, g.scales, g.opacities, g.sh), net, log=log).semantics()
    assert log.left_out["gaussians_without_voxel"] == 1
    assert (~semantics.seen).nonzero().flatten().tolist() == [3]
    assert not semantics.features[3].any()
    assert bool(torch.isfinite(semantics.features).all())


def test_hidden_channels_render_as_the_embedding_does(net, stage):
    prediction = predict(stage.gaussians, net)
    camera = stage.views[1].camera
    embedded = render(stage.gaussians, camera, "features", prediction.semantics().features)
    hidden = prediction.render(stage.gaussians, camera)
    assert hidden.shape == (*camera.size, 5)
    torch.testing.assert_close(hidden, embedded, rtol=0, atol=2e-5 * float(embedded.abs().max()))
    with pytest.raises(InputError, match="another scene"):
        prediction.render(stage.gaussians.subset(torch.arange(10)), camera)


def test_predicted_labels_are_shares(stage):
    semantics = predict(stage.gaussians, network(channels=(10, 4), labels=LABELS)).semantics()
    assert semantics.labels == LABELS
    assert float(semantics.features.min()) >= 0
    total = semantics.features.sum(dim=1)
    assert bool(((total - 1).abs() < 1e-5).logical_or(total == 0).all())


@pytest.fixture
def files(net, stage_files, tmp_path):
    path = tmp_path / "net.safetensors"
    save_network(net, path)
    return stage_files.scene, path


def run(*arguments) -> int:
    return main([str(argument) for argument in arguments])


def projection(stage_files, stage, seen: torch.Tensor, path, views=3.0):
    from sgwarp.scene import Semantics

    weight = seen.float()
    axes = torch.eye(5)[stage.classes - 1] * weight[:, None]
    save_semantics(Semantics(axes, weight, weight * views, "toy", stage_files.gaussians.fingerprint), path)
    return path


def test_predict_writes_semantics(files, stage_files, net, tmp_path):
    scene, path = files
    assert run("predict", scene, "--net", path, "--out", tmp_path / "out" / "s.safetensors") == 0
    semantics = load_semantics(tmp_path / "out" / "s.safetensors", stage_files.gaussians)
    expected = predict(stage_files.gaussians, net).semantics()
    torch.testing.assert_close(semantics.features.float(), expected.features, rtol=1e-3, atol=1e-3)
    assert semantics.coverage == 1


def test_predict_only_fills_in_what_the_projection_lacks(files, stage, stage_files, tmp_path, read_run):
    scene, path = files
    seen = stage.classes != 1
    known = projection(stage_files, stage, seen, tmp_path / "2d.safetensors")
    out = tmp_path / "out" / "s.safetensors"
    assert run("predict", scene, "--net", path, "--out", out, "--projection", known) == 0
    semantics = load_semantics(out, stage_files.gaussians)
    assert torch.equal(semantics.features[seen].float(), torch.eye(5)[stage.classes - 1][seen])
    assert bool((semantics.features[~seen] != 0).any(dim=1).all())
    log = read_run(out)
    assert log["error"]["coverage"] == pytest.approx(float(seen.float().mean()))
    assert "network" in log["stages"]


@pytest.mark.parametrize("always", [False, True])
def test_a_scene_that_the_views_cover_needs_no_network(always, files, stage, stage_files, tmp_path, read_run):
    scene, path = files
    known = projection(
        stage_files, stage, torch.ones_like(stage.classes, dtype=torch.bool), tmp_path / "2d.safetensors"
    )
    out = tmp_path / "out" / "s.safetensors"
    more = ["--always"] if always else []
    assert run("predict", scene, "--net", path, "--out", out, "--projection", known, *more) == 0
    log = read_run(out)
    assert ("network" in log["left_out"]) == (not always)
    assert ("load_network" in log["stages"]) == always
    assert log["error"] == {"coverage": 1.0, "reliability": 1.0}
    assert torch.equal(load_semantics(out).features.float(), torch.eye(5)[stage.classes - 1])


def test_one_view_alone_is_no_reliable_projection(files, stage, stage_files, tmp_path, read_run):
    scene, path = files
    everything = torch.ones_like(stage.classes, dtype=torch.bool)
    known = projection(stage_files, stage, everything, tmp_path / "2d.safetensors", views=1.0)
    out = tmp_path / "out" / "s.safetensors"
    assert run("predict", scene, "--net", path, "--out", out, "--projection", known) == 0
    assert "network" not in read_run(out)["left_out"]


@pytest.fixture
def read_run():
    import json

    return lambda out: json.loads((out.parent / "run.json").read_text())


def test_segment_and_query_take_predicted_semantics(
    files, stage, stage_files, toy_text, tmp_path, monkeypatch, read_run, capsys
):
    from sgwarp.encoders import registry
    from sgwarp.files.images import read_ids

    monkeypatch.setattr(registry, "text_encoder_for", lambda space, *rest: toy_text)
    wall = stage.classes == 1
    lifted = projection(stage_files, stage, ~wall, tmp_path / "2d.safetensors")
    predicted = projection(stage_files, stage, torch.ones_like(wall), tmp_path / "3d.safetensors")
    view = stage.views[2]
    truth = stage.labels(view)
    common = [stage_files.scene, "--semantics", lifted, "--views", stage_files.views, "--view", view.stem]
    right = {}
    for name, more in {"2d": [], "both": ["--predicted", predicted, "--ensemble", "max"]}.items():
        arguments = ["--classes", "wall,left door,lamp,book", "--out", tmp_path / name]
        assert run("segment", *common, *arguments, *more) == 0
        labels = torch.from_numpy(read_ids(tmp_path / name / f"{view.stem}.png").astype("int64"))
        right[name] = float((labels == truth - 1)[truth == 1].float().mean())
    assert right["2d"] < 0.1
    assert right["both"] > 0.9

    lamp = truth == 3
    projection(stage_files, stage, ~wall & (stage.classes != 3), lifted)  # from now on it does not know the lamp either
    predicted = projection(stage_files, stage, torch.ones_like(wall), predicted)
    text = ["--text", "lamp", "--out", tmp_path / "q" / "mask.png"]
    found = {}
    for name, more in {"2d": [], "both": ["--predicted", predicted]}.items():
        assert run("query", *common, *text, *more) == 0
        mask = torch.from_numpy(read_ids(tmp_path / "q" / "mask.png").astype("int64")) > 0
        found[name] = float(mask[lamp].float().mean())
    assert found["2d"] == 0
    assert found["both"] > 0.8

    common += ["--classes", "wall"]
    assert run("segment", *common, "--out", tmp_path / "x", "--predicted", predicted, "--ensemble", "2d") == 0
    assert read_run(tmp_path / "x" / "any")["left_out"]["predicted_semantics"] == 1
    capsys.readouterr()
    assert run("segment", *common, "--out", tmp_path / "y", "--ensemble", "3d") == 2
    assert "needs --predicted" in capsys.readouterr().err


def test_predict_refuses_what_does_not_fit(files, stage_files, tmp_path, capsys):
    scene, path = files
    assert run("predict", scene, "--net", tmp_path / "no.pth", "--out", tmp_path / "s.safetensors") == 2
    assert "no.pth: no such file" in capsys.readouterr().err
    assert run("predict", scene, "--net", path, "--out", tmp_path / "s.safetensors", "--voxel", "0.5") == 2
    assert "trained with voxel 0.12" in capsys.readouterr().err
    assert not (tmp_path / "s.safetensors").exists()


def test_a_checkpoint_of_three_channels_has_to_say_which(stage, tmp_path):
    torch.save(network("ones", (3, 5)).net.state_dict(), tmp_path / "openscene.pth")
    with pytest.raises(InputError, match="which may be xyz-rgb, ones, signed-rgb"):
        load_network(tmp_path / "openscene.pth")
    for inputs in ("ones", "signed-rgb", "xyz-rgb"):
        loaded = load_network(tmp_path / "openscene.pth", inputs=inputs, voxel=0.12)
        assert bool(torch.isfinite(predict(stage.gaussians, loaded).semantics().features).all())


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float64, 1e-4), (torch.bfloat16, 0.1)])
def test_a_network_in_another_precision_predicts(net, stage, dtype, bound):
    expected = predict(stage.gaussians, net).semantics().features
    other = network()
    other.net.to(dtype)
    found = predict(stage.gaussians, other).semantics().features
    assert found.dtype == torch.float32
    assert float((found - expected).norm() / expected.norm()) < bound


def test_weights_that_are_not_finite_are_refused(stage):
    broken = network()
    broken.net.bn0.bn.weight.data[0] = float("nan")
    with pytest.raises(InputError, match="output is not finite"):
        predict(stage.gaussians, broken)


def test_rendered_labels_are_the_splatted_shares(stage):
    named = network(channels=(10, 4), labels=LABELS)
    prediction = predict(stage.gaussians, named)
    camera = stage.views[0].camera
    rendered = prediction.render(stage.gaussians, camera)
    torch.testing.assert_close(rendered, render(stage.gaussians, camera, "features", prediction.semantics().features))


def test_training_goes_on_after_a_prediction_in_inference_mode(net, stage):
    with torch.inference_mode():
        predict(stage.gaussians, net)
        render(stage.gaussians, stage.views[0].camera)
    again = network()
    again.net.train()
    leaf = stage.gaussians.sh.clone().requires_grad_()
    g, camera = stage.gaussians, stage.views[0].camera
    seen = sg.rasterize(
        g.means, g.quats, g.scales, g.opacities, camera.world_to_camera, camera.K, camera.width, camera.height, sh=leaf
    )
    seen.features.sum().backward()
    assert bool(leaf.grad.abs().max() > 0)
    voxels, _ = voxelize(stage.gaussians, "full", 0.12)
    with torch.autocast("cpu", dtype=torch.bfloat16):  # its products use scratch memory
        again.net(voxels).features.float().sum().backward()


def test_a_network_moves_to_a_device():
    assert network("xyz-rgb", (3, 2)).to("meta").device == torch.device("meta")
