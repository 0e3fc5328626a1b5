"""`sgwarp info`: what a scene and its semantics hold, or what a data set has and lacks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgwarp.commands.options import SceneOptions
from sgwarp.errors import InputError

if TYPE_CHECKING:
    from sgwarp.scene import Gaussians

BINS = 10


@dataclass(kw_only=True)
class Info(SceneOptions):
    """Print what a scene holds: count, bounds, harmonics, opacities, rows that cannot be rendered; its semantics.

    Of a moving scene (params.npz, a folder of .ply files): frames, identity of the Gaussians, and how much moves.
    Of a data set: its scenes, their photographs and labels, and what is missing.
    """

    semantics: Path | None = None
    """What `sgwarp lift` wrote for this scene."""

    data_set: str | None = None
    """Read the folder as this data set; found out by its files if not given."""

    json: bool = False
    """Print JSON instead of lines."""

    def run(self) -> None:
        log = self.start()
        facts = self._data_set_facts()
        if facts is not None:
            self._show(facts)
            return
        if self.scene.suffix == ".npz" or self.scene.is_dir():
            self._show(self._sequence_facts())
            return
        gaussians = self.load_scene(log)
        from sgwarp.io.scenes import find_format

        form = find_format(self.scene)
        facts = {"scene": str(self.scene), "format": form.name, **scene_facts(gaussians)}
        if self.semantics is not None:
            facts["semantics"] = semantics_facts(self.semantics, gaussians)
        self._show(facts)

    def _data_set_facts(self) -> dict[str, Any] | None:
        """Scenes of a data set; None if the path is none.

        Raises:
            InputError: It is not the data set that was named.
        """
        from sgwarp.datasets.catalogue import describe_data_set, detect_reader, find_reader

        if self.data_set is not None:
            reader = find_reader(self.data_set)
            if not reader.list_scenes(self.scene):
                raise InputError(f"{self.scene}: holds no scene of '{reader.NAME}'; expected {reader.ABOUT}")
            return describe_data_set(self.scene, reader)
        if not self.scene.is_dir() or (self.scene / "params.npz").is_file() or self.semantics is not None:
            return None
        found = detect_reader(self.scene)
        return None if found is None else describe_data_set(self.scene, found)

    def _sequence_facts(self) -> dict[str, Any]:
        """Frames, identity and motion of a moving scene.

        Raises:
            InputError: It cannot be read, or semantics are asked for, which belong to one scene.
        """
        from sgwarp.apps.tracking.facts import sequence_facts
        from sgwarp.io.sequences import load_sequence

        if self.semantics is not None:
            raise InputError(f"--semantics: belong to one scene, {self.scene} is a sequence of them; leave it out")
        return {"scene": str(self.scene), **sequence_facts(load_sequence(self.scene))}

    def _show(self, facts: dict[str, Any]) -> None:
        print(json.dumps(facts, indent=2) if self.json else "\n".join(lines(facts)))


def scene_facts(gaussians: Gaussians) -> dict[str, Any]:
    """Count, bounds of the finite centres [scene units], SH degree, rows left out, histogram of opacity."""
    import torch

    kept = gaussians.subset(gaussians.finite)
    extremes = [kept.means.amin(dim=0).tolist(), kept.means.amax(dim=0).tolist()] if len(kept) else None
    return {
        "gaussians": len(gaussians),
        "bounds": extremes,
        "median_scale": float(kept.scales.median()) if len(kept) else None,
        "sh_degree": gaussians.sh_degree,
        "non_finite_rows": gaussians.non_finite,
        "opacity_histogram": torch.histc(kept.opacities.cpu(), bins=BINS, min=0.0, max=1.0).int().tolist(),
        "fingerprint": gaussians.fingerprint,
        "other_columns": sorted(gaussians.extras) if gaussians.extras else None,
    }


def semantics_facts(path: Path, gaussians: Gaussians) -> dict[str, Any]:
    """Space, channels, share of the Gaussians that were seen and their mean effective views, notes of the lift."""
    from sgwarp.io.store import load_semantics, read_notes

    semantics = load_semantics(path, gaussians)
    views = semantics.effective_views[semantics.seen]
    return {
        "file": str(path),
        "space": semantics.space,
        "channels": semantics.features.shape[1],
        "coverage": semantics.coverage,
        "mean_effective_views": float(views.mean()) if len(views) else 0.0,
        "labels": list(semantics.labels) if semantics.labels is not None else None,
        "notes": read_notes(path),
    }


def lines(facts: dict[str, Any], indent: str = "") -> list[str]:
    """The facts, one a line, nested ones indented."""
    text = []
    for name, value in facts.items():
        title = f"{indent}{name.replace('_', ' ')}:"
        if name == "opacity_histogram":
            text += [title, *histogram_lines(value, indent + "  ")]
        elif name == "bounds" and value is not None:
            low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in value)
            text.append(f"{title} ({low}) to ({high})")
        elif isinstance(value, dict):
            text += [title, *lines(value, indent + "  ")]
        elif value is not None:
            shown = ", ".join(map(str, value)) if isinstance(value, list) else value
            text.append(f"{title} {shown:.4g}" if isinstance(shown, float) else f"{title} {shown}")
    return text


def histogram_lines(counts: list[int], indent: str) -> list[str]:
    """A bar per bin of opacity."""
    most = max(*counts, 1)
    return [
        f"{indent}{k / BINS:.1f}-{(k + 1) / BINS:.1f} {'#' * round(40 * count / most):40} {count}"
        for k, count in enumerate(counts)
    ]
