"""`sgwarp lift`: 2D semantics of posed views into a scene."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sgwarp.commands.effects import say_unused
from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import SceneOptions, check_name, find_views, place_views
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Gaussians, Semantics, View
    from sgwarp.viewer.live import Live
    from sgwarp.viewer.workbench import Workbench

OF_VIEWS = (
    *("transform", "cache", "cache_limit", "mode", "tau", "border", "passes", "ridge", "iterations"),
    *("reliability", "fill", "share_of_views", "photographs", "deterministic", "images", "view"),
)


@dataclass(kw_only=True)
class Lift(SceneOptions):
    """Lift the 2D semantics of posed views into the Gaussians of a scene."""

    views: Path
    """Posed photographs: a folder with transforms.json or a COLMAP model."""

    transform: Path | None = None
    """Where the views lie in another world than the scene: the transform between them, such as the
    dataparser_transforms.json of the trainer that moved the scene."""

    out: Path
    """Semantics file to write, .safetensors; run.json goes beside it."""

    encoder: str = "conse"
    """Where the 2D semantics come from, such as conse, clip:PATH+sam:PATH or files:DIR; `sgwarp encoders` lists all."""

    cache: str = ""
    """Folder in which feature maps are kept, so that the same views are encoded once; none for no cache. If not given,
    $SGWARP_CACHE, or where caches belong on this platform (~/.cache/sgwarp/maps)."""

    cache_limit: float = 10.0
    """Size of that folder, at most [gigabytes]: the maps not used for longest go first."""

    mode: Literal["weighted", "center", "squared", "strongest", "robust", "solve"] = "weighted"
    """weighted: all pixels a Gaussian contributes to; center: the pixel of its center, with a depth test; squared: as
    weighted, with squared weights; strongest: only pixels where it contributes most; robust: the median of the views;
    solve: what renders best to the maps."""

    tau: float = 0.05
    """Relative depth tolerance of mode center."""

    border: int = 10
    """Pixels along the image edge that mode center ignores."""

    passes: int = 4
    """Times that mode robust walks over the views after the first."""

    ridge: float = 0.0
    """How strongly mode solve keeps to the weighted mean; 0 chooses it by views that are held out."""

    iterations: int = 4
    """Steps of mode solve."""

    reliability: bool = False
    """Reduce the weight of views that disagree with the others."""

    fill: int = 0
    """Give Gaussians that no view saw the mean of so many seen neighbors; 0 leaves them empty."""

    share_of_views: float = 1.0
    """Use only this share of the views, evenly spread."""

    photographs: bool = True
    """Off: ignore the photographs and render the views from the scene."""

    deterministic: bool = False
    """On CUDA, add up in a fixed order: slower, the same bits every time. The CPU always does."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    view: bool = False
    """Show the scene in the browser while it is lifted, and the result until Ctrl-C."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "--out", [self.out, self.out.parent / LOG]

    def run(self) -> None:
        check_name("--out", self.out, ".safetensors")
        with ExitStack() as stack:
            live = self._run(stack)
            if live is not None:
                live.finish()

    def _run(self, stack: ExitStack) -> Live | None:
        """Lift and write; the viewer that shows it, if one was asked for, closes with the stack."""
        live = None
        with self.logged(self.out.parent) as log:
            from sgwarp.encoders.names import parse
            from sgwarp.io.store import save_semantics

            gaussians = self.load_scene(log)
            source = parse(self.encoder)[0].source
            if source.kind.fused:
                from sgwarp.encoders.building import builder

                say_unused(self, OF_VIEWS, f"{self.encoder} holds features of Gaussians, nothing is lifted")
                semantics = builder(source.kind.fused)(source.argument, gaussians, source.options.get("space"))
                log.error["coverage"] = semantics.coverage
                notes: dict[str, Any] = {"encoder": self.encoder}
            else:
                views = find_views(self.views, photographs=self.photographs, images=self.images)
                with log.stage("compare"):
                    views = place_views(gaussians, self.scene, views, self.transform)
                if self.view:
                    live = self._live(gaussians, views)
                    stack.callback(live.close)
                    log.watch = live.watch
                semantics = self._lift(gaussians, views, log)
                notes = {"encoder": self.encoder, "mode": self.mode, "views": len(views)}
            with log.stage("write"):
                save_semantics(semantics, self.out, notes)
            log.outputs.append(str(self.out))
        return live

    def _lift(self, gaussians: Gaussians, views: list[View], log: RunLog) -> Semantics:
        from sgwarp.encoders.cache import CachedMaps, default_folder
        from sgwarp.encoders.registry import make_encoder
        from sgwarp.lifting.lifter import lift
        from sgwarp.lifting.settings import LiftSettings

        names = ("tau", "border", "passes", "ridge", "iterations", "reliability", "fill")
        options = LiftSettings(**{name: getattr(self, name) for name in names})
        folder = None if self.cache == "none" else self.cache or default_folder()
        with log.stage("load_encoder"):
            source = make_encoder(self.encoder, views, self.device, folder, self.cache_limit)
        with show_progress("lift") as progress:
            semantics = lift(
                gaussians,
                views,
                source,
                self.mode,
                lift_settings=options,
                share_of_views=self.share_of_views,
                deterministic=self.deterministic or None,
                progress=progress,
                log=log,
            )
        if isinstance(source, CachedMaps):
            log.leave_out("views_encoded_before", source.hits)
        return semantics

    def _live(self, gaussians: Gaussians, views: list[View]) -> Live:
        """A viewer that opens with the first view's semantics; asks in words where the encoder has a text side."""
        from sgwarp.encoders.registry import encoder_of_questions
        from sgwarp.viewer.live import Live
        from sgwarp.viewer.workbench import Materials, Workbench

        def begin(semantics: Semantics) -> Workbench:
            text = None
            with suppress(InputError):
                text = encoder_of_questions(self.encoder, semantics.space, self.device)
            return Workbench(Materials(gaussians, semantics, None, text, views=views))

        return Live(begin, Workbench.replace_semantics)
