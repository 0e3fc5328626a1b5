"""`sgwarp distill`: train the 3D semantic network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import Options, check_name, require_no_lift
from sgwarp.errors import InputError
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from torch import Tensor

    from sgwarp.network.training.contrastive import MaskedView
    from sgwarp.network.training.data import LoadMasks, TrainingScene
    from sgwarp.network.training.settings import DistillSettings
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import View


@dataclass(kw_only=True)
class Distill(Options):
    """Train a network that predicts semantics from raw Gaussians, on scenes that semantics were lifted for.

    Under torchrun several processes share the scenes of a step. A run that was interrupted goes on from its state file,
    {out}.state.pt, if it is started again with the same options and scenes.
    """

    scenes: tyro.conf.Positional[list[Path]]
    """Scenes {name}.ply with {name}.safetensors beside each, which `sgwarp lift` wrote; folders of them; or the folder
    of results of `sgwarp batch`, whose lifted scenes are taken."""

    out: Path
    """Network to write, .safetensors; its curves and run.json go beside it."""

    validation: list[Path] | None = None
    """Scenes to measure on and not to learn from."""

    classes: str | None = None
    """Names separated by commas, for the validation's mIoU; labels need none."""

    arch: Literal["14A", "18A", "34A", "34C"] = "34A"
    """Architecture of the MinkUNet."""

    inputs: Literal["full", "xyz-rgb", "raw56", "ones", "signed-rgb"] = "full"
    """full: opacity, colour and covariance; xyz-rgb: colour alone; raw56: the 56 numbers of a PLY file; ones,
    signed-rgb: as OpenScene without and with colours."""

    voxel: float = 0.02
    """Side of a voxel [m]."""

    epochs: int = 100
    """Times that every scene is seen."""

    learning_rate: float = 1e-3
    """Learning rate of the first epoch; it falls to 0 along a cosine."""

    scenes_per_step: int = 1
    """Scenes whose gradients are averaged before a step, over all processes."""

    loss: Literal["cosine", "contrastive"] = "cosine"
    """cosine: features of voxels against lifted ones, as in the paper; contrastive: rendered features against masks of
    the views, which lie in the folder {name}/ beside {name}.ply, or where a batch found them."""

    encoder: str = "conse"
    """Encoder of the masks for the contrastive loss, the one that the scenes were lifted with; {views} stands for a
    scene's folder of views, as in files:{views}/labels."""

    images: str | None = None
    """Name of a COLMAP model's folder of photographs, if it is not `images` nor the only one that holds them."""

    views_per_step: int = 2
    """Views of a scene that the contrastive loss looks at in a step."""

    by_reliability: bool = False
    """Weigh a voxel by the weight and the views behind its lifted features."""

    augment: bool = True
    """Turn, scale, mirror, bend and shift the scenes at random."""

    up: Literal["x", "y", "z"] = "z"
    """Axis that points up or down in the scenes."""

    half: bool = False
    """Multiply in bfloat16."""

    seed: int = 0
    """Seed of the first weights, the order of the scenes and their changes."""

    checkpoint: Path | None = None
    """Weights to start from: a network of ours, or a checkpoint of MinkowskiEngine, OpenScene or the paper."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        from sgwarp.network.training.trainer import state_path

        curves = [self.out.with_name(f"{self.out.with_suffix('').name}_curves{suffix}") for suffix in (".json", ".png")]
        yield "--out", [self.out, state_path(self.out), *curves, self.out.parent / LOG]

    def run(self) -> None:
        check_name("--out", self.out, ".safetensors")
        require_no_lift(self.out)
        from sgwarp.network.training.processes import joined

        log = self.start()
        with ExitStack() as held:
            processes = held.enter_context(joined(self.device))
            from sgwarp.encoders.registry import kept_encoders
            from sgwarp.network.semantic_network import save_network
            from sgwarp.network.training.curves import write_curves
            from sgwarp.network.training.data import scenes_in
            from sgwarp.network.training.trainer import distill, state_path

            masks = self._masks_of if self.loss == "contrastive" else None
            if masks is not None:
                held.enter_context(kept_encoders())  # one network for the masks of all scenes
            scenes, validation = scenes_in(self.scenes, masks), scenes_in(self.validation or [])
            settings = self._settings()
            with show_progress("distill") as progress:
                network, history = distill(
                    scenes,
                    settings,
                    validation=validation,
                    class_vectors=self._class_vectors(scenes, log),
                    weights=self.checkpoint,
                    state=state_path(self.out),
                    processes=processes,
                    device=self.device,
                    progress=progress if processes.leads else None,
                    log=log,
                )
            if not processes.leads:
                return
            with log.stage("write"):
                notes = {"scenes": len(scenes), "epochs": settings.epochs, "loss": history[-1].loss}
                save_network(network, self.out, notes)
                curves = write_curves(history, self.out.with_suffix(""))
            state_path(self.out).unlink(missing_ok=True)  # done: started again, a run begins anew
            log.outputs += [str(self.out), *map(str, curves)]
            log.write(self.out.parent)
            print(log.summary())
            print(log.where())

    def _settings(self) -> DistillSettings:
        from sgwarp.network.augmentation import Augmentation
        from sgwarp.network.training.settings import DistillSettings

        return DistillSettings(
            arch=self.arch,
            inputs=self.inputs,
            voxel=self.voxel,
            epochs=self.epochs,
            learning_rate=self.learning_rate,
            scenes_per_step=self.scenes_per_step,
            loss=self.loss,
            views_per_step=self.views_per_step,
            by_reliability=self.by_reliability,
            augment=Augmentation(up="xyz".index(self.up)) if self.augment else None,
            half=self.half,
            seed=self.seed,
        )

    def _masks_of(self, folder: Path) -> list[LoadMasks]:
        """What loads the masks of each view in a folder, in the order of the views."""
        from sgwarp.encoders.cache import default_folder
        from sgwarp.encoders.registry import make_encoder
        from sgwarp.io.views import load_views
        from sgwarp.network.training.contrastive import MaskedView

        views = load_views(folder, self.images)
        source = make_encoder(self.encoder.replace("{views}", str(folder)), views, self.device, default_folder())
        has_map = getattr(source, "has_map", lambda view: True)

        def load(view: View) -> MaskedView:
            return MaskedView(view.camera, source.encode(view, view.image() if source.needs_image else None))

        return [partial(load, view) for view in views if has_map(view)]

    def _class_vectors(self, scenes: list[TrainingScene], log: RunLog) -> Tensor | None:
        """Text vectors of the classes, in the space of the scenes' semantics."""
        if self.classes is None:
            return None
        from sgwarp.commands.segment import class_names
        from sgwarp.encoders.registry import text_encoder_for

        if self.validation is None:
            raise InputError("--classes: are for the validation; name scenes with --validation")
        with log.stage("load_encoder"):
            return text_encoder_for(scenes[0].load()[1].space).encode_text(class_names(self.classes))
