"""Several sources at once: scalar products are weighted means of cosines."""

import pytest
import torch
from torch.nn.functional import interpolate, normalize

from sgwarp.encoders.ensemble import Ensemble, TextEnsemble, join_maps
from sgwarp.errors import InputError
from sgwarp.scene import FeatureMap


def unit(*shape, seed=0):
    return normalize(torch.randn(*shape, generator=torch.Generator().manual_seed(seed)), dim=-1)


class Source:
    needs_image = True

    def __init__(self, space, found, channels):
        self.space, self.found, self.channels = space, found, channels

    def encode(self, view, image):
        return self.found

    def encode_text(self, texts):
        return unit(len(texts), self.channels, seed=self.channels)

    def cache_key(self, view):
        return f"key of {self.space}"


def ids(size, count, seed):
    return torch.randint(-1, count, (1, *size), generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def pair():
    first = Source("one", FeatureMap("one", ids=ids((6, 8), 3, 0), vectors=5 * unit(3, 4, seed=1)), 4)
    second = Source("two", FeatureMap("two", ids=ids((12, 16), 4, 1), vectors=unit(4, 7, seed=2)), 7)
    return first, second


def test_weighted_similarities(pair, view, image):
    """At every pixel that both know: the product with a phrase is the weighted mean of the two cosines."""
    ensemble = Ensemble(pair, (3.0, 1.0))
    assert ensemble.space == "one@0.75 ++ two@0.25"
    found = ensemble.encode(view, image)
    assert found.size == (12, 16)
    texts = ensemble.encode_text(["a", "b"])
    torch.testing.assert_close(texts.norm(dim=1), torch.ones(2))
    parts = [member.encode_text(["a", "b"]) for member in pair]
    seen = set()
    for y in range(12):
        for x in range(16):
            numbers = int(pair[0].found.ids[0, y // 2, x // 2]), int(pair[1].found.ids[0, y, x])
            cosines = torch.zeros(2)
            for member, part, weight, number in zip(pair, parts, (0.75, 0.25), numbers, strict=True):
                if number >= 0:
                    cosines += weight * part @ normalize(member.found.vectors[number], dim=0)
            number = int(found.ids[0, y, x])
            if numbers == (-1, -1):
                assert number == -1
            else:
                torch.testing.assert_close(texts @ found.vectors[number], cosines, rtol=1e-4, atol=1e-6)
                seen.add(numbers)
    assert len(found.vectors) == len(seen)


def test_dense_members(view, image):
    dense = torch.randn(6, 8, 4, generator=torch.Generator().manual_seed(5))
    valid = torch.ones(6, 8, dtype=torch.bool)
    valid[0, 0] = False
    first = FeatureMap("one", dense=dense, valid=valid)
    second = FeatureMap("two", ids=ids((12, 16), 4, 1), vectors=unit(4, 7, seed=2))
    found = join_maps("both", [first, second], (0.5, 0.5))
    assert found.dense.shape == (6, 8, 11)
    for y in range(6):
        for x in range(8):
            number = int(second.ids[0, 2 * y + 1, 2 * x + 1])
            wanted = torch.zeros(11)
            if valid[y, x]:
                wanted[:4] = normalize(dense[y, x], dim=0) * 0.5**0.5
            if number >= 0:
                wanted[4:] = second.vectors[number] * 0.5**0.5
            torch.testing.assert_close(found.dense[y, x], wanted, rtol=1e-4, atol=1e-6)


def test_levels_are_shared():
    several = FeatureMap("one", ids=torch.cat([ids((4, 4), 3, k) for k in range(3)]), vectors=unit(3, 4))
    single = FeatureMap("two", ids=ids((4, 4), 2, 7), vectors=unit(2, 5))
    found = join_maps("both", [several, single], (0.5, 0.5))
    assert found.ids.shape == (3, 4, 4)
    for level in range(3):
        alone = FeatureMap("one", ids=several.ids[level], vectors=several.vectors)
        wanted = join_maps("both", [alone, single], (0.5, 0.5))
        there = wanted.ids[0] >= 0
        assert torch.equal(found.ids[level] >= 0, there)
        torch.testing.assert_close(
            found.vectors[found.ids[level][there].long()], wanted.vectors[wanted.ids[0][there].long()]
        )
    two = FeatureMap("two", ids=torch.zeros(2, 4, 4, dtype=torch.int64), vectors=unit(1, 5))
    with pytest.raises(InputError, match="2 levels cannot be put together with one of 3"):
        join_maps("both", [several, two], (0.5, 0.5))


def test_levels_beside_a_dense_map():
    """Levels of a pixel count as one direction of length 1; a pixel is unknown where all members are."""
    levels = FeatureMap("one", ids=torch.tensor([[[0, 0, -1, -1]], [[1, -1, -1, -1]]]), vectors=torch.eye(2))
    known = torch.tensor([[True, False, True, False]])
    dense = FeatureMap("two", dense=torch.tensor([0.0, 2.0]).expand(1, 4, 2), valid=known)
    found = join_maps("both", [levels, dense], [0.5, 0.5])
    half = 0.5**0.5
    expected = [[0.5, 0.5, 0.0, half], [half, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, half], [0.0] * 4]
    torch.testing.assert_close(found.dense[0], torch.tensor(expected))
    assert found.valid.tolist() == [[True, True, True, False]]


def test_keys_and_maps_that_are_missing(pair, view):
    ensemble = Ensemble(pair, (1.0, 1.0))
    assert ensemble.cache_key(view) == "one@0.5 ++ two@0.5(key of one; key of two)"
    assert ensemble.has_map(view)
    pair[1].has_map = lambda view: False
    assert not ensemble.has_map(view)
    pair[0].cache_key = lambda view: None
    assert ensemble.cache_key(view) is None


def test_what_does_not_go_together(pair, view, image):
    with pytest.raises(InputError, match="one weight for each of 2 members, got 1"):
        Ensemble(pair, (1.0,))
    with pytest.raises(InputError, match="weights must be positive"):
        Ensemble(pair, (1.0, 0.0))
    with pytest.raises(InputError, match="space 'labels' holds ids"):
        Ensemble([pair[0], Source("labels", None, 3)], (1.0, 1.0))
    pair[0].space = "three"
    with pytest.raises(InputError, match="space 'three' gave a map in space 'one'"):
        Ensemble(pair, (1.0, 1.0)).encode(view, image)
    mute = type("Mute", (), {"space": "mute", "needs_image": False, "encode": None})()
    with pytest.raises(InputError, match="the member in space 'mute' has no text side"):
        Ensemble([pair[1], mute], (1.0, 1.0)).encode_text(["a"])


def test_text_side_alone_has_the_same_space(pair):
    assert TextEnsemble(pair, (3.0, 1.0)).space == Ensemble(pair, (3.0, 1.0)).space


def test_dense_maps_of_two_sizes():
    """The coarser one is read bilinearly at the size of the finer, as directions; both orders give the same."""
    fine, coarse = unit(12, 16, 3, seed=1), 7 * unit(6, 8, 4, seed=2)
    large = interpolate(normalize(coarse, dim=2).permute(2, 0, 1)[None], (12, 16), mode="bilinear")[0]
    parts = [fine * 0.8**0.5, normalize(large.permute(1, 2, 0), dim=2) * 0.2**0.5]
    maps = [FeatureMap("one", dense=fine), FeatureMap("two", dense=coarse.half())]
    for order in ((0, 1), (1, 0)):
        found = join_maps("both", [maps[k] for k in order], [(0.8, 0.2)[k] for k in order])
        wanted = torch.cat([parts[k] for k in order], dim=2)
        torch.testing.assert_close(found.dense, wanted, rtol=1e-3, atol=1e-3)  # half precision of the second
        assert found.valid is None


@pytest.mark.parametrize("kind", ["ids", "dense"])
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("large", "small"), [((4, 40), (5, 8)), ((40, 4), (8, 5)), ((30, 10), (4, 40))])
def test_the_map_with_the_most_pixels_gives_the_size(kind, order, large, small):
    """Not the one with the most rows or columns."""
    maps = []
    for size in (large, small)[::order]:
        parts = {"ids": ids(size, 3, 0), "vectors": unit(3, 4)} if kind == "ids" else {"dense": unit(*size, 4)}
        maps.append(FeatureMap("one", **parts))
    assert join_maps("both", maps, (0.5, 0.5)).size == large


@pytest.mark.parametrize("needed", [(True, True), (True, False), (False, True), (False, False)])
def test_the_photograph_is_needed_if_a_member_needs_it(pair, needed):
    for member, needs in zip(pair, needed, strict=True):
        member.needs_image = needs
    assert Ensemble(pair, (1.0, 1.0)).needs_image == any(needed)


def test_every_map_has_its_weight(pair):
    maps = [member.found for member in pair]
    dense = FeatureMap("three", dense=torch.ones(6, 8, 2))
    for several in (maps, [*maps, dense]):
        with pytest.raises(ValueError, match="shorter"):
            join_maps("both", several, [0.5])


def test_the_members_are_given_view_and_photograph(pair, view, image):
    asked = []
    for member in pair:
        member.encode = lambda *given, member=member: asked.append(given) or member.found
    Ensemble(pair, (1.0, 1.0)).encode(view, image)
    assert [(one is view, other is image) for one, other in asked] == [(True, True)] * 2
