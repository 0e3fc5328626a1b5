"""The photometric loss and its gradient against whole two-dimensional windows in float64."""

import pytest
import torch

from sgwarp.errors import InputError
from sgwarp.ops import launcher
from sgwarp.ops.photometric import photometric_loss
from sgwarp.ops.reference import fitting as reference_fit

# Of the loss, and of the gradient relative to its largest. Without contrast the variance is the difference of moments
# of 1/4, each off by some 5 units of 2^-25 after two passes, beside the stabiliser 9e-4: 3e-4 of the gradient.
TOLERANCES = {"noisy": (1e-6, 2e-6), "unlike": (1e-6, 2e-6), "flat": (5e-6, 5e-4)}


def pictures(height: int, width: int, kind: str) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(height * width)
    truth = torch.rand(height, width, 3, generator=random)
    noise = 0.1 * torch.randn(height, width, 3, generator=random)
    if kind == "flat":  # no variance: the stabilisers alone decide
        return torch.full_like(truth, 0.5) + 1e-3 * noise, torch.full_like(truth, 0.5)
    return truth + noise if kind == "noisy" else 3.0 * noise, truth


@pytest.mark.parametrize("schedule", ["lanes", "block"])
@pytest.mark.parametrize("kind", ["noisy", "flat", "unlike"])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (11, 16), (37, 29), (48, 64)])
def test_loss_and_gradient_are_those_of_the_oracle(size, kind, schedule):
    image, truth = pictures(*size, kind)
    for share in (0.0, 0.2, 1.0):
        ours, theirs = image.clone().requires_grad_(), image.double().requires_grad_()
        loss = photometric_loss(ours, truth, share, schedule=schedule)
        expected = reference_fit.photometric_loss(theirs, truth, share)
        loss.backward()
        expected.backward()
        assert abs(loss.item() - expected.item()) < TOLERANCES[kind][0]
        error = (ours.grad - theirs.grad).abs().max()
        assert error < TOLERANCES[kind][1] * theirs.grad.abs().max().clamp(min=1 / image.numel())


def test_the_oracle_has_the_gradient_of_its_loss():
    image, truth = pictures(6, 7, "noisy")
    leaf = image.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: reference_fit.photometric_loss(x, truth, 0.5), leaf)


def test_equal_pictures_have_no_loss():
    _, truth = pictures(20, 30, "noisy")
    image = truth.clone().requires_grad_()
    loss = photometric_loss(image, truth)
    loss.backward()
    assert abs(loss.item()) < 1e-6
    assert image.grad.abs().max() < 1e-6


def test_a_stale_margin_of_another_size_does_not_leak_in():
    """Scratch memory is shared by images of all sizes."""
    small = pictures(9, 10, "noisy")
    alone = photometric_loss(*small)
    photometric_loss(*pictures(40, 50, "unlike"))
    assert torch.equal(photometric_loss(*small), alone)


def test_the_number_of_threads_does_not_change_a_bit():
    image, truth = pictures(64, 50, "noisy")
    before, results = launcher.get_threads(), []
    try:
        for threads in (1, 2, 5):
            launcher.set_threads(threads)
            leaf = image.clone().requires_grad_()
            loss = photometric_loss(leaf, truth)
            loss.backward()
            results.append((loss.detach(), leaf.grad))
    finally:
        launcher.set_threads(before)
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0])
        assert torch.equal(gradient, results[0][1])


@pytest.mark.parametrize(
    ("image", "truth", "message"),
    [
        (torch.zeros(4, 5), torch.zeros(4, 5), r"image: expected shape \[H, W, 3\], got \[4, 5\]"),
        (torch.zeros(4, 5, 3), torch.zeros(5, 4, 3), "truth: expected the image's shape"),
        (torch.zeros(4, 5, 3).double(), torch.zeros(4, 5, 3), "expected float32"),
    ],
)
def test_bad_pictures_are_refused(image, truth, message):
    with pytest.raises(InputError, match=message):
        photometric_loss(image, truth)
