"""A tab's connection without a browser: what its page is sent, where its camera goes, what stands at the top."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from sgwarp.apps.editing.operations import Remove
from sgwarp.errors import InputError
from sgwarp.scene import Camera, View
from sgwarp.viewer import screen as screen_module
from sgwarp.viewer import server
from sgwarp.viewer.modes import HIGHLIGHT, Drawn, Shot
from sgwarp.viewer.screen import FARTHEST, Canvas
from sgwarp.viewer.server import Address, Session, Viewer
from sgwarp.viewer.streaming import Streamer
from sgwarp.viewer.tab import Tab


class Handle(SimpleNamespace):
    """Something in the page's scene."""

    def remove(self):
        self.there = False


class PageScene:
    def __init__(self):
        self.behind, self.frustums, self.splats, self.handlers, self.up = [], [], [], {}, None

    def set_background_image(self, pixels, **options):
        self.behind.append((pixels, options))

    def add_camera_frustum(self, name, **options):
        self.frustums.append(Handle(name=name, there=True, **options))
        return self.frustums[-1]

    def add_gaussian_splats(self, name, *parts):
        self.splats.append(Handle(name=name, there=True, parts=parts))
        self.splats[-1].set_gaussians = lambda *new: setattr(self.splats[-1], "parts", new)
        return self.splats[-1]

    def on_click(self):
        return lambda work: self.handlers.update(click=work)

    def on_rect_select(self, modifier):
        return lambda work: self.handlers.update({f"rectangle with {modifier}": work})

    def set_up_direction(self, up):
        self.up = up


class PageCamera(SimpleNamespace):
    def on_update(self, work):
        self.listener = work


class Client:
    """In place of one of viser's."""

    def __init__(self):
        self.scene, self.flushed, self.told = PageScene(), 0, []
        self.camera = PageCamera(
            wxyz=(1.0, 0.0, 0.0, 0.0), position=(0.0, 0.0, 0.0), fov=0.9, image_width=640, image_height=480
        )
        buffer = SimpleNamespace(message_from_id={})
        self._websock_connection = SimpleNamespace(get_message_buffer=lambda: buffer)

    def flush(self):
        self.flushed += 1

    def atomic(self):
        return nullcontext()


class Panel:
    """Takes note of what it is given."""

    def __init__(self, client, tab, *calls):
        self.calls, self.heard = calls, []

    def tell(self, message, wrong=False):
        self.heard.append(("tell", message, wrong))

    def set_status(self, text):
        self.heard.append(("status", text))

    def click(self, *place):
        self.heard.append(("click", *place))

    def rectangle(self, *corners):
        self.heard.append(("rectangle", *corners))

    def close(self):
        self.heard.append(("closed",))


@pytest.fixture
def views(stage):
    return stage.views[:3]


@pytest.fixture
def viewer(bench, views):
    """What a session needs of one; nothing listens at a port."""
    made = SimpleNamespace(bench=bench, streamer=Streamer(), _views=list(views), up=(0.0, 0.6, 0.8))
    made._target = lambda view: Viewer._target(made, view)
    return made


@pytest.fixture
def session(viewer, monkeypatch):
    monkeypatch.setattr(server, "Panel", Panel)
    return Session(viewer, Client())


def test_the_panel_is_given_what_it_calls(session):
    assert session.panel.calls == (session.changed, session.draw_splats, session.aim, session.show_cameras)
    assert session.viewer.streamer._streams == [session.stream]
    assert session.stream.shot == session.tab.shot


def test_the_camera_of_the_page_is_taken(session, bench):
    near, far = bench.depth_range()
    camera = session.tab.camera
    assert (camera.size, camera.near, camera.far) == ((480, 640), near, far)
    assert float(camera.K[1, 1]) == pytest.approx(240 / math.tan(0.45))
    page = session.client.camera
    page.position, page.wxyz, page.image_width = (1.0, 2.0, 3.0), (0.0, 1.0, 0.0, 0.0), 320
    session.stream.wanted = 0
    session.moved()
    assert session.tab.camera.position.tolist() == [1.0, 2.0, 3.0]
    assert session.tab.camera.size == (480, 320)
    assert session.stream.camera is session.tab.camera
    assert session.stream.wanted == 1
    before = session.tab.camera
    page.fov = float("nan")
    session.moved()
    assert session.tab.camera is before, "one out of bounds is left out"
    assert session.stream.wanted == 1


def test_clicks_and_rectangles_go_to_the_panel(session):
    handlers = session.client.scene.handlers
    handlers["click"](SimpleNamespace(screen_pos=(0.1, 0.2)))
    handlers["rectangle with shift"](SimpleNamespace(screen_min=(0.1, 0.2), screen_max=(0.3, 0.4)))
    assert session.panel.heard == [("click", (0.1, 0.2)), ("rectangle", (0.1, 0.2), (0.3, 0.4))]


def field_of_view(view: View) -> float:
    """Angle between the rays to the upper and lower edge of the image, if its center is in the middle."""
    return 2 * math.atan2(view.camera.height / 2, float(view.camera.K[1, 1]))


def test_a_view_that_is_chosen_is_looked_from(session, views):
    page = session.client.camera
    for view in views[1:]:
        session.aim(view.stem)
        pose = view.camera.world_to_camera
        assert page.position == pytest.approx(view.camera.position.tolist())
        assert page.up_direction == pytest.approx((-pose[1, :3]).tolist())
        assert page.fov == pytest.approx(field_of_view(view))
        ahead = torch.tensor(page.look_at).double() - view.camera.position
        forward = torch.nn.functional.normalize(ahead, dim=0)
        torch.testing.assert_close(forward, pose[2, :3].double(), rtol=0, atol=1e-6)
    session.aim("")
    assert page.position == pytest.approx(views[0].camera.position.tolist())
    assert page.up_direction == (0.0, 0.6, 0.8), "as the page began"
    with pytest.raises(InputError, match="view 'nowhere': there is no such view"):
        session.aim("nowhere")


def test_the_views_cameras_stand_where_they_are(session, monkeypatch, bench):
    from sgwarp.scene.extent import camera_extent

    monkeypatch.setattr(server, "MOST_CAMERAS", 2)
    session.show_cameras(True)
    shown, known = session.client.scene.frustums, bench.materials.views[:2]
    assert [one.name for one in shown] == [f"/cameras/{view.stem}" for view in known]
    for one, view in zip(shown, known, strict=True):
        camera = view.camera
        w, x, y, z = one.wxyz
        third = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # where its z axis points
        np.testing.assert_allclose(third, camera.world_to_camera[2, :3].numpy(), atol=1e-6)
        np.testing.assert_allclose(one.position, camera.position.numpy())
        assert one.aspect == pytest.approx(96 / 72)
        assert one.fov == pytest.approx(field_of_view(view))
        assert one.scale == pytest.approx(0.05 * camera_extent(known))
        assert one.color == HIGHLIGHT
    session.show_cameras(True)
    assert [one.there for one in shown] == [False, False, True, True]
    session.show_cameras(False)
    assert not any(one.there for one in shown)


def test_the_browser_draws_splats_until_it_is_told_otherwise(session, stage):
    scene = session.client.scene
    session.follow()
    assert not scene.splats, "pictures are drawn here"
    session.draw_splats(True)
    assert session.stream.paused
    assert len(scene.splats) == 1
    whole = len(scene.splats[0].parts[0])
    session.viewer.bench.apply("rows:0-9", Remove())
    session.changed()
    assert len(scene.splats) == 1, "they are replaced"
    assert len(scene.splats[0].parts[0]) == whole - 10
    session.tab.set_mode("depth")
    session.follow()
    assert session.panel.heard[-1][0] == "tell"
    assert session.panel.heard[-1][2] is True
    session.tab.set_mode("color")
    session.draw_splats(False)
    assert not scene.splats[0].there
    assert not session.stream.paused
    session.draw_splats(True)
    assert len(scene.splats) == 2


def test_the_line_at_the_top_says_how_many_and_how_fast(session, stage):
    count = f"{len(stage.gaussians):,} Gaussians"
    session.canvas.size = (480, 640)
    for state, words in (("moving", "0 pictures/s"), ("still", "drawing"), ("done", "still")):
        session.stream.state = state
        session.report()
        assert session.panel.heard[-1] == ("status", f"{count}, 640 x 480, {words}")
    session.stream.paused = True
    session.report()
    assert session.panel.heard[-1] == ("status", f"{count}, drawn by the browser without harmonics")


def test_a_tab_that_is_gone_is_drawn_no_more(session):
    session.close()
    assert session.panel.heard == [("closed",)]
    assert session.viewer.streamer._streams == []


def test_what_a_picture_complains_of_is_told_as_a_fault(session):
    session.canvas.complain("no room")
    assert session.panel.heard == [("tell", "no room", True)]


# The canvas


def test_a_picture_is_sent_with_its_depth_and_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(screen_module.time, "monotonic", lambda: now[0])
    client = Client()
    canvas = Canvas(client, print)
    depth = np.array([[1.0, 0.0, np.nan], [np.inf, 500.0, 2.0]], np.float32)
    pixels = np.zeros((2, 3, 3), np.uint8)
    canvas.show(Drawn(pixels, depth), final=True)
    sent, options = client.scene.behind[-1]
    assert sent is pixels
    assert options["format"] == "jpeg"
    np.testing.assert_allclose(options["depth"], [[1.0, FARTHEST, FARTHEST], [FARTHEST, FARTHEST, 2.0]])
    assert (canvas.size, canvas.sent, client.flushed) == ((2, 3), 1, 1)
    canvas.show(Drawn(pixels), final=False)
    assert client.scene.behind[-1][1]["depth"] is None
    assert canvas.rate == pytest.approx(1.0), "two in two seconds"
    now[0] += 1.9
    canvas.show(Drawn(pixels), final=False)
    assert canvas.rate == pytest.approx(1.5)
    now[0] += 0.2
    assert canvas.rate == pytest.approx(0.5), "the first two are longer ago"


def test_splats_have_the_background_of_the_shot_behind_them(stage):
    client = Client()
    Canvas(client, print).show_splats(Shot(stage.gaussians, background=(0.2, 0.5, 1.0)))
    pixel, options = client.scene.behind[-1]
    assert (pixel.tolist(), pixel.dtype, options) == ([[[51, 128, 255]]], np.uint8, {"format": "png"})
    means, covariances, colors, opacities = client.scene.splats[0].parts
    torch.testing.assert_close(torch.from_numpy(means), stage.gaussians.means)
    assert covariances.shape == (len(means), 3, 3)
    assert colors.shape == (len(means), 3)
    torch.testing.assert_close(torch.from_numpy(opacities[:, 0]), stage.gaussians.opacities)


# The page before anybody looks


def turned(up, place) -> View:
    """A view whose image is upright for that direction, looking along x or z."""
    down = -torch.tensor(up, dtype=torch.float64)
    ahead = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ahead = torch.nn.functional.normalize(ahead - (ahead @ down) * down, dim=0)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.stack([torch.linalg.cross(down, ahead), down, ahead])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(place, dtype=torch.float64)
    K = torch.tensor([[50.0, 0, 20], [0, 40.0, 15], [0, 0, 1]], dtype=torch.float64)
    return View("a", Camera(K, pose, 40, 30))


def dressed(views, bench):
    calls = SimpleNamespace(theme=None, docked=0)
    gui = SimpleNamespace(
        configure_theme=lambda **given: setattr(calls, "theme", given),
        main_panel=SimpleNamespace(dock_right=lambda: setattr(calls, "docked", 1)),
    )
    viser = SimpleNamespace(gui=gui, scene=PageScene(), initial_camera=SimpleNamespace())
    made = SimpleNamespace(server=viser, _views=views, bench=bench)
    made._target = lambda view: Viewer._target(made, view)
    Viewer._dress(made)
    return made, calls


def test_the_page_begins_at_the_first_view_and_upright(bench):
    views = [turned(up, (1.0, 2.0, 3.0 + k)) for k, up in enumerate(((0.6, 0.8, 0.0), (-0.6, 0.8, 0.0)))]
    made, calls = dressed(views, bench)
    assert made.up == pytest.approx((0.0, 1.0, 0.0)), "the mean of all views"
    assert made.server.scene.up == made.up
    start = made.server.initial_camera
    assert start.up == made.up
    assert start.position == pytest.approx((1.0, 2.0, 3.0))
    assert start.look_at == pytest.approx(tuple(Viewer._target(made, views[0]).tolist()))
    assert start.fov == pytest.approx(2 * math.atan(15 / 40))
    assert calls.theme["dark_mode"] is True
    assert calls.theme["show_share_button"] is False
    assert calls.docked == 1


def test_views_that_agree_on_no_up_leave_it_to_the_first(bench):
    made, _ = dressed([turned((0.0, 1.0, 0.0), (0, 0, 0)), turned((0.0, -1.0, 0.0), (0, 0, 0))], bench)
    assert made.up == pytest.approx((0.0, 1.0, 0.0))


@pytest.mark.parametrize(
    ("host", "token", "url"),
    [
        ("127.0.0.1", None, "http://127.0.0.1:81/"),
        ("0.0.0.0", "abc", "http://127.0.0.1:81/?token=abc"),
        ("::", "abc", "http://127.0.0.1:81/?token=abc"),
        ("10.0.0.7", "abc", "http://10.0.0.7:81/?token=abc"),
    ],
)
def test_the_address_that_is_printed_can_be_opened(host, token, url):
    assert Viewer.url.fget(SimpleNamespace(address=Address(host, 80, token), port=81)) == url


@pytest.mark.parametrize(("host", "open_to_others"), [("127.0.0.1", False), ("localhost", False), ("10.0.0.7", True)])
def test_an_address_for_others_has_a_token(host, open_to_others):
    address = Address.of(host, 81)
    assert (address.host, address.port) == (host, 81)
    assert (address.token is not None) == open_to_others
    assert address.token != Address.of(host, 81).token or not open_to_others


def test_every_tab_hears_of_a_change(session, bench):
    heard = []
    others = [
        SimpleNamespace(follow=lambda k=k: heard.append(k), panel=SimpleNamespace(refresh=lambda k=k: heard.append(-k)))
        for k in (1, 2)
    ]
    streamer = SimpleNamespace(change=lambda: heard.append("pictures"))
    Viewer._changed(SimpleNamespace(streamer=streamer, tabs=others))
    assert heard == ["pictures", 1, -1, 2, -2]


def test_a_tab_begins_like_every_other(bench):
    look = Tab(bench).look
    assert (look.mode, look.threshold, look.strength, look.moment, look.level) == ("color", 0.5, 0.7, 0, "")
    assert (look.background, look.through, look.cameras) == ((0.0, 0.0, 0.0), False, False)
