"""`sgwarp convert`: a scene in another format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from sgwarp.commands.options import Options, check_folder
from sgwarp.errors import InputError

if TYPE_CHECKING:
    from sgwarp.scene import Gaussians


@dataclass(kw_only=True)
class Convert(Options):
    """Write a scene in the format that the name of the output ends in.

    Read are .ply (3DGS, 2DGS, PlayCanvas compressed), .spz (versions 1 to 4), .splat, .glb and .gltf
    (KHR_gaussian_splatting) and .sog; written are .ply, .compressed.ply, .spz, .splat and .glb.
    """

    scene: tyro.conf.Positional[Path]
    """Scene to read."""

    out: tyro.conf.Positional[Path]
    """Scene to write."""

    axes: str | None = None
    """Directions of the input's axes x, y, z, such as rdf (right, down, forward) or rub (right, up, back). If not
    given, what its format says: rdf for .ply, .splat and .sog, rub for .spz, luf for glTF. Several tools write .spz
    with the axes of .ply: if the scene comes out upside down, say rdf."""

    out_axes: str | None = None
    """Directions of the output's axes; if not given, what its format says."""

    spz_version: int = 4
    """Version of .spz to write: 2, 3, or 4 (needs zstandard)."""

    plain: bool = False
    """Leave out columns that are not those of a 3DGS scene, which some viewers refuse."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "out", [self.out]

    def run(self) -> None:
        check_folder("--out", self.out.parent)
        self.require_writable()
        log = self.start()
        with log.stage("read"):
            from dataclasses import replace

            from sgwarp.io.scenes import load_gaussians

            gaussians = load_gaussians(self.scene, self.axes)
            if self.plain:
                gaussians = replace(gaussians, extras=None)
        with log.stage("write"):
            self._write(gaussians)
        before, after = self.scene, self.out
        print(f"{len(gaussians)} Gaussians, {_size(before)} -> {_size(after)}; {log.summary()}")

    def require_writable(self) -> None:
        """Refuse a name that no format has before anything is read."""
        from sgwarp.io.scenes import WRITTEN, find_writer

        if find_writer(self.out) is None:
            raise InputError(f"{self.out}: scenes are written as {WRITTEN}; change the name")

    def _write(self, gaussians: Gaussians) -> None:
        from sgwarp.io.formats.axes import parse_axes
        from sgwarp.io.formats.spz import write_spz
        from sgwarp.io.scenes import SPZ, find_writer, save_gaussians

        if find_writer(self.out) is SPZ:
            write_spz(gaussians, self.out, self.spz_version, parse_axes(self.out_axes or SPZ.axes))
        else:
            save_gaussians(gaussians, self.out, self.out_axes)


def _size(path: Path) -> str:
    """Bytes of a file, or of the files of a folder, to be read."""
    files = [path] if path.is_file() else [file for file in path.iterdir() if file.is_file()]
    size = float(sum(file.stat().st_size for file in files))
    return f"{size / 1e6:.2f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"
