"""The viewer: one page, any number of tabs, on viser."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import secrets
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch

from sgwarp.errors import InputError
from sgwarp.rendering.orbits import orbit_views
from sgwarp.scene import View
from sgwarp.scene.extent import camera_extent
from sgwarp.viewer import bounds
from sgwarp.viewer.guard import LOOPBACK, Gate, gated, guard_messages, let_go_quietly
from sgwarp.viewer.modes import HIGHLIGHT
from sgwarp.viewer.panel import Panel
from sgwarp.viewer.screen import Canvas
from sgwarp.viewer.streaming import Stream, Streamer
from sgwarp.viewer.tab import Tab
from sgwarp.viewer.workbench import Workbench

logger = logging.getLogger("sgwarp")
PORT = 8080
PORTS_TRIED = 20
MOST_TABS = 16
MOST_CAMERAS = 300  # that the browser draws
CAMERA_SIZE = 0.05  # of the extent of all cameras
STATUS_EVERY = 0.5  # seconds


@dataclass(frozen=True)
class Address:
    """Where the viewer listens.

    Attributes:
        host: To bind to.
        port: The first to try; 0 for any.
        token: What requests must know; None where only this machine can ask.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    token: str | None = None

    @classmethod
    def of(cls, host: str = "127.0.0.1", port: int = PORT) -> Address:
        """An address with a token where other machines can reach it."""
        return cls(host, port, None if host in LOOPBACK else secrets.token_urlsafe(18))


class Viewer:
    """Serves a workbench until `close`.

    Args:
        bench: What is shown.
        address: Where to listen.

    Raises:
        InputError: viser is missing, or the address cannot be listened at.
    """

    def __init__(self, bench: Workbench, address: Address | None = None) -> None:
        self.bench, self.address = bench, address or Address()
        viser = require_viser()
        port = _free_port(self.address.host, self.address.port)
        hosts = LOOPBACK if self.address.host in LOOPBACK else ()
        with _quiet(), gated(Gate(hosts, self.address.token)):
            self.server = viser.ViserServer(self.address.host, port, label="sgwarp", verbose=False)
        guard_messages(self.server)
        self.port: int = self.server.get_port()
        self._views = list(bench.materials.views) or orbit_views(bench.materials.gaussians, 4, 640, 480)
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self.streamer = Streamer()
        self._dress()
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)
        self._unsubscribe = bench.subscribe(self._changed)
        self.streamer.start()
        self._watch = threading.Thread(target=self._report, name="sgwarp-viewer-status", daemon=True)
        self._watch.start()

    def _dress(self) -> None:
        """Title, first camera and up direction."""
        gui, scene = self.server.gui, self.server.scene
        gui.configure_theme(control_width="medium", show_logo=False, show_share_button=False, dark_mode=True)
        gui.main_panel.dock_right()
        first = self._views[0].camera
        ups = torch.stack([-view.camera.world_to_camera[1, :3] for view in self._views]).mean(dim=0)
        up = ups / ups.norm() if float(ups.norm()) > 1e-6 else -first.world_to_camera[1, :3]
        self.up: tuple[float, float, float] = tuple(up.tolist())
        scene.set_up_direction(self.up)
        start = self.server.initial_camera
        start.up = self.up
        start.position = tuple(first.position.tolist())
        start.look_at = tuple(self._target(self._views[0]).tolist())
        start.fov = _fov(self._views[0])

    def _target(self, view: View) -> torch.Tensor:
        """The point that the orbit of a view turns about: ahead, as far as the scene's median is."""
        camera = view.camera
        means = self.bench.materials.gaussians.means[self.bench.materials.gaussians.finite].double().cpu()
        middle = means.median(dim=0).values if len(means) else torch.zeros(3, dtype=torch.float64)
        forward = camera.world_to_camera[2, :3]
        ahead = float((middle - camera.position) @ forward)
        return camera.position + forward * max(ahead, 10 * self.bench.depth_range()[0])

    @property
    def url(self) -> str:
        """What to open in a browser."""
        name = "127.0.0.1" if self.address.host in ("0.0.0.0", "::") else self.address.host
        token = f"?token={self.address.token}" if self.address.token else ""
        return f"http://{name}:{self.port}/{token}"

    @property
    def tabs(self) -> list[Session]:
        """Those that are open."""
        with self._lock:
            return list(self._sessions.values())

    def _connect(self, client: Any) -> None:
        with self._lock:
            full = len(self._sessions) >= MOST_TABS
        if full:
            client.add_notification("Too many tabs", f"{MOST_TABS} are open; close one.", color="red")
            return
        session = Session(self, client)
        with self._lock:
            self._sessions[client.client_id] = session
        if client.client_id not in self.server.get_clients():  # it left while its panel was built
            self._disconnect(client)

    def _disconnect(self, client: Any) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _changed(self) -> None:
        self.streamer.change()
        for session in self.tabs:
            session.follow()
            session.panel.refresh()

    def _report(self) -> None:
        while not self._ended.wait(STATUS_EVERY):
            for session in self.tabs:
                with contextlib.suppress(Exception):  # the tab may be closing
                    session.report()

    def close(self) -> None:
        """End the server and its threads."""
        if self._ended.is_set():
            return
        self._ended.set()
        self._unsubscribe()
        self.streamer.stop()
        with _quiet():
            self.server.stop()

    def wait(self) -> None:
        """Serve until Ctrl-C."""
        while not self._ended.wait(1.0):
            pass


class Session:
    """One tab on one connection.

    Args:
        viewer: That it belongs to.
        client: Of viser.
    """

    def __init__(self, viewer: Viewer, client: Any) -> None:
        self.viewer, self.client = viewer, client
        let_go_quietly(client)
        self.tab = Tab(viewer.bench)
        self.canvas = Canvas(client, lambda message: self.panel.tell(message, wrong=True))
        self.stream = Stream(self.canvas, self.tab.shot)
        self._frustums: list[Any] = []
        self.panel = Panel(client, self.tab, self.changed, self.draw_splats, self.aim, self.show_cameras)
        viewer.streamer.add(self.stream)
        self._listen()
        self.moved()

    def _listen(self) -> None:
        camera, scene = self.client.camera, self.client.scene

        @camera.on_update
        async def _(handle: Any) -> None:
            self.moved()

        @scene.on_click()
        def _(event: Any) -> None:
            self.panel.click(event.screen_pos)

        @scene.on_rect_select(modifier="shift")
        def _(event: Any) -> None:
            self.panel.rectangle(event.screen_min, event.screen_max)

    def close(self) -> None:
        """The tab is gone."""
        self.panel.close()
        self.viewer.streamer.remove(self.stream)

    def moved(self) -> None:
        """Take the camera of the page; one that is out of bounds is left out."""
        state = self.client.camera
        near, far = self.viewer.bench.depth_range()
        try:
            camera = bounds.viewpoint(
                state.wxyz, state.position, state.fov, state.image_width, state.image_height, near, far
            )
        except (InputError, AssertionError):
            return
        self.tab.camera = camera
        self.viewer.streamer.move(self.stream, camera)

    def changed(self) -> None:
        """What the tab shows has changed."""
        self.viewer.streamer.change(self.stream)
        self.follow()

    def follow(self) -> None:
        """Send splats anew where the browser draws them."""
        if self.stream.paused:
            try:
                self.canvas.show_splats(self.tab.shot())
            except InputError as error:
                self.panel.tell(str(error), wrong=True)

    def draw_splats(self, wanted: bool) -> None:
        """Have the browser draw splats, or the server pictures."""
        if wanted:
            self.canvas.show_splats(self.tab.shot())
        else:
            self.canvas.remove_splats()
        self.stream.paused = wanted

    def aim(self, stem: str) -> None:
        """Look from a view, or if it has no name from where the page began."""
        viewer = self.viewer
        known = viewer.bench.materials.views if stem else viewer._views[:1]
        view = next((view for view in known if view.stem == stem or not stem), None)
        if view is None:
            raise InputError(f"view '{stem[:40]}': there is no such view")
        up = tuple((-view.camera.world_to_camera[1, :3]).tolist()) if stem else viewer.up
        with self.client.atomic():
            self.client.camera.up_direction = up
            self.client.camera.position = tuple(view.camera.position.tolist())
            self.client.camera.look_at = tuple(viewer._target(view).tolist())
            self.client.camera.fov = _fov(view)

    def show_cameras(self, wanted: bool) -> None:
        """Draw the views' cameras into the scene, or take them away."""
        for handle in self._frustums:
            handle.remove()
        self._frustums = []
        if not wanted:
            return
        views = self.viewer.bench.materials.views[:MOST_CAMERAS]
        size = CAMERA_SIZE * camera_extent(views)
        with self.client.atomic():
            self._frustums = [self._frustum(view, size) for view in views]

    def _frustum(self, view: View, size: float) -> Any:
        from viser.transforms import SO3

        camera = view.camera
        return self.client.scene.add_camera_frustum(
            f"/cameras/{view.stem}",
            fov=_fov(view),
            aspect=camera.width / camera.height,
            scale=size,
            color=HIGHLIGHT,
            thickness=1.5,  # one in world units would fill the picture of a camera that stands there
            thickness_units="screen",
            wxyz=SO3.from_matrix(camera.world_to_camera[:3, :3].T.numpy()).wxyz,
            position=camera.position.numpy(),
        )

    def report(self) -> None:
        """The line at the top of the panel."""
        count = f"{len(self.viewer.bench.scene(self.tab.look.moment).gaussians):,} Gaussians"
        if self.stream.paused:
            self.panel.set_status(f"{count}, drawn by the browser without harmonics")
            return
        height, width = self.canvas.size
        state = {"moving": f"{self.canvas.rate:.0f} pictures/s", "still": "drawing", "done": "still"}
        self.panel.set_status(f"{count}, {width} x {height}, {state[self.stream.state]}")


def _fov(view: View) -> float:
    """Vertical field of view [radians]."""
    return 2 * math.atan(view.camera.height / (2 * float(view.camera.K[1, 1])))


def require_viser() -> Any:
    """The module viser.

    Raises:
        InputError: It is not installed.
    """
    try:
        import viser
    except ImportError:
        raise InputError('the viewer needs viser: pip install "sgwarp[viewer]"') from None
    return viser


def _free_port(host: str, port: int) -> int:
    """The first free port from this one on; viser itself would try for a long time.

    Raises:
        InputError: There is no such host here, or none of 20 ports is free.
    """
    bounds.whole("--port", port, 0, 65535)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for tried in range(port, min(port + PORTS_TRIED, 65536)):
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, tried))
            except PermissionError:
                raise InputError(f"--port {tried}: may not be used; choose one from 1024 on") from None
            except OSError as error:
                if error.errno in (socket.EAI_NONAME, 99) or isinstance(error, socket.gaierror):
                    raise InputError(f"--host {host}: is no address of this machine") from None
                continue
            return int(probe.getsockname()[1])
    raise InputError(f"--port {port}: this and the {PORTS_TRIED} ports behind it are in use; choose another")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser prints its own banner; connections that break off are no errors of ours."""
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def open_viewer(bench: Workbench, address: Address | None = None) -> Viewer:
    """Start a viewer and say where it is.

    Raises:
        InputError: As `Viewer`.
    """
    viewer = Viewer(bench, address)
    if viewer.address.token is not None:
        logger.warning(
            "viewer: listens at %s, where other machines can reach it; without encryption, so only in a network that "
            "you trust. Who has the address with its token can look and edit",
            viewer.address.host,
        )
    print(f"viewer: {viewer.url}", flush=True)
    return viewer
