"""What DEVA writes: ids at every pixel and the list of segments; made here by hand."""

import json

import cv2
import numpy as np
import pytest

from sgwarp.encoders.maps.deva import DevaMaps, read_predictions
from sgwarp.encoders.registry import make_encoder
from sgwarp.errors import InputError


@pytest.fixture
def deva(tmp_path):
    """Two frames of a video with long ids; a third view has none."""
    pictures = tmp_path / "Annotations"
    pictures.mkdir()
    ids = np.zeros((48, 64), np.int64)
    ids[5:20, 5:20], ids[25:40, 30:60] = 70000, 513
    frames = []
    for stem in ("a", "b"):
        shown = ids if stem == "a" else np.where(ids == 513, 0, ids)
        cv2.imwrite(
            str(pictures / f"{stem}.png"), np.stack([shown >> 16, shown >> 8 & 255, shown & 255], -1).astype(np.uint8)
        )
        segments = [{"id": int(k), "category_id": 1, "score": 0.9 if k == 513 else 0.4} for k in np.unique(shown) if k]
        frames.append({"file_name": f"{stem}.jpg", "segments_info": segments})
    (tmp_path / "pred.json").write_text(json.dumps({"annotations": frames}))
    return tmp_path, ids


def test_deva(deva, tools):
    folder, ids = deva
    views = [tools.make_view(stem=stem) for stem in "abc"]
    source = DevaMaps(folder, views)
    found = source.encode(views[0])
    assert (found.space, found.labels) == ("labels", ("513", "70000"))
    wanted = np.select([ids == 513, ids == 70000], [0, 1], -1)
    np.testing.assert_array_equal(found.ids[0], wanted)
    assert source.encode(views[1]).ids.unique().tolist() == [-1, 1]
    assert not source.has_map(views[2])
    sure = DevaMaps(folder, views, least_score=0.5).encode(views[0])
    np.testing.assert_array_equal(sure.ids[0], np.where(wanted == 1, -1, wanted))


def test_segments_of_just_the_least_score_are_kept(deva, tools):
    folder, ids = deva
    view = tools.make_view()
    wanted = np.select([ids == 513, ids == 70000], [0, 1], -1)
    for least, shown in (
        ("0.4", wanted),
        ("0.9", np.where(wanted == 1, -1, wanted)),
        ("0.95", np.full_like(wanted, -1)),
    ):
        found = make_encoder(f"deva:{folder}?least_score={least}", [view]).encode(view, None)
        np.testing.assert_array_equal(found.ids[0], shown)


def test_segments_without_a_score_are_sure(tmp_path):
    frames = [{"file_name": "x/a.jpg", "segments_info": [{"id": 3}, {"id": "4", "score": 0.25}]}]
    (tmp_path / "pred.json").write_text(json.dumps({"annotations": frames}))
    assert read_predictions(tmp_path / "pred.json") == {"a": {3: 1.0, 4: 0.25}}


@pytest.mark.parametrize("deeper", [False, True])
def test_other_things_beside_devas_pictures(deva, tools, deeper):
    """A file beside the folder of a video, or a folder beside the pictures, is not meant."""
    folder, _ = deva
    pictures, view = folder / "Annotations", tools.make_view()
    (pictures / "shown").mkdir()
    if deeper:
        for path in pictures.glob("*.png"):
            path.rename(pictures / "shown" / path.name)
        (pictures / "notes.txt").touch()
    found = DevaMaps(folder, [view])
    assert found.folder == (pictures / "shown" if deeper else pictures)
    assert found.encode(view).ids.unique().tolist() == [-1, 0, 1]


def test_deva_with_a_folder_per_video(deva, tools):
    folder, _ = deva
    inner = folder / "Annotations" / "video"
    inner.mkdir()
    for path in (folder / "Annotations").glob("*.png"):
        path.rename(inner / path.name)
    view = tools.make_view()
    assert DevaMaps(folder, [view]).encode(view).ids.unique().tolist() == [-1, 0, 1]


def test_deva_says_what_does_not_fit(deva, tools, tmp_path_factory):
    folder, _ = deva
    view = tools.make_view()
    content = json.loads((folder / "pred.json").read_text())
    content["annotations"][0]["segments_info"].pop()
    (folder / "pred.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"pred\.json: lists no segment \d+ in frame a, which shows it"):
        DevaMaps(folder, [view]).encode(view)
    (folder / "pred.json").write_text(json.dumps({"annotations": []}))
    with pytest.raises(InputError, match=r"pred\.json: lists no frame a"):
        DevaMaps(folder, [view]).encode(view)
    (folder / "pred.json").write_text("{}")
    with pytest.raises(InputError, match=r"is not the pred\.json of DEVA"):
        DevaMaps(folder, [view])
    with pytest.raises(InputError, match="has no folder Annotations"):
        DevaMaps(tmp_path_factory.mktemp("empty"), [view])
