"""How large pictures are while a camera moves, so that enough of them come."""

from __future__ import annotations

from dataclasses import dataclass

from sgwarp.scene import Camera

GOAL = 1 / 24  # seconds for a picture while the camera moves
SLOWEST = 1 / 15  # above which the next picture is smaller
SIZES = (96, 128, 192, 256, 360, 480, 600, 720, 900, 1080)  # heights of moving pictures [pixels]
STILL = 0.15  # seconds without a move after which a camera stands still
SURPRISE = 2.0  # times the slowest picture that a single one counts as, at most
MEMORY = 0.7  # of the measured times
BOLD = 0.8  # share of the goal that the next larger picture is expected to take, before it is tried


@dataclass
class Pace:
    """Measured times of the pictures of one tab, and the size that follows.

    Attributes:
        place: Of the height among SIZES.
        seconds: Running mean of what a picture of that height takes; 0 before the first.
    """

    place: int = SIZES.index(360)
    seconds: float = 0.0

    def moving(self, camera: Camera) -> Camera:
        """The camera with the picture that is affordable while it moves."""
        height = min(SIZES[self.place], camera.height)
        return camera.resized(height, max(1, round(camera.width * height / camera.height)))

    def took(self, seconds: float, height: int) -> None:
        """Learn what a moving picture took, from the start of its drawing until it could be sent.

        Args:
            seconds: Measured.
            height: Of the picture, which may be less than wanted where the page is small.
        """
        known = self.seconds > 0
        seconds = min(seconds, SURPRISE * SLOWEST)  # the first one of a mode compiles its kernels
        self.seconds = MEMORY * self.seconds + (1 - MEMORY) * seconds if known else seconds
        if self.seconds > SLOWEST and self.place > 0:
            self._go_to(self.place - 1)
        elif self.place + 1 < len(SIZES) and height == SIZES[self.place]:
            grown = (SIZES[self.place + 1] / SIZES[self.place]) ** 2
            if self.seconds * grown < BOLD * GOAL:
                self._go_to(self.place + 1)

    def _go_to(self, place: int) -> None:
        """Another height; until it is measured its time is taken to go with the number of pixels."""
        self.seconds *= (SIZES[place] / SIZES[self.place]) ** 2
        self.place = place
