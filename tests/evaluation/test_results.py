"""Records of scenes come back from their files as they were."""

import json
import math

from sgwarp.evaluation.results import SceneResult, read_result, write_result


def test_what_is_not_a_number_comes_back_as_such(tmp_path):
    path = tmp_path / "result.json"
    per_class = {"cup": {"iou": 0.5, "accuracy": math.nan}}
    result = SceneResult("attic", {"miou": math.nan, "macc": 0.25}, {"located": [1.0, math.nan]}, per_class)
    write_result(path, result, {"seed": 1})
    assert json.loads(path.read_text())["result"]["figures"] == {"miou": None, "macc": 0.25}
    back = read_result(path, {"seed": 1})
    assert math.isnan(back.figures["miou"])
    assert back.figures["macc"] == 0.25
    assert back.values["located"][0] == 1.0
    assert math.isnan(back.values["located"][1])
    assert back.per_class["cup"]["iou"] == 0.5
    assert math.isnan(back.per_class["cup"]["accuracy"])
    assert read_result(path, {"seed": 2}) is None
