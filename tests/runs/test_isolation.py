"""What callers set up for torch does not reach the code behind `isolated`, and is as it was afterwards."""

import sys
from types import SimpleNamespace

import pytest
import torch

from sgwarp.runs.isolation import isolated, uncompiled


@isolated
def made(value: float = 1.0, fail: bool = False):
    """A new tensor, and a product whose type shows autocast."""
    if fail:
        raise ZeroDivisionError
    ones = torch.ones(2, 2) * value
    return ones, ones.to("cpu") @ torch.eye(2, device="cpu") if ones.device.type == "cpu" else None


def test_a_default_device_is_not_taken_and_stays():
    with torch.device("meta"):
        new, _ = made(3.0)
        assert (new.device.type, new.tolist()) == ("cpu", [[3.0, 3.0]] * 2)
        assert torch.empty(1).device.type == "meta"
    assert torch.empty(1).device.type == "cpu"


def test_autocast_is_off_inside_and_on_again_behind():
    def product():
        return (torch.ones(2, 2) @ torch.ones(2, 2)).dtype

    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert made()[1].dtype == torch.float32
        assert product() == torch.bfloat16
        with pytest.raises(ZeroDivisionError):
            made(fail=True)
        assert product() == torch.bfloat16
    assert product() == torch.float32


def test_autocast_of_another_device_is_off_too(monkeypatch):
    asked, entered = [], []
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda kind: asked.append(kind) or kind == "cuda")
    original = torch.autocast

    class Autocast:
        def __init__(self, kind, enabled):
            entered.append((kind, enabled))
            self.inner = original("cpu", enabled=False)

        def __enter__(self):
            return self.inner.__enter__()

        def __exit__(self, *error):
            return self.inner.__exit__(*error)

    monkeypatch.setattr(torch, "autocast", Autocast)
    made()
    assert set(asked) == {"cpu", "cuda"}
    assert entered == [("cuda", False)]


def test_the_compiler_is_asked_once_to_keep_out(monkeypatch):
    kept = []

    def disable(function):
        kept.append(function)
        return lambda *given, **named: ("kept", function(*given, **named))

    @uncompiled
    def add(one, other=0):
        return one + other

    monkeypatch.delitem(sys.modules, "torch._dynamo", raising=False)
    assert add(1, other=2) == 3
    monkeypatch.setitem(sys.modules, "torch._dynamo", SimpleNamespace(disable=disable))
    assert add(1, other=2) == ("kept", 3)
    assert add(2, 5) == ("kept", 7)
    assert len(kept) == 1
    assert add.__name__ == "add"
