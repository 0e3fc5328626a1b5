"""`sgwarp predict`: semantics of a scene from its Gaussians alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import SceneOptions, check_name, load_on, require_no_lift

if TYPE_CHECKING:
    from sgwarp.runs.log import RunLog
    from sgwarp.scene import Gaussians, Semantics


@dataclass(kw_only=True)
class Predict(SceneOptions):
    """Predict the semantics of every Gaussian with a trained network; no views are needed."""

    net: Path
    """Network that `sgwarp distill` wrote, or a checkpoint of MinkowskiEngine, OpenScene or the paper."""

    out: Path
    """Semantics file to write, .safetensors; run.json goes beside it."""

    projection: Path | None = None
    """What `sgwarp lift` wrote for this scene: the network then only fills in the Gaussians that no view saw, and is
    left out where the views cover the scene."""

    always: bool = False
    """Run the network even if the projection covers the scene."""

    inputs: Literal["full", "xyz-rgb", "raw56", "ones", "signed-rgb"] | None = None
    """Inputs that a checkpoint was trained with, which its file does not store: raw56 for the paper's; for OpenScene's
    ones, or signed-rgb if trained with input_color. If not given, the only ones with its number of channels."""

    voxel: float | None = None
    """Side of a voxel [m] that a checkpoint was trained with, which its file does not store; 0.02 if not given."""

    space: str | None = None
    """Embedding space of a checkpoint, which its file does not store; its file name if not given."""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        yield "--out", [self.out, self.out.parent / LOG]

    def run(self) -> None:
        check_name("--out", self.out, ".safetensors")
        require_no_lift(self.out)
        with self.logged(self.out.parent) as log:
            from sgwarp.io.store import save_semantics

            gaussians = self.load_scene(log)
            semantics = self._semantics(gaussians, log)
            with log.stage("write"):
                save_semantics(
                    semantics, self.out, {"network": str(self.net), "projection": self.projection is not None}
                )
            log.outputs.append(str(self.out))

    def _semantics(self, gaussians: Gaussians, log: RunLog) -> Semantics:
        from sgwarp.network.prediction import predict
        from sgwarp.network.quality import filled, projection_quality
        from sgwarp.network.semantic_network import load_network

        projected = None
        if self.projection is not None:
            with log.stage("read"):
                projected = load_on(self.projection, gaussians)
            quality = projection_quality(projected)
            log.error |= quality._asdict()
            if quality.suffices() and not self.always:
                log.leave_out("network")
                return projected
        with log.stage("load_network"):
            network = load_network(self.net, inputs=self.inputs, voxel=self.voxel, space=self.space).to(self.device)
        predicted = predict(gaussians, network, log=log).semantics()
        return predicted if projected is None else filled(projected, predicted)
