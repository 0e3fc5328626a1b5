"""The canvas of one tab: pictures behind the scene, or splats that the browser draws itself."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgwarp.viewer.guard import is_waiting
from sgwarp.viewer.modes import Drawn, Shot
from sgwarp.viewer.splats import splats_of

QUALITY_MOVING, QUALITY_STILL = 70, 92  # of JPEG
FARTHEST = 167.0  # depth that viser can tell from the sky [world units]
COARSER = 4  # the depth of a moving picture has so many times fewer pixels on each side
SPLATS = "/splats"
RECENT = 2.0  # seconds over which the rate is counted


class Canvas:
    """Sends to one client of viser; nothing here waits for the browser.

    Args:
        client: Of viser.
        complain: Shows a message to the user.
    """

    def __init__(self, client: Any, complain: Callable[[str], None]) -> None:
        self._client = client
        self._complain = complain
        self._splats: Any = None
        self._times: deque[float] = deque(maxlen=256)
        self.size = (0, 0)  # of the last picture, height and width
        self.sent = 0

    def show(self, drawn: Drawn, final: bool) -> None:
        """Send a picture."""
        depth = None if drawn.depth is None else _for_viser(drawn.depth, 1 if final else COARSER)
        quality = QUALITY_STILL if final else QUALITY_MOVING
        self._client.scene.set_background_image(drawn.pixels, format="jpeg", jpeg_quality=quality, depth=depth)
        self._client.flush()
        self.size = drawn.pixels.shape[0], drawn.pixels.shape[1]
        self.sent += 1
        self._times.append(time.monotonic())

    @property
    def busy(self) -> bool:
        """Whether the tab has not taken the picture before."""
        return is_waiting(self._client)

    @property
    def rate(self) -> float:
        """Pictures a second, over the last two seconds."""
        now = time.monotonic()
        return sum(now - at <= RECENT for at in list(self._times)) / RECENT

    def complain(self, message: str) -> None:
        """Tell the user."""
        self._complain(message)

    def show_splats(self, shot: Shot) -> None:
        """Send splats, in place of those sent before and of pictures.

        Raises:
            InputError: As `splats_of`.
        """
        splats = splats_of(shot)
        parts = (splats.centers, splats.covariances, splats.rgbs, splats.opacities)
        if self._splats is None:
            self._splats = self._client.scene.add_gaussian_splats(SPLATS, *parts)
        else:
            self._splats.set_gaussians(*parts)
        behind = np.array([[shot.background]])  # one pixel, behind the splats
        self._client.scene.set_background_image((255 * behind + 0.5).astype(np.uint8), format="png")

    def remove_splats(self) -> None:
        """Go back to pictures."""
        if self._splats is not None:
            self._splats.remove()
            self._splats = None


def _for_viser(depth: NDArray[np.float32], step: int) -> NDArray[np.float32]:
    """Depth as viser takes it: what has no surface is as far as can be."""
    coarse = depth[::step, ::step]
    return np.where((coarse > 0) & np.isfinite(coarse), np.minimum(coarse, FARTHEST), FARTHEST)
