"""The server against a client that is no browser: who is let in, and what hostile messages do."""

import http.client
import logging
import socket
import threading

import pytest

from sgwarp.apps.editing.operations import Remove
from sgwarp.errors import InputError
from sgwarp.viewer.server import Address, Viewer, open_viewer

viser = pytest.importorskip("viser")
msgspec = pytest.importorskip("msgspec")


@pytest.fixture
def make_viewer(bench):
    made = []

    def make(address: Address = Address(port=0)) -> Viewer:  # noqa: B008 - frozen
        made.append(Viewer(bench, address))
        return made[-1]

    yield make
    for viewer in made:
        viewer.close()


def get(viewer: Viewer, path: str = "/", **headers: str):
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=20)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=named)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


class Client:
    """Speaks viser's protocol, without a browser."""

    def __init__(self, viewer: Viewer, **options) -> None:
        from websockets.sync.client import connect

        protocol = f"viser-v{viser.__version__}"
        address = f"ws://127.0.0.1:{viewer.port}"
        self.socket = connect(address, subprotocols=[protocol], max_size=2**26, **options)
        self.messages = self._receive()

    def send(self, kind: str, **fields) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, **changes) -> None:
        fields = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov": 0.8, "near": 0.01, "far": 1000.0}
        fields |= {"image_height": 60, "image_width": 80, "look_at": (0, 0, 3), "up_direction": (0, -1, 0)}
        self.send("ViewerCameraMessage", **{**fields, **changes})

    def _receive(self):
        """Messages, one after the other."""
        import zstandard

        while True:
            raw = self.socket.recv(timeout=60)
            size, packed = (int.from_bytes(raw[at : at + 8], "little") for at in (0, 8))
            inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
            yield from msgspec.msgpack.decode(inner)["messages"]

    def wait_for(self, kind: str):
        return next(message for message in self.messages if message["type"] == kind)

    def wait_for_control(self, kind: str, label: str) -> str:
        """Its id."""
        controls = (message for message in self.messages if message["type"] == kind)
        return next(control["uuid"] for control in controls if control["props"]["label"] == label)

    def wait_for_query_box(self) -> str:
        """Its id."""
        return self.wait_for_control("GuiTextMessage", "Query")


def picture(client: Client):
    import cv2
    import numpy as np

    pictures = (message["rgb_data"] for message in client.messages if message["type"] == "BackgroundImageMessage")
    data = next(data for data in pictures if data is not None)
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_the_page_is_served_to_this_machine_alone(make_viewer):
    viewer = make_viewer()
    answer, body = get(viewer)
    assert answer.status == 200
    assert b"<html" in body[:2000].lower()
    assert get(viewer, Host="evil.example")[0].status == 403
    assert get(viewer, "/..%2f..%2f..%2fetc/passwd")[0].status == 404
    with socket.socket() as probe:
        probe.bind(("127.0.0.2", viewer.port))  # would fail if the viewer listened at every address


def test_a_token_is_needed_where_there_is_one(make_viewer):
    viewer = make_viewer(Address(port=0, token="secret"))
    assert viewer.url.endswith("/?token=secret")
    assert get(viewer)[0].status == 403
    with pytest.raises(Exception, match="403"):
        Client(viewer)
    answer, _ = get(viewer, "/?token=secret")
    assert answer.status == 303
    cookie = answer.getheader("Set-Cookie").partition(";")[0]
    assert get(viewer, Cookie=cookie)[0].status == 200
    client = Client(viewer, additional_headers={"Cookie": cookie})
    client.look()
    assert picture(client) is not None


def test_other_hosts_get_a_token_and_a_warning(bench, caplog, capsys):
    address = Address.of("0.0.0.0", 0)
    assert len(address.token) >= 16
    assert Address.of("127.0.0.1").token is None
    with caplog.at_level(logging.WARNING, "sgwarp"):
        viewer = open_viewer(bench, address)
    viewer.close()
    assert "other machines" in caplog.text
    assert address.token in capsys.readouterr().out


def test_a_page_of_somebody_else_cannot_connect(make_viewer):
    viewer = make_viewer()
    with pytest.raises(Exception, match="403"):
        Client(viewer, origin="http://evil.example")
    Client(viewer, origin=f"http://127.0.0.1:{viewer.port}").look()


def test_pictures_come_and_follow_the_camera(make_viewer):
    client = Client(make_viewer())
    client.look()
    first = picture(client)
    assert first.shape == (60, 80, 3)
    assert first.std() > 10
    client.look(position=(0, 0, 100))
    shown = first
    while shown.max() >= 8:  # behind the stage there is nothing
        shown = picture(client)
    assert shown.shape == (60, 80, 3)


def test_cameras_are_drawn_into_the_depth_of_the_scene(make_viewer, stage):
    import cv2
    import numpy as np

    client = Client(make_viewer())
    client.look()
    box = client.wait_for_control("GuiCheckboxMessage", "Cameras of the views")
    client.send("GuiUpdateMessage", uuid=box, updates={"value": True})
    shown = [client.wait_for("CameraFrustumMessage") for _ in stage.views]
    assert [message["name"] for message in shown] == [f"/cameras/{view.stem}" for view in stage.views]
    pictures = (message for message in client.messages if message["type"] == "BackgroundImageMessage")
    packed = next(
        cv2.imdecode(np.frombuffer(message["depth_data"], np.uint8), cv2.IMREAD_COLOR)
        for message in pictures
        if message["depth_data"] is not None and message["rgb_data"] is not None
    )
    while packed.shape[:2] != (60, 80):  # of a moving picture it is coarser
        data = next(message["depth_data"] for message in pictures)
        packed = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    red, green, blue = (packed[..., 2 - k].astype(float) for k in range(3))
    depth = (blue + 256 * green + 65536 * red) / 100_000  # as the page reads it
    middle = depth[25:35, 35:45]
    # The page looks along z from the origin: the wall is 4 m away, the door 3 m, and beside the stage there is nothing.
    assert set(np.round(middle).ravel()) <= {3.0, 4.0}
    assert depth.max() > 160
    client.send("GuiUpdateMessage", uuid=box, updates={"value": False})
    gone = {client.wait_for("RemoveSceneNodeMessage")["name"] for _ in stage.views}
    assert gone == {f"/cameras/{view.stem}" for view in stage.views}


HOSTILE = [
    {"type": "ShareUrlRequest"},
    {"type": "ShareUrlDisconnect"},
    {"type": "GuiUpdateMessage", "uuid": "x", "updates": {"value": "a" * 10**6}},
    {"type": "FileTransferStartUpload", "source_component_uuid": "x", "transfer_uuid": "../../x", "filename": "/etc/x"},
    {"type": "ScenePointerMessage", "event_type": "click", "screen_pos": [[float("nan"), 0]], "modifier": None},
    {"type": "NoSuchMessage"},
    {"type": 7},
    {},
    [],
    "text",
    None,
    {"type": "ViewerCameraMessage", "wxyz": "x"},
]


def test_hostile_clients_harm_nobody_else(make_viewer):
    viewer = make_viewer()
    good = Client(viewer)
    good.look()
    assert picture(good).std() > 10
    for message in HOSTILE:
        bad = Client(viewer)
        bad.look(position=(float("inf"), 0, 0))
        bad.socket.send(msgspec.msgpack.encode(message))
        bad.socket.close()
    for raw in (b"", b"\xff" * 100, "text"):
        bad = Client(viewer)
        bad.socket.send(raw)
        bad.socket.close()
    good.look(position=(0.2, 0, 0))
    assert picture(good).std() > 10
    assert viewer.server._share_tunnel is None
    assert viewer.server.request_share_url() is None


def test_a_client_cannot_set_what_is_no_value(make_viewer):
    viewer = make_viewer()
    client = Client(viewer)
    client.look()
    box = client.wait_for_query_box()
    client.send("GuiUpdateMessage", uuid=box, updates={"update_cb": [], "removed": True})
    client.send("GuiUpdateMessage", uuid=box, updates={"value": "lamp"})
    assert _until(lambda: viewer.tabs)
    (session,) = viewer.tabs
    assert _until(lambda: session.tab.answers is not None)
    assert session.tab.answers.questions.queries == ("lamp",)


def test_a_refused_value_is_told_and_changes_nothing(make_viewer):
    viewer = make_viewer()
    client = Client(viewer)
    client.look()
    box = client.wait_for_query_box()
    client.send("GuiUpdateMessage", uuid=box, updates={"value": ";".join(map(str, range(99)))})
    told = client.wait_for("NotificationShowMessage")
    assert "at most 16 phrases" in str(told)
    assert _until(lambda: viewer.tabs)
    (session,) = viewer.tabs
    assert session.tab.answers is None


def updates_of(client, uuid):
    """New values that the program gives a control."""
    updates = (message for message in client.messages if message["type"] == "GuiUpdateMessage")
    return (update["updates"] for update in updates if update["uuid"] == uuid)


def test_a_control_that_was_refused_goes_back(make_viewer, bench, monkeypatch):
    from dataclasses import replace

    bench.materials = replace(bench.materials, instances=None)
    client = Client(make_viewer())
    client.look()
    mode = client.wait_for_control("GuiDropdownMessage", "Mode")
    client.send("GuiUpdateMessage", uuid=mode, updates={"value": "instances"})
    assert "--instances" in str(client.wait_for("NotificationShowMessage"))
    assert next(updates_of(client, mode)) == {"value": "color"}

    monkeypatch.setattr("sgwarp.viewer.splats.MOST_SPLATS", 10)
    other = Client(make_viewer())
    other.look()
    box = other.wait_for_control("GuiCheckboxMessage", "Splats in the browser")
    other.send("GuiUpdateMessage", uuid=box, updates={"value": True})
    assert next(updates_of(other, box)) == {"value": False}
    assert "too many for the browser" in str(other.wait_for("NotificationShowMessage"))


def test_splats_stand_before_the_chosen_background(make_viewer):
    import cv2
    import numpy as np

    client = Client(make_viewer())
    client.look()
    color = client.wait_for_control("GuiRgbMessage", "Background")
    box = client.wait_for_control("GuiCheckboxMessage", "Splats in the browser")
    client.send("GuiUpdateMessage", uuid=color, updates={"value": [10, 200, 30]})
    client.send("GuiUpdateMessage", uuid=box, updates={"value": True})
    client.wait_for("GaussianSplatsMessage")
    pictures = (message for message in client.messages if message["type"] == "BackgroundImageMessage")
    sent = (cv2.imdecode(np.frombuffer(message["rgb_data"], np.uint8), cv2.IMREAD_COLOR) for message in pictures)
    assert next(one for one in sent if one.shape == (1, 1, 3)).tolist() == [[[30, 200, 10]]]


def test_tabs_come_and_go(make_viewer):
    viewer = make_viewer()
    clients = [Client(viewer) for _ in range(3)]
    for client in clients:
        client.look()
        picture(client)
    assert _until(lambda: len(viewer.tabs) == 3)
    assert len({id(session.tab) for session in viewer.tabs}) == 3
    for client in clients[:2]:
        client.socket.close()
    assert _until(lambda: len(viewer.tabs) == 1)
    assert _until(lambda: len(viewer.streamer._streams) == 1)


def test_a_tab_too_many_is_told(make_viewer, monkeypatch):
    from sgwarp.viewer import server

    monkeypatch.setattr(server, "MOST_TABS", 2)
    viewer = make_viewer()
    for _ in range(2):
        client = Client(viewer)
        client.look()
        picture(client)
    third = Client(viewer)
    third.look()
    assert "Too many tabs" in str(third.wait_for("NotificationShowMessage"))
    assert len(viewer.tabs) == 2


def test_a_key_does_what_its_command_says(make_viewer, stage):
    viewer = make_viewer()
    client = Client(viewer)
    client.look()
    commands = (message for message in client.messages if message["type"] == "RegisterCommandMessage")
    undo = next(command["uuid"] for command in commands if command["props"]["label"] == "Undo")
    client.send("CommandTriggerMessage", uuid="x" * 10**5)
    client.send("CommandTriggerMessage", uuid=undo)
    assert "no step was applied" in str(client.wait_for("NotificationShowMessage"))
    viewer.bench.apply("rows:0-9", Remove())
    client.send("CommandTriggerMessage", uuid=undo)
    assert _until(lambda: len(viewer.bench.state.gaussians) == len(stage.gaussians))


def test_a_tab_that_leaves_in_the_middle_of_a_query_harms_nobody(make_viewer, bench, caplog):
    asked, go_on = threading.Event(), threading.Event()
    original = bench.asker.ask

    def slow(*arguments):
        asked.set()
        assert go_on.wait(60)
        return original(*arguments)

    bench.asker.ask = slow
    viewer = make_viewer()
    client = Client(viewer)
    client.look()
    client.send("GuiUpdateMessage", uuid=client.wait_for_query_box(), updates={"value": "lamp"})
    assert asked.wait(60)
    client.socket.close()
    assert _until(lambda: not viewer.tabs)
    go_on.set()
    other = Client(viewer)
    other.look()
    assert picture(other).std() > 10
    assert "Traceback" not in caplog.text


def _until(ready) -> bool:
    import time

    for _ in range(600):
        if ready():
            return True
        time.sleep(0.05)
    return False


def test_a_port_in_use_is_passed_over(make_viewer):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert make_viewer(Address(port=port)).port > port


@pytest.mark.parametrize("address", [Address("203.0.113.7", 0), Address("no such host", 0), Address(port=-1)])
def test_an_address_that_is_none_is_refused(bench, address):
    with pytest.raises(InputError, match=r"--host|--port"):
        Viewer(bench, address)
