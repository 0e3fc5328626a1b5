"""A real browser, with GL in software: it connects, asks, clicks, deletes, undoes and saves.

Runs where Debian's chromium and Playwright are installed (`apt-get install chromium`), and says so where not.
"""

import shutil
import time

import numpy as np
import pytest
import torch

from sgwarp.apps.editing.script import load_script
from sgwarp.io.scenes import load_gaussians
from sgwarp.viewer.server import Address, Viewer
from sgwarp.viewer.workbench import Materials, Workbench

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytest.importorskip("viser")
playwright = pytest.importorskip("playwright.sync_api")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium here: apt-get install chromium"),
    pytest.mark.filterwarnings("default"),
]
SOFTWARE_GL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")
PATIENCE = 60  # seconds


@pytest.fixture(scope="module")
def viewer(stage, toy_semantics, toy_text, instances):
    given = Materials(stage.gaussians, toy_semantics, None, toy_text, None, instances, stage.views)
    assert len(stage.gaussians) <= 5000
    viewer = Viewer(Workbench(given), Address(port=0))
    yield viewer
    viewer.close()


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE_GL))
        yield browser
        browser.close()


def until(ready, what: str):
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = ready()
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError(f"in vain waited for {what}")


class Page:
    """A tab and its state on the server."""

    def __init__(self, browser, viewer: Viewer) -> None:
        before = set(viewer.tabs)
        self.page = browser.new_page(viewport={"width": 760, "height": 480}, accept_downloads=True)
        self.page.goto(f"{viewer.url}?fixedDpr=1")  # else the page draws at a lower resolution where it is slow
        self.page.add_style_tag(content=".mantine-Notifications-root { display: none }")  # they lie over the canvas
        self.session = until(lambda: next(iter(set(viewer.tabs) - before), None), "the tab")
        first = viewer.bench.materials.views[0].camera.position
        until(lambda: float((self.session.tab.camera.position - first).norm()) < 1e-3, "the first camera")
        self.settle()

    def settle(self) -> None:
        """Wait for the full picture of what is wanted."""
        stream = self.session.stream
        until(lambda: stream.state == "done" and stream.drawn == stream.wanted, "the full picture")

    def canvas(self):
        box = self.page.locator("canvas").first.bounding_box()
        return box["x"], box["y"], box["width"], box["height"]

    def pixels(self) -> np.ndarray:
        """The canvas as it is shown, uint8 [H, W, 3]."""
        import cv2

        x, y, width, height = self.canvas()
        data = self.page.screenshot(clip={"x": x, "y": y, "width": width, "height": height})
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)

    def still(self) -> np.ndarray:
        """The canvas once two looks at it are the same."""
        self.settle()
        looks = [self.pixels()]

        def same() -> bool:
            self.page.wait_for_timeout(400)
            looks.append(self.pixels())
            return looks[-1].shape == looks[-2].shape and np.abs(looks[-1] - looks[-2]).mean() < 0.2

        until(same, "the canvas to come to rest")
        return looks[-1]

    def shows(self, other: np.ndarray, least: float, most: float, what: str) -> None:
        """Wait until the mean difference from another picture lies between these."""
        until(lambda: least <= np.abs(self.pixels() - other).mean() <= most, what)

    def type_into(self, label: str, text: str) -> None:
        path = f"//label[normalize-space()='{label}']/ancestor::*[.//input][1]//input"
        self.page.locator(f"xpath={path}").first.fill(text)

    def press(self, label: str) -> None:
        self.page.get_by_role("button", name=label, exact=True).click()

    def click(self, place) -> None:
        """At a place of the picture, from 0 to 1 on either side."""
        x, y, width, height = self.canvas()
        self.page.mouse.click(x + place[0] * width, y + place[1] * height)

    def place_of(self, point) -> tuple[float, float]:
        camera = self.session.tab.camera
        at = camera.K @ (camera.world_to_camera @ torch.tensor([*point, 1.0], dtype=torch.float64))[:3]
        return float(at[0] / at[2]) / camera.width, float(at[1] / at[2]) / camera.height

    def download(self, label: str) -> bytes:
        with self.page.expect_download(timeout=1000 * PATIENCE) as waiting:
            self.press(label)
        return waiting.value.path().read_bytes()


@pytest.fixture
def page(browser, viewer):
    page = Page(browser, viewer)
    yield page
    page.page.close()
    until(lambda: page.session not in viewer.tabs, "the tab to close")


def test_the_way_from_a_question_to_a_file(page, viewer, stage, tmp_path):
    """Connect, type, see pixels change, click at the object, delete it, undo, delete again, save."""
    tab = page.session.tab
    plain = page.still()
    assert plain.std() > 20, "a picture is shown"
    page.type_into("Query", "lamp; book")
    until(lambda: tab.answers is not None, "the answers")
    page.shows(plain, 10, 255, "the answer to be seen")
    page.type_into("Query", "")
    until(lambda: tab.answers is None, "the question to be forgotten")
    page.shows(plain, 0, 0.2, "the colors again")

    page.click(page.place_of((0.55, -0.2, 3.2)))
    found = until(lambda: tab.found, "the object")
    assert (found.instance, found.words[0][0]) == (7, "lamp")
    page.page.get_by_text("object 7: lamp").wait_for(timeout=1000 * PATIENCE)

    page.press("Delete")
    until(lambda: len(viewer.bench.state.gaussians) < len(stage.gaussians), "the deletion")
    page.shows(plain, 1, 255, "the hole")
    page.press("Undo")
    until(lambda: len(viewer.bench.state.gaussians) == len(stage.gaussians), "the undoing")
    page.shows(plain, 0, 0.2, "the lamp again")
    page.press("Redo")
    until(lambda: len(viewer.bench.state.gaussians) < len(stage.gaussians), "the deletion")

    page.page.get_by_text("Save", exact=True).click()
    scene, script = tmp_path / "scene.ply", tmp_path / "edits.json"
    scene.write_bytes(page.download("Scene (PLY)"))
    script.write_bytes(page.download("Edits (JSON)"))
    assert len(load_gaussians(scene)) == int((stage.classes != 3).sum())
    assert [step.selection.select for step in load_script(script, stage.gaussians)] == [("id:7",)]
    viewer.bench.undo()


def test_a_drag_moves_the_camera_and_a_rectangle_selects(page, stage):
    stream, tab = page.session.stream, page.session.tab
    before, moving = tab.camera.position, stream.pictures["moving"]
    x, y, width, height = page.canvas()
    mouse = page.page.mouse
    mouse.move(x + 0.5 * width, y + 0.6 * height)
    mouse.down()
    for step in range(12):
        mouse.move(x + (0.5 + 0.01 * step) * width, y + 0.6 * height)
        page.page.wait_for_timeout(30)
    mouse.up()
    page.settle()
    assert float((tab.camera.position - before).norm()) > 0.05
    assert stream.pictures["moving"] > moving

    left, top = page.place_of((0.3, 0.4, 2.7))
    right, bottom = page.place_of((1.1, 0.9, 2.7))
    page.page.keyboard.down("Shift")
    mouse.move(x + left * width, y + top * height)
    mouse.down()
    mouse.move(x + right * width, y + bottom * height, steps=4)
    mouse.up()
    page.page.keyboard.up("Shift")
    found = until(lambda: tab.found, "the selection")
    chosen = stage.classes[found.selected]
    assert (chosen == 4).float().mean() > 0.9
    assert int((chosen == 4).sum()) > 0.5 * int((stage.classes == 4).sum())


def test_two_tabs_have_their_own_cameras_and_share_edits(browser, page, viewer, stage):
    other = Page(browser, viewer)
    try:
        here = other.session.tab.camera.position
        other.session.aim(stage.views[5].stem)
        until(lambda: float((other.session.tab.camera.position - here).norm()) > 0.1, "the other camera")
        assert float((page.session.tab.camera.position - here).norm()) < 1e-3
        page.click(page.place_of((0.55, -0.2, 3.2)))
        until(lambda: page.session.tab.found, "the object")
        before = other.still()
        page.press("Delete")
        until(lambda: len(viewer.bench.state.gaussians) < len(stage.gaussians), "the deletion")
        other.shows(before, 0.5, 255, "the hole in the other tab")
        viewer.bench.undo()
    finally:
        other.page.close()


def test_the_browser_draws_splats_that_look_like_our_pictures(page):
    server = page.still()
    page.page.get_by_label("Splats in the browser").check()
    until(lambda: page.session.stream.paused, "the splats")
    page.shows(server, 0.5, 30, "splats that look like it")
    page.page.get_by_label("Splats in the browser").uncheck()
    until(lambda: not page.session.stream.paused, "the pictures")
    page.shows(server, 0, 0.2, "the picture again")


def test_keys_edit_but_not_while_a_query_is_typed(page, viewer, stage):
    tab, count = page.session.tab, len(stage.gaussians)
    page.click(page.place_of((0.55, -0.2, 3.2)))
    until(lambda: tab.found, "the object")
    box = page.page.locator("xpath=//label[normalize-space()='Query']/ancestor::*[.//input][1]//input").first
    box.press_sequentially("rhnD")
    until(lambda: tab.answers is not None, "the answers")
    assert tab.found is not None
    assert not viewer.bench.session.steps
    box.blur()
    page.page.keyboard.press("Shift+D")
    until(lambda: len(viewer.bench.state.gaussians) < count, "the deletion")
    page.page.keyboard.press("Control+z")
    until(lambda: len(viewer.bench.state.gaussians) == count, "the undoing")
