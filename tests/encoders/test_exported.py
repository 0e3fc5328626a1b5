"""What other programs export: VLPart's instances, masks, Feature 3DGS's maps; written here by hand."""

import json

import cv2
import numpy as np
import pytest
import torch

from sgwarp.encoders.base import UNRANKED, MissingMap
from sgwarp.encoders.instances.vlpart import VLPartFiles, decode_rle, plain_name
from sgwarp.encoders.maps.files import FileMaps
from sgwarp.encoders.masks.files import FileMasks
from sgwarp.errors import InputError

MASK = np.zeros((48, 64), bool)
MASK[10:30, 5:40] = True
MASK[12:14, 20:22] = False
MASK[0, 0] = MASK[47, 63] = True


def runs(mask: np.ndarray) -> list[int]:
    """Lengths of runs, column by column, beginning with zeros."""
    counts, current = [], False
    length = 0
    for value in mask.T.ravel():
        if bool(value) != current:
            counts.append(length)
            current, length = bool(value), 0
        length += 1
    return [*counts, length]


def as_text(counts: list[int]) -> str:
    """COCO's characters: differences to the run two before from the third on, five bits each with a sign."""
    text = ""
    for k, count in enumerate(counts):
        value = count - (counts[k - 2] if k > 2 else 0)
        more = True
        while more:
            bits = value & 31
            value >>= 5
            more = value != -1 if bits & 16 else value != 0
            text += chr((bits | 32 if more else bits) + 48)
    return text


@pytest.mark.parametrize("mask", [MASK, ~MASK, np.zeros((48, 64), bool), np.ones((48, 64), bool), MASK[:7, :3]])
def test_run_lengths(mask):
    for counts in (runs(mask), as_text(runs(mask))):
        np.testing.assert_array_equal(decode_rle({"size": mask.shape, "counts": counts}), mask)


def test_run_lengths_of_random_masks():
    rng = np.random.default_rng(0)
    for _ in range(20):
        mask = rng.random((rng.integers(1, 40), rng.integers(1, 40))) < rng.random()
        np.testing.assert_array_equal(decode_rle({"size": mask.shape, "counts": as_text(runs(mask))}), mask)


@pytest.mark.parametrize(
    ("size", "counts", "message"),
    [
        ([0, 5], [], "a mask of 0 x 5 pixels"),
        ([5, 0], [0], "a mask of 5 x 0 pixels"),
        ([-2, -3], [6], "a mask of -2 x -3 pixels"),
        ([10**6, 10**6], [4], "a mask of 1000000 x 1000000 pixels"),
        ([2, 2], [], "run lengths add up to 0, not 2 x 2"),
        ([2, 2], [5, -2, 1], "run lengths add up to 4, not 2 x 2"),
        ([2, 2], [5], "run lengths add up to 5"),
        ([2, 2], "/", "stands for no run length"),
        ([2, 2], "p", "stands for no run length"),
        ([2, 2], "\x94", "stands for no run length"),
    ],
)
def test_run_lengths_of_no_mask(size, counts, message):
    with pytest.raises(ValueError, match=message):
        decode_rle({"size": size, "counts": counts})


def test_the_last_character_of_all_goes_on():
    """Six bits set: a run that never ends."""
    with pytest.raises(IndexError):
        decode_rle({"size": [2, 2], "counts": "o"})


@pytest.mark.parametrize(("rows", "fits"), [(25, True), (23, True), (26, False), (22, False)])
def test_masks_may_be_off_by_a_pixel(tmp_path, view, image, rows, fits):
    """Of an image of 64 x 48, 32 x 24 pixels are expected: sizes are rounded."""
    masks = np.ones((1, rows, 32), bool)
    for folder in ("found", "masks"):
        (tmp_path / folder).mkdir()
    np.savez(tmp_path / "masks" / "a.npz", masks=masks)
    np.savez(tmp_path / "found" / "a.npz", masks=masks, boxes=[[0.0, 0, 5, 5]], names=np.array(["x"]), scores=[1.0])
    instances, generator = VLPartFiles(tmp_path / "found"), FileMasks(tmp_path / "masks")
    for read in (lambda: instances.find(view, image), lambda: generator.everything(view, image)):
        if fits:
            assert read().masks.shape == (1, rows, 32)
        else:
            with pytest.raises(InputError, match=f"32 x {rows}, not the shape of view a"):
                read()


def test_masks_of_instances_have_three_axes(tmp_path, view, image):
    arrays = {"boxes": [[0.0, 0, 5, 5]], "names": np.array(["x"]), "scores": [1.0]}
    np.savez(tmp_path / "a.npz", masks=np.ones((1, 48), bool), **arrays)
    with pytest.raises(InputError, match=r"a\.npz: expected masks \[K, h, w\], got \[1, 48\]"):
        VLPartFiles(tmp_path).find(view, image)


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_a_file_of_either_kind_is_enough(tmp_path, view, suffix):
    assert not VLPartFiles(tmp_path).has_map(view)
    (tmp_path / f"a{suffix}").touch()
    assert VLPartFiles(tmp_path).has_map(view)


ROWS = [
    {"box": [5, 10, 40, 30], "name": "dog:head", "score": 0.9},
    {"box": [1.5, 2, 60, 44], "name": "dog_tail", "score": 0.3},
]


def write_json(path, rows):
    path.write_text(json.dumps({"instances": rows}))


def test_vlpart_json(tmp_path, view, image):
    write_json(tmp_path / "a.json", ROWS)
    found = VLPartFiles(tmp_path).find(view, image)
    assert found.names == ("dog head", "dog tail")
    assert found.boxes.tolist() == [[5, 10, 40, 30], [1.5, 2, 60, 44]]
    assert found.scores.tolist() == pytest.approx([0.9, 0.3])
    assert found.masks is None
    assert VLPartFiles(tmp_path, least_score=0.5).find(view, image).names == ("dog head",)


def test_vlpart_masks(tmp_path, view, image):
    masked = [
        {**row, "mask": {"size": [48, 64], "counts": runs(mask)}} for row, mask in zip(ROWS, (MASK, ~MASK), strict=True)
    ]
    write_json(tmp_path / "a.json", masked)
    found = VLPartFiles(tmp_path, least_score=0.1).find(view, image)
    np.testing.assert_array_equal(found.masks, np.stack([MASK, ~MASK]))
    (tmp_path / "a.json").unlink()
    arrays = {"boxes": [row["box"] for row in ROWS], "names": [row["name"] for row in ROWS], "scores": [0.9, 0.3]}
    np.savez(tmp_path / "a.npz", masks=np.stack([MASK, ~MASK]), **arrays)
    other = VLPartFiles(tmp_path, least_score=0.1).find(view, image)
    assert other.names == found.names
    assert torch.equal(other.boxes, found.boxes)
    assert torch.equal(other.masks, found.masks)


def test_vlpart_finds_nothing(tmp_path, view, image):
    write_json(tmp_path / "a.json", [])
    assert VLPartFiles(tmp_path).find(view, image).boxes.shape == (0, 4)


def test_identity_is_the_files_content(tmp_path, view):
    write_json(tmp_path / "a.json", ROWS)
    source = VLPartFiles(tmp_path)
    before = source.identity_of(view)
    assert VLPartFiles(tmp_path).identity_of(view) == before
    write_json(tmp_path / "a.json", ROWS[:1])
    assert source.identity_of(view) != before


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is not valid JSON"),
        ("[]", r"expected \{\"instances\""),
        (json.dumps({"instances": [{"box": [0, 0, 1], "name": "a", "score": 1}]}), "an instance is damaged"),
        (json.dumps({"instances": [{"box": [0, 0, 1, 1], "score": 1}]}), "an instance is damaged .*name"),
        (json.dumps({"instances": [{"box": [5, 0, 1, 1], "name": "a", "score": 1}]}), "x1 < x2"),
        (json.dumps({"instances": [{"box": [0, 0, 1, 1], "name": " ", "score": 1}]}), "has no name"),
        (
            json.dumps(
                {"instances": [{"box": [0, 0, 1, 1], "name": "a", "score": 1, "mask": {"size": [2, 2], "counts": [3]}}]}
            ),
            "add up to 3, not 2 x 2",
        ),
        (
            json.dumps(
                {
                    "instances": [
                        {"box": [0, 0, 1, 1], "name": "a", "score": 1, "mask": {"size": [2, 2], "counts": "~~"}}
                    ]
                }
            ),
            "an instance is damaged",
        ),
        (
            json.dumps(
                {
                    "instances": [
                        {"box": [0, 0, 1, 1], "name": "a", "score": 1, "mask": {"size": [2, 9], "counts": [18]}}
                    ]
                }
            ),
            r"masks are 9 x 2, not the shape of view a \(64 x 48\)",
        ),
    ],
)
def test_damaged_instances(tmp_path, view, image, content, message):
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(InputError, match=message):
        VLPartFiles(tmp_path).find(view, image)


@pytest.mark.parametrize("name", ["boxes", "names", "scores"])
def test_arrays_of_instances_that_are_missing(tmp_path, view, image, name):
    arrays = {"boxes": np.array([[0.0, 0, 5, 5]]), "names": np.array(["a"]), "scores": np.array([1.0])}
    del arrays[name]
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError, match=rf"a\.npz: lacks the array {name}"):
        VLPartFiles(tmp_path).find(view, image)


@pytest.mark.parametrize("name", ["boxes", "names", "scores"])
def test_arrays_of_instances_that_are_odd(tmp_path, view, image, name):
    arrays = {"boxes": np.array([[0.0, 0, 5, 5]]), "names": np.array(["a"]), "scores": np.array([1.0])}
    odd = {"boxes": np.array([["x"] * 4]), "names": np.array(5), "scores": np.array(["x"])}
    np.savez(tmp_path / "a.npz", **{**arrays, name: odd[name]})
    message = {"names": r"names \[K\] must be texts"}.get(name, r"must be numbers")
    with pytest.raises(InputError, match=message):
        VLPartFiles(tmp_path).find(view, image)


def test_instances_of_which_some_have_masks(tmp_path, view, image):
    row = {"box": [0, 0, 1, 1], "name": "a", "score": 1}
    masked = {**row, "mask": {"size": [2, 2], "counts": [4]}}
    for rows, message in (
        ([row, masked], "1 of 2 instances have a mask"),
        ([masked, {**masked, "mask": {"size": [4, 4], "counts": [16]}}], "masks differ in size"),
    ):
        (tmp_path / "a.json").write_text(json.dumps({"instances": rows}))
        with pytest.raises(InputError, match=message):
            VLPartFiles(tmp_path).find(view, image)


def test_missing_instances(tmp_path, view, image):
    with pytest.raises(InputError, match="no such folder"):
        VLPartFiles(tmp_path / "none")
    source = VLPartFiles(tmp_path)
    assert not source.has_map(view)
    with pytest.raises(MissingMap, match=r"holds no a\.json or a\.npz"):
        source.find(view, image)
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 and so on")
    with pytest.raises(InputError, match=r"a\.npz: is no archive, or is damaged"):
        source.find(view, image)
    np.savez(tmp_path / "a.npz", boxes=np.zeros((1, 4)))
    with pytest.raises(InputError, match="lacks the array names"):
        source.find(view, image)


def test_names_as_one_says_them():
    assert plain_name("office_chair:left_arm") == "office chair left arm"


def test_masks_of_label_images(tmp_path, view, image):
    ids = np.zeros((24, 32), np.uint8)
    ids[2:8, 3:9], ids[10:20, 10:30] = 7, 3
    cv2.imwrite(str(tmp_path / "a.png"), ids)
    found = FileMasks(tmp_path).everything(view, image)
    np.testing.assert_array_equal(found.masks, np.stack([ids == 3, ids == 7]))
    assert found.ranks.tolist() == [UNRANKED] * 2
    assert found.scores.tolist() == [1.0, 1.0]


def test_stacks_of_masks(tmp_path, view, image):
    np.savez(tmp_path / "a.npz", masks=np.stack([MASK, ~MASK]), scores=[0.5, 0.25], ranks=[2, 0])
    found = FileMasks(tmp_path).everything(view, image)
    np.testing.assert_array_equal(found.masks, np.stack([MASK, ~MASK]))
    assert (found.scores.tolist(), found.ranks.tolist()) == ([0.5, 0.25], [2, 0])
    before = FileMasks(tmp_path).identity_of(view)
    np.savez(tmp_path / "a.npz", masks=MASK[None])
    assert FileMasks(tmp_path).identity_of(view) != before
    with pytest.raises(InputError, match="cannot be asked for the mask of a box"):
        FileMasks(tmp_path).in_boxes(image, torch.zeros(1, 4))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"other": np.zeros(3)}, r"expected an array masks \[M, h, w\]"),
        ({"masks": np.zeros((2, 48, 64)), "scores": np.zeros(3)}, "expected 2 scores and ranks"),
        ({"masks": np.zeros((2, 48, 48))}, r"is 48 x 48, not the shape of view a \(64 x 48\)"),
    ],
)
def test_stacks_that_do_not_fit(tmp_path, view, image, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError, match=message):
        FileMasks(tmp_path).everything(view, image)


def test_missing_masks(tmp_path, view, image):
    with pytest.raises(InputError, match="no such folder"):
        FileMasks(tmp_path / "none")
    with pytest.raises(MissingMap):
        FileMasks(tmp_path).everything(view, image)
    (tmp_path / "a.npz").write_bytes(b"PK\x03\x04 and so on")
    with pytest.raises(InputError, match=r"a\.npz: is no archive, or is damaged"):
        FileMasks(tmp_path).everything(view, image)


def test_feature_3dgs(tmp_path, tools):
    view = tools.make_view(40, 40)
    features = torch.randn(20, 20, 20).half()
    torch.save(features, tmp_path / "a_fmap_CxHxW.pt")
    source = FileMaps(tmp_path, [view])
    assert torch.equal(source.encode(view).dense, features.permute(1, 2, 0))  # square: only the name tells the layout
    assert source.space == "files:20"
