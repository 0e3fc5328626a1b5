"""Whatever a browser sends is taken within bounds or refused; the gate admits who it should."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgwarp.errors import InputError
from sgwarp.viewer import bounds
from sgwarp.viewer.guard import COOKIE, MOST_UPLOADS, Allowance, Gate

anything = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=40) | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=2),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(anything, anything, anything, anything)
def test_a_camera_is_taken_or_refused(wxyz, position, fov, side):
    try:
        camera = bounds.viewpoint(wxyz, position, fov, side, side, 0.01, 1e8)
    except InputError:
        return
    assert 16 <= camera.width <= 4096


def test_a_camera_is_the_one_of_the_page():
    half = math.sqrt(0.5)
    camera = bounds.viewpoint((half, 0.0, half, 0.0), (1.0, 2.0, 3.0), math.pi / 2, 640, 480, 0.01, 100.0)
    torch.testing.assert_close(camera.position, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    ahead = camera.world_to_camera @ torch.tensor([3.0, 2.0, 3.0, 1.0], dtype=torch.float64)  # it looks along x
    torch.testing.assert_close(ahead[:3], torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))
    assert camera.K[0, 0] == pytest.approx(240.0)
    assert (camera.K[0, 2], camera.K[1, 2]) == (320, 240)
    assert bounds.viewpoint((1, 0, 0, 0), (0, 0, 0), 1.0, 9000, 7, 0.01, 100.0).size == (16, 4096)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 2.0, -1, True, "0.5", None, [0.5]])
def test_a_number_out_of_bounds_is_refused(value):
    with pytest.raises(InputError, match="strength: expected a number from 0 to 1"):
        bounds.number("strength", value, 0.0, 1.0)


def test_phrases_are_bounded():
    assert bounds.phrases("query", " couch ;; lamp;couch\n") == ("couch", "lamp")
    for value in (";".join(map(str, range(17))), "a" * 201, "a;" * 2000, 7, None):
        with pytest.raises(InputError, match="query"):
            bounds.phrases("query", value)


def test_a_pixel_is_inside():
    camera = bounds.viewpoint((1, 0, 0, 0), (0, 0, 0), 1.0, 640, 480, 0.01, 100.0)
    assert bounds.pixel((0.5, 0.25), camera) == (320, 120)
    assert bounds.pixel((-3, 99), camera) == (0, 479)
    for place in ((float("nan"), 0), (1e9, 0), (0.5,), None, "ab"):
        with pytest.raises(InputError):
            bounds.pixel(place, camera)


# The gate


def judged(gate: Gate, path: str = "/", **headers: str):
    return gate.judge(path, lambda name: headers.get(name.replace("-", "_")))


def test_only_this_machine_is_let_in():
    gate = Gate()
    assert judged(gate, Host="127.0.0.1:8080") is None
    assert judged(gate, Host="localhost:8080", Origin="http://localhost:8080") is None
    assert judged(gate, Host="evil.example:8080")[0] == 403, "a name that was made to point here"
    assert judged(gate, Host="localhost:8080", Origin="http://evil.example")[0] == 403, "a page of somebody else"
    assert judged(gate, Host="localhost:8080", Origin="http://localhost:9000")[0] == 403
    assert judged(gate)[0] == 403
    assert judged(gate, Host="[::1")[0] == 403


def test_a_token_is_asked_for_and_kept_in_a_cookie():
    gate = Gate(hosts=(), token="secret")
    for path in ("/", "/?token=", "/?token=Secret", "/?token=secre%00t", "/?other=secret", "/?" + "a" * 5000):
        assert judged(gate, path, Host="10.0.0.1:80")[0] == 403
    status, headers = judged(gate, "/?token=secret", Host="10.0.0.1:80")
    assert (status, headers["Location"]) == (303, "/")
    assert headers["Set-Cookie"].startswith(f"{COOKIE}=secret; HttpOnly; SameSite=Strict")
    assert judged(gate, Host="10.0.0.1:80", Cookie=f"a=b; {COOKIE}=secret") is None
    for cookie in (f"{COOKIE}=other", "secret", f"x{COOKIE}=secret", f"{COOKIE}=sécret"):
        assert judged(gate, Host="10.0.0.1:80", Cookie=cookie)[0] == 403
    assert judged(gate, Host="10.0.0.1:80", Cookie=f"{COOKIE}=secret", Origin="http://evil.example")[0] == 403


# Messages


def message(kind: str, **fields):
    return type(kind, (SimpleNamespace,), {})(**fields)


CAMERA = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "look_at": (0, 0, 1), "up_direction": (0, -1, 0)}
CAMERA |= {"fov": 1.0, "near": 0.1, "far": 10.0, "image_height": 480, "image_width": 640}


def test_messages_that_the_panel_needs_are_accepted():
    accepts = Allowance().accepts
    assert accepts(message("ViewerCameraMessage", **CAMERA))
    pointer = {"ray_origin": (0, 0, 0), "ray_direction": (0, 0, 1), "modifier": None}
    assert accepts(message("ScenePointerMessage", event_type="click", screen_pos=((0.5, 0.5),), **pointer))
    assert accepts(message("GuiUpdateMessage", uuid="u", updates={"value": "couch; lamp"}))
    assert accepts(message("GuiUpdateMessage", uuid="u", updates={"value": (230, 60, 40)}))
    assert accepts(message("FileTransferStartUpload", size_bytes=10, part_count=1, filename="a", mime_type="image/png"))
    assert accepts(message("FileTransferPart", content=b"0123456789"))
    assert accepts(message("FileTransferPartAck"))
    assert accepts(message("CommandTriggerMessage", uuid="u"))


@pytest.mark.parametrize(
    "one",
    [
        message("ShareUrlRequest"),
        message("GetRenderResponseMessage", payload=b""),
        message("ViewerCameraMessage", **{**CAMERA, "position": (float("nan"), 0, 0)}),
        message("ViewerCameraMessage", **{**CAMERA, "position": (0, 0)}),
        message("ViewerCameraMessage", **{**CAMERA, "image_width": float("inf")}),
        message("ViewerCameraMessage", **{**CAMERA, "wxyz": None}),
        message("ScenePointerMessage", event_type="click", screen_pos=(), ray_origin=None, ray_direction=None),
        message("ScenePointerMessage", event_type="other", screen_pos=((0, 0),)),
        message("GuiUpdateMessage", uuid="u", updates={"update_cb": []}),
        message("GuiUpdateMessage", uuid="u", updates={"value": 1, "removed": True}),
        message("GuiUpdateMessage", uuid="u", updates={"value": "a" * 2001}),
        message("GuiUpdateMessage", uuid="u", updates={"value": float("nan")}),
        message("GuiUpdateMessage", uuid="u", updates={"value": {"a": 1}}),
        message("GuiUpdateMessage", uuid="u", updates={"value": [[1]]}),
        message("FileTransferStartUpload", size_bytes=2**40, part_count=1, filename="a", mime_type="b"),
        message("FileTransferStartUpload", size_bytes=10, part_count=10**9, filename="a", mime_type="b"),
    ],
)
def test_other_messages_are_dropped(one):
    assert not Allowance().accepts(one)


def test_uploads_of_a_tab_are_limited():
    allowance = Allowance()
    start = message("FileTransferStartUpload", size_bytes=10, part_count=1, filename="a", mime_type="b")
    assert [allowance.accepts(start) for _ in range(MOST_UPLOADS + 1)] == [True] * MOST_UPLOADS + [False]
    part = message("FileTransferPart", content=bytes(2**20))
    assert sum(allowance.accepts(part) for _ in range(200)) == 128
