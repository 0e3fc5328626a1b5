"""Who may talk to the viewer, and what may be said: all that reaches into viser's transport is here.

viser serves whoever can reach its port, takes any property of a control that a client names, and opens a public tunnel
when a client asks for one. So a request must name this host (a page elsewhere that the user visits could otherwise
connect), must know the token where there is one, and a message must be of a kind and size that the panel needs.
"""

from __future__ import annotations

import hmac
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, urlsplit

from sgwarp.viewer.bounds import FAR_AWAY, MOST_TEXT
from sgwarp.viewer.downloads import MOST_UPLOAD

COOKIE = "sgwarp_token"
LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_MESSAGE = 4 * 2**20  # of one message [bytes]; uploads come in parts of 1 MiB or less
MOST_UPLOADED = 8 * MOST_UPLOAD  # of all uploads of a tab [bytes]
MOST_UPLOADS = 64  # of a tab
MOST_PARTS = 256  # of an upload
MOST_VALUES = 16  # in a tuple that a control sends


@dataclass(frozen=True)
class Gate:
    """Decides on requests.

    Attributes:
        hosts: Names by which a request may call this host; empty for any.
        token: What a request must know, or None.
    """

    hosts: tuple[str, ...] = LOOPBACK
    token: str | None = None

    def judge(self, path: str, header: Callable[[str], str | None]) -> tuple[int, dict[str, str]] | None:
        """The answer to a request that goes no further, as status and headers; None if it may pass.

        Args:
            path: With its query.
            header: Value of a header by its name, or None.
        """
        host = header("Host") or ""
        if self.hosts and _hostname(host) not in self.hosts:
            return 403, {}
        origin = header("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return 403, {}  # a page of somebody else
        if self.token is None or self._knows(header("Cookie") or ""):
            return None
        parts = urlsplit(path)
        given = parse_qs(parts.query, max_num_fields=8).get("token", [""])[0] if len(path) < 4096 else ""
        if _same(given, self.token):
            cookie = f"{COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
            return 303, {"Location": parts.path or "/", "Set-Cookie": cookie}
        return 403, {}

    def _knows(self, cookies: str) -> bool:
        pairs = (cookie.strip().partition("=") for cookie in cookies[:4096].split(";"))
        return self.token is not None and any(name == COOKIE and _same(value, self.token) for name, _, value in pairs)


def _same(one: str, other: str) -> bool:
    return hmac.compare_digest(one.encode(), other.encode())


def _hostname(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


@contextmanager
def gated(gate: Gate) -> Iterator[None]:
    """Every server of websockets that is started in the block asks the gate first, and takes no large messages."""
    import websockets.asyncio.server as module
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    original = module.serve

    def serve(handler: Any, host: Any, port: Any, **options: Any) -> Any:
        inner = options.pop("process_request", None)

        def process(connection: Any, request: Any) -> Any:
            verdict = gate.judge(request.path, request.headers.get)
            if verdict is None:
                return inner(connection, request) if inner is not None else None
            status, headers = verdict
            body = b"" if status == 303 else b"sgwarp viewer: open the address that the program printed\n"
            sizes = {"Content-Length": str(len(body)), "Content-Type": "text/plain"}
            return Response(status, "See Other" if status == 303 else "Forbidden", Headers(headers | sizes), body)

        options["max_size"] = MOST_MESSAGE
        return original(handler, host, port, process_request=process, **options)

    module.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        module.serve = original  # type: ignore[misc]


@dataclass
class Allowance:
    """What one connection may still send.

    Attributes:
        uploads: Pictures.
        bytes: Of their parts.
    """

    uploads: int = MOST_UPLOADS
    bytes: int = MOST_UPLOADED
    _known: dict[str, Callable[[Any], bool]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        self._known = {
            "ViewerCameraMessage": _fits_camera,
            "ScenePointerMessage": _fits_pointer,
            "GuiUpdateMessage": _fits_update,
            "CommandTriggerMessage": lambda message: isinstance(message.uuid, str) and len(message.uuid) <= MOST_TEXT,
            "FileTransferStartUpload": self._fits_start,
            "FileTransferPart": self._fits_part,
            "FileTransferPartAck": lambda message: True,
        }

    def accepts(self, message: Any) -> bool:
        """Whether a message is of a kind and size that the viewer needs. Whatever is malformed is not."""
        check = self._known.get(type(message).__name__)
        try:
            return check is not None and check(message)
        except (TypeError, ValueError, AttributeError, OverflowError):
            return False

    def _fits_start(self, message: Any) -> bool:
        fits = 0 < message.size_bytes <= MOST_UPLOAD and 0 < message.part_count <= MOST_PARTS
        fits = fits and all(len(text) <= MOST_TEXT for text in (message.filename, message.mime_type))
        self.uploads -= 1
        return bool(fits) and self.uploads >= 0

    def _fits_part(self, message: Any) -> bool:
        self.bytes -= len(message.content)
        return self.bytes >= 0


def _fits_camera(message: Any) -> bool:
    parts = (message.wxyz, message.position, message.look_at, message.up_direction)
    sizes = (4, 3, 3, 3)
    fits = all(len(part) == size for part, size in zip(parts, sizes, strict=True))
    values = [float(value) for part in parts for value in part]
    values += [float(message.fov), float(message.near), float(message.image_height), float(message.image_width)]
    return fits and all(math.isfinite(value) and abs(value) <= FAR_AWAY for value in values)


def _fits_pointer(message: Any) -> bool:
    count = {"click": 1, "rect-select": 2}.get(message.event_type)
    places = message.screen_pos
    if count is None or len(places) != count:
        return False
    if message.event_type == "click" and (message.ray_origin is None or message.ray_direction is None):
        return False
    return all(len(place) == 2 and all(math.isfinite(float(value)) for value in place) for place in places)


def _fits_update(message: Any) -> bool:
    """Only values of controls; viser would set any other attribute, too."""
    return set(message.updates) == {"value"} and _fits_value(message.updates["value"])


def _fits_value(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= MOST_TEXT
    if isinstance(value, (list, tuple)):
        return len(value) <= MOST_VALUES and all(
            isinstance(part, (bool, int, float, str)) and _fits_value(part) for part in value
        )
    return isinstance(value, bool) or (isinstance(value, (int, float)) and abs(value) <= FAR_AWAY)


def guard_messages(server: Any) -> None:
    """Have a ViserServer drop what no panel needs, before any of its handlers sees it.

    Requests to share the page are among what is dropped, and asking for a tunnel by name does nothing.
    """
    transport = server._websock_server
    allowances: dict[int, Allowance] = {}

    def accepted(client_id: int, message: Any) -> bool:
        # Both the server and the connection are given each message; one of them must decide for both.
        known = getattr(message, "_sgwarp_accepted", None)
        if known is None:
            known = allowances.setdefault(client_id, Allowance()).accepts(message)
            message._sgwarp_accepted = known
        return bool(known)

    def checked(handle: Callable[[int, Any], Any]) -> Callable[[int, Any], Any]:
        async def handle_accepted(client_id: int, message: Any) -> None:
            if accepted(client_id, message):
                await handle(client_id, message)

        return handle_accepted

    async def connected(connection: Any) -> None:
        connection._handle_incoming_message = checked(connection._handle_incoming_message)

    async def disconnected(connection: Any) -> None:
        allowances.pop(connection.client_id, None)

    transport._handle_incoming_message = checked(transport._handle_incoming_message)
    transport.on_client_connect(connected)
    transport.on_client_disconnect(disconnected)
    server.request_share_url = lambda verbose=True: None


def is_waiting(client: Any) -> bool:
    """Whether a client has not been sent yet what was queued for it: it takes its pictures slowly."""
    return bool(client._websock_connection.get_message_buffer().message_from_id)


def let_go_quietly(client: Any) -> None:
    """Have what is sent to a client that has just gone be dropped without a warning: a tab was closed, that is all."""
    client._websock_connection.get_message_buffer()._warned_push_after_done = True
