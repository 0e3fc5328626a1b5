"""Structure from motion of photographs of all kinds of files, some of them twice."""

import numpy as np
import pytest

from sgwarp.io.views import load_views
from sgwarp.io.world import similarity_between
from sgwarp.reconstruction.sfm.features import SfmSettings
from sgwarp.reconstruction.sfm.poses import estimate_poses

pytest.importorskip("pycolmap")
image = pytest.importorskip("PIL.Image")
SIDEWAYS = 6


@pytest.mark.slow
def test_every_kind_of_file_gets_its_pose(shots, tmp_path):
    """CMYK, 16 bits, gray, palette, transparency, TIFF with an orientation, BMP; a copy, and a name taken twice."""
    cv2 = pytest.importorskip("cv2")
    folder, pixels = tmp_path / "photos", [(colors * 255).astype(np.uint8) for _, colors, _ in shots]
    (folder / "sub").mkdir(parents=True)
    pictures = [image.fromarray(array) for array in pixels]
    noted = image.Exif()
    noted[0x0112] = SIDEWAYS
    pictures[0].save(folder / "0.png")
    pictures[1].convert("CMYK").save(folder / "1.jpg", quality=97)
    cv2.imwrite(str(folder / "2.png"), pixels[2][..., ::-1].astype(np.uint16) * 257)
    pictures[3].convert("L").save(folder / "3.png")
    pictures[4].quantize(200).save(folder / "4.png")
    image.fromarray(np.dstack([pixels[5], np.full(pixels[5].shape[:2], 200, np.uint8)])).save(folder / "5.png")
    pictures[6].save(folder / "6.tif", exif=noted)
    pictures[7].save(folder / "7.bmp")
    pictures[0].save(folder / "8.png")
    pictures[3].save(folder / "sub/0.png")
    found = estimate_poses(folder, tmp_path / "out", SfmSettings(threads=1))
    assert not found.left_out
    views = {view.stem: view for view in load_views(tmp_path / "out")}
    assert list(views) == ["0", "1", "2", "3", "4", "5", "6", "7", "8", "sub_0"]
    ours = np.stack([view.camera.position.numpy() for view in views.values()])
    order = [*range(8), 0, 3]
    truth = np.stack([shots[index][0].position.numpy() for index in order])
    matrix = similarity_between(ours, truth)
    assert np.linalg.norm(ours @ matrix[:3, :3].T + matrix[:3, 3] - truth, axis=1).max() < 0.03
    for index, view in zip(order, views.values(), strict=True):
        apart = view.image().numpy().mean(axis=2) - pixels[index].mean(axis=2) / 255
        assert np.abs(apart).mean() < 0.05  # gray weighs colors otherwise, CMYK and palettes round them
