"""`sgwarp view`: look at a scene in the browser, ask it, edit it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgwarp.commands.options import SceneOptions, find_views, load_on, place_views
from sgwarp.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from sgwarp.encoders.base import TextEncoder
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Gaussians, Semantics
    from sgwarp.scene import View as Viewpoint
    from sgwarp.viewer.workbench import Materials


@dataclass(kw_only=True)
class View(SceneOptions):
    """Look at a scene in the browser, ask it in words, click at objects, edit and save. Ctrl-C ends it."""

    semantics: Path | None = None
    """What `sgwarp lift` wrote for this scene; needed to ask."""

    instances: Path | None = None
    """What `sgwarp instances` wrote for this scene: a click then selects a whole object, or its part."""

    predicted: Path | None = None
    """What `sgwarp predict` wrote for this scene; it is then asked together with the lifted semantics."""

    views: Path | None = None
    """Cameras to start from: a folder with transforms.json or a COLMAP model. The photographs need not be there."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    encoder: str | None = None
    """Encoder of the phrases; if not given, the one that the semantics were lifted with."""

    min_weight: float = 0.0
    """Gaussians with a smaller weight have no say, as if no view had seen them: 1 is one pixel filled by it alone."""

    host: str = "127.0.0.1"
    """Address to listen at. Any but the default lets other machines in; the printed link then holds a token."""

    port: int = 8080
    """Port to listen at; if it is in use, the next free one."""

    def run(self) -> None:
        log = self.start()
        from sgwarp.viewer.server import Address, open_viewer
        from sgwarp.viewer.workbench import Workbench

        viewer = open_viewer(Workbench(self._materials(log)), Address.of(self.host, self.port))
        try:
            viewer.wait()
        except KeyboardInterrupt:  # the way to end it
            print("viewer: ended")
        finally:
            viewer.close()

    def _materials(self, log: RunLog) -> Materials:
        from sgwarp.encoders.registry import image_tower_for
        from sgwarp.io.instances import load_instances
        from sgwarp.io.sequences import is_sequence, load_sequence
        from sgwarp.viewer.workbench import Materials

        sequence = load_sequence(self.scene) if is_sequence(self.scene) else None
        if sequence is None:
            gaussians = self.load_scene(log)
        else:
            gaussians = sequence.frame(0).gaussians.to(self.device)
            if not len(gaussians):
                raise InputError(f"{self.scene}: its first frame holds no Gaussians")
        semantics = None
        if self.semantics is not None:
            semantics = load_on(self.semantics, gaussians).without_faint(self.min_weight)
        predicted = None if self.predicted is None else load_on(self.predicted, gaussians)
        if semantics is None and predicted is not None:
            raise InputError("--predicted: needs --semantics, what `sgwarp lift` wrote for this scene")
        encoder, with_templates = None, None
        if semantics is not None and semantics.labels is None:
            with_templates = self._maker(semantics)
            encoder = with_templates(None)
        return Materials(
            gaussians,
            semantics,
            predicted,
            encoder,
            with_templates,
            None if self.instances is None else load_instances(self.instances, gaussians),
            [] if self.views is None else self._views(gaussians),
            sequence,
            None if encoder is None else image_tower_for(encoder.space, self.device),
        )

    def _maker(self, semantics: Semantics) -> Callable[[str | None], TextEncoder]:
        """What makes the text encoder for prompt templates, None for its own."""
        from sgwarp.encoders.registry import text_encoder_for
        from sgwarp.io.store import read_notes

        assert self.semantics is not None
        name: Any = self.encoder or read_notes(self.semantics).get("encoder")
        return lambda templates: text_encoder_for(
            semantics.space, name, self.device, None if templates is None else (templates,)
        )

    def _views(self, gaussians: Gaussians) -> list[Viewpoint]:
        assert self.views is not None
        try:
            views = find_views(self.views, photographs=False, images=self.images)
        except InputError:
            views = find_views(self.views, images=self.images)
        if self.transform is None and views[0].origin is None:
            return views
        return place_views(gaussians, self.scene, views, self.transform)
