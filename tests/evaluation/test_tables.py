"""Tables as text, and the file of published figures."""

import json

import pytest

from sgwarp.errors import InputError
from sgwarp.evaluation.evaluator import Evaluation
from sgwarp.evaluation.methods import METHOD_KINDS, Method, find_method, list_methods
from sgwarp.evaluation.profiles.catalogue import PLACES, find_profile
from sgwarp.evaluation.published import FILE, find_published
from sgwarp.evaluation.report_files import headline
from sgwarp.evaluation.results import SceneResult
from sgwarp.evaluation.settings import Settings
from sgwarp.evaluation.tables import Table, number, percent, seconds_of, size


def test_markdown_and_latex():
    table = Table("T", ["a_b", "n", "w"], [["x|y", "1", "50 %"], ["z", "–", "&"]], frozenset({"w"}), frozenset({0}))
    assert table.markdown().splitlines()[2:] == [
        "| a_b | n | w |",
        "| --- | ---: | --- |",
        r"| x\|y | 1 | 50 % |",
        "| z | – | & |",
    ]
    assert table.latex().splitlines() == [
        "% T",
        r"\begin{tabular}{lrl}",
        r"\toprule",
        r"a\_b & n & w \\",
        r"\midrule",
        r"x|y & 1 & 50 \% \\",
        r"\midrule",
        r"z & -- & \& \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_cells():
    assert (percent(0.6104), percent(float("nan")), percent(None)) == ("61.0", "–", "–")
    assert (number(0.01234), number(64.0), seconds_of(3.14159), seconds_of(61.2)) == ("0.0123", "64", "3.14", "61")
    assert (size(0), size(2.5e8), size(3.456e9)) == ("–", "250 MB", "3.46 GB")


def test_published_figures_have_sources_and_are_shares():
    content = json.loads(FILE.read_text())
    assert set(content["profiles"]) >= set(PLACES)
    for profile in content["profiles"]:
        for row in find_published(profile):
            assert row.source
            assert row.figures
            assert all(0 < value < 1 for value in (*row.figures.values(), *row.scenes.values())), row.system
    paper = {row.system: row for row in find_published("scannet12-2d")}
    assert paper["Semantic Gaussians 2D+3D"].figures == {"miou": pytest.approx(0.62), "macc": pytest.approx(0.77)}
    wanted = {
        "Mask2Former",
        "DM-NeRF",
        "SemanticNeRF",
        "Panoptic Lifting",
        "OpenSeg",
        "LSeg",
        "LERF",
        "PVLFF",
        "LangSplat",
        "Feature 3DGS",
    }
    assert wanted <= set(paper)
    assert paper["SAS"].second_hand


def test_means_of_published_scenes_are_the_published_means():
    """Means over scenes, as the headline says; LERF's row of the paper is macro, too."""
    for row in find_published("lerf-ovs-loc"):
        if row.scenes:
            assert sum(row.scenes.values()) / 4 == pytest.approx(row.figures["located"], abs=6e-4), row.system


def test_every_profile_can_be_made_and_names_published_figures():
    for name in PLACES:
        profile = find_profile(name)
        assert profile.name == name
        assert profile.headline
        assert profile.differences
        for row in find_published(name):
            assert set(row.figures) & {*profile.headline, *(f"micro_{one}" for one in profile.headline)} or row.kind
    with pytest.raises(InputError, match="does not exist"):
        find_profile("imagenet")


@pytest.mark.parametrize("profile", ["lerf-ovs-3d", "scannet-3d"])
def test_stated_times_stand_under_lifting(profile):
    protocol = find_profile(profile)
    result = SceneResult("attic", seconds={"lift": 2.0, "query": 0.5, "read": 9.0}, peak_memory=2_000_000_000)
    table = headline(Evaluation(protocol, Settings(), [result]))
    assert table.columns[-5:] == ["lifting [s]", "asking [s]", "memory", "B/Gaussian", "source"]
    assert table.rows[0][-5:] == ["2.00", "0.50", "2.00 GB", "0", "this run"]
    published = find_published(profile)
    assert any(row.seconds for row in published)
    for row, cells in zip(published, table.rows[1:], strict=True):
        assert len(cells) == len(table.columns)
        assert cells[-5:-1] == [row.seconds or "–", "–", "–", "–"]


def test_methods():
    names = [method.name for method in list_methods()]
    assert len(set(names)) == len(names)
    assert {"weighted", "center", "2d"} <= set(names)
    assert all(method.about and method.kind in METHOD_KINDS for method in list_methods())
    for method in list_methods():
        if method.kind != "images":
            assert callable(method.lifting())
    with pytest.raises(InputError, match="lifts nothing"):
        find_method("2d").lifting()
    with pytest.raises(InputError, match="does not exist"):
        find_method("magic")
    assert Method("x", "y", make="math:sqrt").kind == "rival"


def test_the_command_offers_every_profile():
    from typing import get_args, get_type_hints

    from sgwarp.commands.evaluate import Evaluate

    assert get_args(get_args(get_type_hints(Evaluate, include_extras=True)["profile"])[0]) == tuple(PLACES)


def test_an_output_that_cannot_be_is_refused_before_the_data_is_read(tmp_path, capsys):
    from sgwarp.cli import main

    (tmp_path / "file").write_text("")
    assert main(["evaluate", "room", "--data", str(tmp_path / "nowhere"), "--out", str(tmp_path / "file")]) == 2
    assert "--out" in capsys.readouterr().err
