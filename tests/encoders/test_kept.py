"""A process that does many scenes loads an encoder once."""

import pytest

from sgwarp.commands.distill import Distill
from sgwarp.encoders import registry
from sgwarp.errors import InputError


@pytest.fixture
def made(monkeypatch):
    """Names of the encoders that were built; each is a new object."""
    names = []

    def build(path):
        def make(member, request):
            names.append((member.source.name, str(request.device)))
            return type("Source", (), {"needs_image": True, "space": "toy"})()

        return make

    monkeypatch.setattr(registry, "builder", build)
    monkeypatch.setattr(registry, "_kept", None)
    return names


def test_encoders_are_made_anew_by_default(made):
    assert registry.make_encoder("conse") is not registry.make_encoder("conse")
    assert len(made) == 2


def test_kept_encoders_are_made_once_for_each_name_and_device(made):
    registry.keep_encoders()
    first = registry.make_encoder("conse")
    registry.keep_encoders()
    assert registry.make_encoder("conse") is first
    assert registry.make_encoder("conse", device="cuda") is not first
    assert registry.make_encoder("clip:A+sam:B") is not registry.make_encoder("clip:A+sam:C")
    assert len(made) == 4


def test_files_are_never_kept(made):
    registry.keep_encoders()
    assert registry.make_encoder("files:labels") is not registry.make_encoder("files:labels")
    assert len(made) == 2


def test_a_block_forgets_what_it_kept(made):
    first = None

    def fail():
        nonlocal first
        with registry.kept_encoders():
            first = registry.make_encoder("conse")
            assert registry.make_encoder("conse") is first
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert registry.make_encoder("conse") is not first
    registry.keep_encoders()
    first = registry.make_encoder("conse")
    with registry.kept_encoders():
        assert registry.make_encoder("conse") is first
        inner = registry.make_encoder("clip:A")
    assert registry.make_encoder("clip:A") is inner  # the process keeps them all


@pytest.mark.parametrize(("loss", "kept"), [("contrastive", True), ("cosine", False)])
def test_distillation_keeps_the_networks_of_masks_while_it_runs(loss, kept, monkeypatch, tmp_path):
    seen = []

    def distill(*args, **options):
        seen.append(registry._kept is not None)
        raise InputError("enough")

    monkeypatch.setattr(registry, "_kept", None)
    monkeypatch.setattr("sgwarp.network.training.trainer.distill", distill)
    monkeypatch.setattr("sgwarp.network.training.data.scenes_in", lambda *args: [])
    with pytest.raises(InputError, match="enough"):
        Distill(scenes=[tmp_path], loss=loss, out=tmp_path / "net.safetensors").run()
    assert seen == [kept]
    assert registry._kept is None


def test_text_sides_are_kept_for_all_that_they_depend_on(monkeypatch):
    """Name, device and templates; what is asked for again is the same object."""
    monkeypatch.setattr(registry, "_kept", None)
    monkeypatch.setattr(registry, "make_text_encoder", lambda name, device, templates: Side())
    asked = [
        ("a", "cpu", None),
        ("b", "cpu", None),
        ("a", "cuda", None),
        ("a", "cpu", ("plain",)),
        ("a", "cpu", ("{}",)),
    ]
    assert registry.text_encoder_for("toy", *asked[0]) is not registry.text_encoder_for("toy", *asked[0])
    registry.keep_encoders()
    made = [registry.text_encoder_for("toy", *one) for one in asked]
    assert len({id(side) for side in made}) == len(asked)
    assert [registry.text_encoder_for("toy", *one) for one in asked] == made


class Side:
    space = "toy"

    def encode_text(self, texts):
        raise AssertionError("not asked")
