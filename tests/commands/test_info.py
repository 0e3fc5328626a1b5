"""`sgwarp info`: figures of scenes and semantics, from numbers that are known."""

import json

import pytest
import torch

from sgwarp.cli import main
from sgwarp.io.scenes import load_gaussians, save_gaussians
from sgwarp.io.store import save_semantics
from sgwarp.scene import Gaussians, Semantics


@pytest.fixture
def scene(tmp_path):
    """Four Gaussians, one of which is not finite."""
    means = torch.tensor([[0.0, -1, 2], [4, 1, 3], [2, 0, 9], [float("nan"), 0, 0]])
    quats = torch.tensor([1.0, 0, 0, 0]).expand(4, 4)
    opacities = torch.tensor([0.05, 0.55, 0.56, 0.95])
    scales = torch.tensor([0.1, 0.2, 0.4, 9.0])[:, None].expand(4, 3)
    path = tmp_path / "scene.ply"
    save_gaussians(Gaussians(means, quats, scales, opacities, torch.zeros(4, 4, 3)), path)
    return path


def facts(capsys, *arguments) -> dict:
    assert main(["info", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_scene(scene, capsys):
    found = facts(capsys, scene)
    assert (found["gaussians"], found["sh_degree"], found["non_finite_rows"]) == (4, 1, 1)
    assert found["bounds"] == [[0.0, -1.0, 2.0], [4.0, 1.0, 9.0]]  # of what is finite
    assert found["median_scale"] == pytest.approx(0.2)
    assert found["opacity_histogram"] == [1, 0, 0, 0, 0, 2, 0, 0, 0, 0]
    assert found["fingerprint"] == load_gaussians(scene).fingerprint
    assert main(["info", str(scene)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "bounds: (0, -1, 2) to (4, 1, 9)" in lines
    bars = [line.split() for line in lines if "#" in line]
    assert [(bar[0], len(bar[1]), bar[2]) for bar in bars] == [("0.0-0.1", 20, "1"), ("0.5-0.6", 40, "2")]


def test_semantics_count_what_was_seen(scene, tmp_path, capsys):
    """Effective views are a mean over the seen Gaussians; what no view saw has none, and says nothing of the views."""
    weight, views = torch.tensor([3.0, 0.0, 1.0, 0.0]), torch.tensor([4.0, 0.0, 1.0, 0.0])
    path = tmp_path / "s.safetensors"
    found = Semantics(torch.eye(4)[:, :3], weight, views, "toy", load_gaussians(scene).fingerprint, ("a", "b", "c"))
    save_semantics(found, path, {"encoder": "files:x"})
    told = facts(capsys, scene, "--semantics", path)["semantics"]
    assert (told["space"], told["channels"], told["labels"]) == ("toy", 3, ["a", "b", "c"])
    assert (told["coverage"], told["mean_effective_views"]) == (0.5, 2.5)
    assert told["notes"] == {"encoder": "files:x"}
    save_semantics(Semantics(torch.zeros(4, 2), torch.zeros(4), torch.zeros(4), "toy", found.fingerprint), path)
    told = facts(capsys, scene, "--semantics", path)["semantics"]
    assert (told["coverage"], told["mean_effective_views"]) == (0.0, 0.0)
