"""What stands where on a sheet, read back from its pixels."""

import numpy as np
import torch

from sgwarp.evaluation.sheets import GAP, MISSED, RIGHT, TITLE, WRONG, draw_query
from sgwarp.files.images import read_rgb

HEIGHT, WIDTH = 24, 80


def test_a_query_shows_the_object_our_mask_and_the_error(tmp_path):
    """The object is the left half, ours the upper half."""
    truth, ours = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    truth[:, : WIDTH // 2], ours[: HEIGHT // 2] = True, True
    draw_query(tmp_path / "q.png", torch.zeros(HEIGHT, WIDTH, 3), truth, ours.float(), ours, None)
    sheet = read_rgb(tmp_path / "q.png")
    assert sheet.shape == (TITLE + HEIGHT, 4 * WIDTH + 3 * GAP, 3)
    object_, _, mask, error = (sheet[TITLE:, k * (WIDTH + GAP) :][:, :WIDTH].astype(int) for k in range(4))
    for part, chosen in ((object_, truth), (mask, ours)):
        assert (part[chosen.numpy()][:, 0] > 60).all()  # the photograph is black
        assert (part[~chosen.numpy()] == 0).all()
    seen = [error[y, x] for y, x in ((2, 2), (2, WIDTH - 2), (HEIGHT - 2, 2), (HEIGHT - 2, WIDTH - 2))]
    for color, wanted in zip(seen, (RIGHT, WRONG, MISSED), strict=False):
        np.testing.assert_allclose(color, 0.75 * np.array(wanted), atol=2)
    assert (seen[3] == 0).all()
