"""`sgwarp render`: pictures of a scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgwarp.commands.inputs_kept import LOG, keep_photographs
from sgwarp.commands.options import SceneOptions, check_folder, find_views, notices_held_back
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from torch import Tensor

    from sgwarp.scene import Gaussians, View


@dataclass(kw_only=True)
class Render(SceneOptions):
    """Render the views, or a turn around the scene if no views are given."""

    out: Path
    """Folder for {stem}.png, or for one view the name of a .png. Depth is also written as .npy: z per pixel in scene
    units, float32 [H, W], 0 for none."""

    views: Path | None = None
    """Cameras: a folder with transforms.json or a COLMAP model. The photographs need not be there."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    view: str | None = None
    """Only the view of this name."""

    mode: Literal["rgb", "depth", "expected_depth", "alpha"] = "rgb"
    """What to render."""

    background: Literal["black", "white"] = "black"
    """What shows where the scene is transparent."""

    frames: int = 12
    """Views of the turn around the scene."""

    size: tuple[int, int] = (640, 480)
    """Width and height of the turn's views [pixels]."""

    up: Literal["y-down", "y-up", "z-up", "z-down"] = "y-down"
    """Direction of the scene's axes, for the turn: y-down for most scenes from photographs."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        if self.out.suffix == ".png":
            yield "--out", [self.out, self.out.with_suffix(".npy"), self.out.parent / LOG]
        else:
            yield "--out", [self.out / LOG]

    def run(self) -> None:
        folder = self.out.parent if self.out.suffix == ".png" else self.out
        check_folder("--out", folder)
        if self.view is not None and self.views is None:
            raise InputError(f"--view {self.view}: needs --views, the folder that holds it")
        with self.logged(folder) as log:
            from sgwarp.rendering.renderer import render

            gaussians = self.load_scene(log)
            views = self._views(gaussians)
            if folder != self.out and len(views) > 1:
                raise InputError(f"--out {self.out}: is one file for {len(views)} views; name a folder, or one --view")
            background = gaussians.means.new_ones(3) if self.background == "white" else None
            with show_progress("render") as progress:
                progress(0, len(views), "")
                for done, view in enumerate(views, start=1):
                    with log.stage("render"):
                        image = render(gaussians, view.camera, self.mode, background=background, log=log)
                    with log.stage("write"):
                        log.outputs += self._write(self._picture(view), image.cpu())
                    progress(done, len(views), view.stem)

    def _picture(self, view: View) -> Path:
        return self.out if self.out.suffix == ".png" else self.out / f"{view.stem}.png"

    def _views(self, gaussians: Gaussians) -> list[View]:
        if self.views is None:
            from sgwarp.rendering.orbits import orbit_views

            return orbit_views(gaussians, self.frames, *self.size, up=self.up)
        try:
            views = find_views(self.views, self.view, photographs=False)
        except InputError:
            # A file that gives no image size needs the photographs after all; else this fails for the same reason.
            views = find_views(self.views, self.view, images=self.images)
        return self._placed(gaussians, views)

    def _placed(self, gaussians: Gaussians, views: list[View]) -> list[View]:
        """The views in the world of the scene; compared with their photographs, if these are there."""
        from sgwarp.io.world_transforms import moved_views
        from sgwarp.rendering.agreement import find_placement
        from sgwarp.scene.extent import with_near_plane_of

        assert self.views is not None
        try:
            with notices_held_back():  # those of the same views have been shown
                photographed = find_views(self.views, images=self.images)
        except InputError:
            photographed = views
            self._keep_photographs_of(views)
        keep_photographs("--out", map(self._picture, views), photographed)
        drawn = {view.stem for view in views}
        compared = [view for view in photographed if view.stem in drawn] or views
        views, compared = (with_near_plane_of(group, gaussians) for group in (views, compared))
        matrix = find_placement(gaussians, self.scene, compared, self.transform)
        return views if matrix is None else moved_views(views, matrix)

    def _keep_photographs_of(self, views: list[View]) -> None:
        """Some photographs are missing, so that nobody says which files the others are: those beside which no log of an
        earlier run lies, in the folder of the views."""
        assert self.views is not None
        for picture in map(self._picture, views):
            inside = picture.exists() and picture.resolve().is_relative_to(self.views.resolve())
            if inside and not (picture.parent / LOG).is_file():
                raise InputError(f"--out {picture}: may be a photograph of --views; choose another place")

    def _write(self, path: Path, image: Tensor) -> list[str]:
        """The picture, and for depth the numbers; returns their paths."""
        import numpy as np

        from sgwarp.files.atomic import atomic_path
        from sgwarp.files.images import write_rgb
        from sgwarp.visualization.pictures import depth_picture

        if self.mode in ("rgb", "alpha"):
            write_rgb(path, image if self.mode == "rgb" else image[..., None].expand(-1, -1, 3))
            return [str(path)]
        numbers = path.with_suffix(".npy")
        with atomic_path(numbers) as temporary:
            np.save(temporary, image.numpy())
        write_rgb(path, depth_picture(image))
        return [str(path), str(numbers)]
