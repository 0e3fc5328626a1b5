"""The numbers of a fit are those that were published, each read off the papers and their released code.

3DGS: Kerbl et al. 2023 (arguments/__init__.py and gaussian_model.py of graphdeco-inria/gaussian-splatting). MCMC:
Kheradmand et al. 2024, as gsplat 1.5.3 has it (strategy/mcmc.py, strategy/default.py, examples/simple_trainer.py).
"""

import math
from dataclasses import fields, replace

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops.adam import BETAS, count_steps
from sgwarp.reconstruction.fitting import densify, exposure, initial, loop, mcmc, pose_refinement
from sgwarp.reconstruction.fitting.densify import Densify
from sgwarp.reconstruction.fitting.exposure import Exposure
from sgwarp.reconstruction.fitting.initial import gaussians_from_points
from sgwarp.reconstruction.fitting.mcmc import MarkovChain
from sgwarp.reconstruction.fitting.model import Gradients, Model
from sgwarp.reconstruction.fitting.pose_refinement import PoseRefinement
from sgwarp.reconstruction.fitting.settings import FitSettings
from sgwarp.scene import Camera, Gaussians

CAMERA = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 20], [0, 0, 1]]), torch.eye(4), 40, 40)
LONG = FitSettings(steps=30_000, cap=10_000, noise=0.0)

DEFAULTS = {
    # What a command line says where nothing is said; documented in docs/fit.md.
    "steps": 10_000,
    "strategy": "mcmc",
    "cap": 100_000,
    "background": "black",
    "sparse": True,
    "exposure": False,
    "refine_poses": False,
    "refine_held_out": False,
    "seed": 0,
    "evaluate_every": 500,
    # 3DGS, OptimizationParams; position_lr_init and _final are for an extent of 1.
    "sh_degree": 3,
    "similarity_share": 0.2,  # lambda_dssim
    "refine_every": 100,  # densification_interval
    "degree_every": 1000,  # oneupSHdegree
    "means_rate": 0.00016,
    "last_means_rate": 0.0000016,
    "scales_rate": 0.005,
    "quats_rate": 0.001,
    "opacities_rate": 0.05,
    "colors_rate": 0.0025,
    "grow_gradient": 0.0002,
    "split_scale": 0.01,  # percent_dense
    "least_opacity": 0.005,
    # MCMC: noise_lr, opacity_reg, scale_reg.
    "noise": 500_000.0,
    "opacity_pull": 0.01,
    "scale_pull": 0.01,
}


def test_defaults_are_the_published_ones():
    assert {field.name: field.default for field in fields(FitSettings)} == DEFAULTS


@pytest.mark.parametrize(
    ("owner", "published"),
    [
        (densify, {"REFINE_UNTIL": 15_000, "RESET_EVERY": 3_000, "CHILDREN": 2, "HUGE": 0.1, "FAINT": 0.01}),
        (densify, {"SHRINK": 1.6, "LEAST_RESET": 1_000, "UNSEEN_TURNS": 2}),
        (mcmc, {"REFINE_UNTIL": 25_000, "GROWTH": 1.05, "MOST_COPIES": 51, "FULL_AT": 15_000, "UNSEEN_TURNS": 2}),
        (exposure, {"RATE": 0.01, "LAST_RATE": 0.001}),  # exposure_lr_init, exposure_lr_final
        (pose_refinement, {"RATE": 1e-3, "LAST_RATE": 1e-5}),
        (initial, {"SIZE": 1.0, "VISIBLE": 1 / 255}),
        (loop, {"MEMORY": 0.99}),
    ],
)
def test_constants_are_the_published_ones(owner, published):
    assert {name: getattr(owner, name) for name in published} == pytest.approx(published)


def test_the_optimiser_has_the_published_moments():
    assert BETAS == (0.9, 0.999)


def cloud(count: int, scale: float = 0.005, opacity: float = 0.5) -> Model:
    return Model.starting(
        Gaussians(
            means=torch.randn(count, 3, generator=torch.Generator().manual_seed(0)),
            quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
            scales=torch.full((count, 3), scale),
            opacities=torch.full((count,), opacity),
            sh=torch.zeros(count, 1, 3),
        )
    )


def refined(strategy: Densify | MarkovChain, model: Model, step: int) -> Model:
    """After a step that shows all and moves none."""
    blank = {name: torch.zeros_like(model[name]) for name in model.groups}
    steps = torch.zeros(len(model), dtype=torch.int32)
    taken = count_steps(torch.ones(len(model)), torch.zeros(len(model), 1, 3), steps, steps.clone(), sparse=True)
    strategy.after_step(model, step, Gradients(**blank, means2d=torch.zeros(len(model), 2)), taken, CAMERA)
    return model


def of_strategy(name: str, photographs: int, count: int, extent: float = 1.0, **changes) -> Densify | MarkovChain:
    settings = replace(LONG, strategy=name, **changes)
    if name == "mcmc":
        return MarkovChain(settings, extent, photographs)
    return Densify(settings, extent, photographs, count, torch.device("cpu"))


@pytest.mark.parametrize(("strategy", "cap"), [("mcmc", 20), ("default", 20)])
@pytest.mark.parametrize(("skipped", "gone"), [(13, False), (14, True)])
def test_what_two_turns_of_seven_photographs_do_not_show_goes(strategy, cap, skipped, gone):
    """It is removed, or moved to where another one is."""
    model = cloud(20)
    model.skipped[3] = skipped
    place = model["means"][3].clone()
    refined(of_strategy(strategy, 7, 20, cap=cap), model, 600)
    there = bool((model["means"] == place).all(dim=1).any())
    assert there != gone
    assert len(model) == (19 if gone and strategy == "default" else 20)


@pytest.mark.parametrize(
    ("scale", "extent", "left"), [(0.099, 1.0, 4), (0.101, 1.0, 3), (0.19, 2.0, 4), (0.21, 2.0, 3)]
)
def test_what_is_larger_than_a_tenth_of_the_extent_goes_after_a_reset(scale, extent, left):
    model = cloud(4)
    model.groups["scales"].values[2] = scale
    assert len(refined(of_strategy("default", 1000, 4, extent), model, 3_100)) == left


@pytest.mark.parametrize(("opacity", "left"), [(0.0049, 3), (0.0051, 4)])
def test_what_is_fainter_than_a_two_hundredth_is_removed(opacity, left):
    model = cloud(4)
    model.groups["opacities"].values[2] = opacity
    assert len(refined(of_strategy("default", 1000, 4), model, 600)) == left


def test_growth_by_a_twentieth_and_faster_where_the_cap_would_not_be_reached():
    """By step 15,000 of 30,000, at a refinement each 100 steps: the n-th root of what is missing."""
    for count, cap, step, expected in ((1000, 5_000, 600, 1050), (1000, 1_030, 600, 1030), (100, 10_000, 14_000, 158)):
        assert len(refined(of_strategy("mcmc", 1000, count, cap=cap), cloud(count), step)) == expected
    assert int(100 * (10_000 / 100) ** (1 / 10)) == 158


def test_the_rate_of_a_pose_falls():
    for share, rate in ((0.0, 1e-3), (0.5, 1e-4), (1.0, 1e-5)):
        poses = PoseRefinement([CAMERA] * 3, torch.device("cpu"))
        poses.update(1, torch.ones(6), share)
        torch.testing.assert_close(poses.group.parameters[1], torch.full((6,), -rate), rtol=1e-3, atol=0)


def test_what_all_cameras_share_is_no_motion():
    poses, exposures = PoseRefinement([CAMERA] * 3, torch.device("cpu")), Exposure(3, torch.device("cpu"))
    poses.group.parameters += 0.1
    poses.group.parameters[0, 4] += 0.3
    exposures.group.parameters[0, 0, 3] += 0.3
    expected = torch.zeros(3, 6)
    expected[:, 4] = torch.tensor([0.2, -0.1, -0.1])
    torch.testing.assert_close(torch.stack([poses.leaf(k).detach() for k in range(3)]), expected)
    offsets = [exposures.leaf(k).detach()[0, 3].item() for k in range(3)]
    assert offsets == pytest.approx([0.2, -0.1, -0.1], abs=1e-6)


@pytest.mark.parametrize(("strategy", "opacity"), [("default", 0.1), ("mcmc", 0.5)])
def test_gaussians_start_as_published(strategy, opacity):
    """As large as the root mean square distance to three neighbours: here 1, 1 and sqrt(2) along a square."""
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    found = gaussians_from_points(square, torch.full((4, 3), 0.25), FitSettings(strategy=strategy), 1.0)
    torch.testing.assert_close(found.opacities, torch.full((4,), opacity))
    torch.testing.assert_close(found.scales, torch.full((4, 3), math.sqrt((1 + 1 + 2) / 3)))
    torch.testing.assert_close(found.sh[:, 0], torch.full((4, 3), (0.25 - 0.5) * 2 * math.sqrt(math.pi)))
    one_place = gaussians_from_points(torch.zeros(4, 3), torch.zeros(4, 3), FitSettings(), 3.0)
    torch.testing.assert_close(one_place.scales, torch.full((4, 3), 3e-4))


@pytest.mark.parametrize("name", ["strategy", "background"])
def test_choices_are_named(name):
    with pytest.raises(InputError, match=f"{name}: 'x' is not one of"):
        FitSettings(**{name: "x"})


def test_points_of_another_shape_are_named():
    with pytest.raises(InputError, match=r"points: expected \[N, 3\] twice"):
        gaussians_from_points(torch.zeros(5, 2), torch.zeros(5, 2), FitSettings(), 1.0)


def test_a_state_comes_back_whole():
    """Of the default strategy: the sums and the views of each Gaussian, which are not the same."""
    strategy, other = of_strategy("default", 5, 3), of_strategy("default", 5, 3)
    strategy.sums, strategy.views = torch.tensor([1.0, 2, 3]), torch.tensor([4, 5, 6], dtype=torch.int32)
    other.restore(strategy.state())
    assert other.sums.tolist() == [1, 2, 3]
    assert other.views.tolist() == [4, 5, 6]
    model = cloud(3)
    for number, (name, value) in enumerate(model.state().items()):
        if name != "opacities.values":
            value.fill_(number + 1)
    back = Model.restored(model.state())
    assert {name: value.tolist() for name, value in back.state().items()} == {
        name: value.tolist() for name, value in model.state().items()
    }


def test_rows_that_are_assigned_begin_anew():
    model = cloud(4)
    for group in model.groups.values():
        group.first.fill_(1.0)
        group.second.fill_(1.0)
    model.steps.fill_(9)
    model.skipped.fill_(5)
    model.assign(torch.tensor([1, 2]), {"opacities": torch.zeros(2)})
    fresh = torch.tensor([False, True, True, False])
    for group in model.groups.values():
        for moment in (group.first, group.second):
            assert ((moment == 0).flatten(1).all(dim=1) if moment.ndim > 1 else moment == 0).equal(fresh)
    assert model.steps.tolist() == [9, 0, 0, 9]
    assert model.skipped.tolist() == [5, 0, 0, 5]
    assert model["opacities"].tolist() == [0.5] * 4
    model.append(torch.tensor([0]))
    assert model.steps.tolist() == [9, 0, 0, 9, 0]
    assert model.skipped.tolist() == [5, 0, 0, 5, 0]
    assert not model.groups["means"].first[4].any()
