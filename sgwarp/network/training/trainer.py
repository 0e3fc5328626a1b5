"""The training loop: loss 1 - cos(s3D, s2D) over voxels, AdamW, cosine schedule, exact resume.

Whatever is random in an epoch follows from (seed, epoch, scene) alone. So a run that was interrupted goes on as if it
had not been, and several processes see the same scenes as one.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgwarp.errors import InputError
from sgwarp.files.inputs import own_files
from sgwarp.files.torch_files import load_torch, save_torch
from sgwarp.metrics.segmentation import ConfusionMatrix
from sgwarp.network.checkpoint import load_into, read_weights
from sgwarp.network.inputs import INPUT_CHANNELS
from sgwarp.network.layers.mink_unet import MinkUNet
from sgwarp.network.prediction import predict
from sgwarp.network.semantic_network import SemanticNetwork
from sgwarp.network.training.contrastive import MaskRows, contrastive_loss, mask_rows
from sgwarp.network.training.data import CHUNK, Example, TrainingScene, make_example
from sgwarp.network.training.processes import Processes
from sgwarp.network.training.settings import DistillSettings, Epoch
from sgwarp.runs.isolation import isolated
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import Report
from sgwarp.scene import Semantics


@isolated
def distill(
    scenes: Sequence[TrainingScene],
    settings: DistillSettings | None = None,
    *,
    validation: Sequence[TrainingScene] = (),
    class_vectors: Tensor | None = None,
    weights: dict[str, Tensor] | str | os.PathLike[str] | None = None,
    state: Path | None = None,
    processes: Processes | None = None,
    device: str | torch.device = "cpu",
    progress: Report | None = None,
    log: RunLog | None = None,
) -> tuple[SemanticNetwork, list[Epoch]]:
    """Train a network to say of raw Gaussians what the projection says of them.

    Args:
        scenes: What to learn from, all with semantics of one space.
        settings: See DistillSettings.
        validation: Scenes to measure on and not to learn from.
        class_vectors: Vectors of classes for the validation's mIoU, [Q, C]; for labels each label is a class.
        weights: State dict, or the file of one, to start from instead of random weights.
        state: File for what is needed to go on after an interruption, written after every epoch; if it is there
            already, the run goes on from it.
        processes: Those of torchrun; `settings.scenes_per_step` must be a multiple of their number.
        device: Where to compute.
        progress: Called as `progress(done, total, figures)` after every scene.
        log: Receives the times and the last epoch's figures.

    Returns:
        The network, and the figures of every epoch.

    Raises:
        InputError: There are no scenes, they differ in space, a file does not fit, or the state is another run's.
    """
    settings = settings or DistillSettings()
    processes = processes or Processes()
    if not scenes:
        raise InputError("there are no scenes to learn from")
    if settings.scenes_per_step % processes.count:
        raise InputError(
            f"scenes_per_step: {settings.scenes_per_step} scenes cannot be shared by {processes.count} processes; "
            f"take a multiple of {processes.count}"
        )
    log = log if log is not None else RunLog(device=str(device))
    with log.stage("read"):
        kind = _kind(scenes[0].load()[1], scenes[0].name)
    run = _Run(settings, kind, class_vectors, processes, torch.device(device), log)
    run.data = _identity(scenes, validation)
    if weights is not None:
        run.start_from(weights)
    if state is not None and state.exists():
        run.restore(state)
    report = progress or (lambda done, total, figures: None)
    for epoch in range(len(run.history), settings.epochs):
        run.epoch(epoch, scenes, validation, report)
        if state is not None and processes.leads:
            run.save(state)
    last = run.history[-1]
    for name in ("loss", "cosine", "miou"):
        if getattr(last, name) is not None:
            log.error[name] = getattr(last, name)
    return run.network, run.history


def _identity(*groups: Sequence[TrainingScene]) -> str:
    """Names and stamps of the scenes, as one number."""
    text = repr([[(scene.name, scene.stamp) for scene in scenes] for scenes in groups])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


Kind = tuple[str, int, tuple[str, ...] | None]  # space, channels and labels of the semantics


def _kind(semantics: Semantics, name: str, first: Kind | None = None) -> Kind:
    """Space, channels and labels of a scene's semantics; the same for all scenes."""
    kind = semantics.space, semantics.features.shape[1], semantics.labels
    for what, mine, wanted in zip(("space", "channels", "labels"), kind, first or kind, strict=True):
        if mine != wanted:
            raise InputError(f"{name}: semantics have {what} {mine!r}, the first scene's {wanted!r}; lift all alike")
    return kind


@dataclass(eq=False)
class _Run:
    """Network, optimizer and history of one training run."""

    settings: DistillSettings
    kind: Kind
    class_vectors: Tensor | None
    processes: Processes
    device: torch.device
    log: RunLog
    network: SemanticNetwork = field(init=False)
    optimizer: torch.optim.AdamW = field(init=False)
    history: list[Epoch] = field(default_factory=list)
    data: str = ""  # which scenes
    first_weights: str = ""  # which weights the run started from, if not from random ones

    def __post_init__(self) -> None:
        s, (space, channels, labels) = self.settings, self.kind
        with torch.random.fork_rng():
            torch.manual_seed(s.seed)
            net = MinkUNet(INPUT_CHANNELS[s.inputs], channels, s.arch).to(self.device)
        self.network = SemanticNetwork(net, s.inputs, s.voxel, space, labels)
        self.optimizer = torch.optim.AdamW(
            net.parameters(), lr=s.learning_rate, weight_decay=s.weight_decay, fused=self._fused
        )

    @property
    def _fused(self) -> bool | None:
        """Whether the optimizer takes its step in one launch for all parameters: on CUDA; on the CPU torch decides."""
        return True if self.device.type == "cuda" else None

    def start_from(self, weights: dict[str, Tensor] | str | os.PathLike[str]) -> None:
        """Take these weights instead of random ones."""
        if isinstance(weights, dict):
            state = weights
            load_into(self.network.net, state, "weights")
        else:
            state = read_weights(weights)
            load_into(self.network.net, state, weights)
        digest = hashlib.sha256()
        for name in sorted(state):
            digest.update(state[name].detach().cpu().float().numpy().tobytes())
        self.first_weights = digest.hexdigest()[:16]

    def epoch(
        self, epoch: int, scenes: Sequence[TrainingScene], validation: Sequence[TrainingScene], report: Report
    ) -> None:
        """Every training scene once, then the validation scenes if it is their turn."""
        start = time.perf_counter()
        s = self.settings
        for group in self.optimizer.param_groups:
            group["lr"] = s.rate(epoch)
        order = torch.randperm(len(scenes), generator=_generator(s.seed, epoch)).tolist()
        total, measured = 0.0, 0.0
        self.network.net.train()
        for first in range(0, len(order), s.scenes_per_step):
            loss, count = self._step(epoch, order[first : first + s.scenes_per_step], scenes)
            total, measured = total + loss, measured + count
            done = epoch * len(scenes) + min(first + s.scenes_per_step, len(scenes))
            figure = f"loss {total / measured:.4f}" if measured else "no target yet"
            report(done, s.epochs * len(scenes), f"epoch {epoch + 1}, {figure}")
        if not measured:
            raise InputError(
                f"{scenes[0].name}: no Gaussian of this scene, or of any other, has a voxel of {s.voxel} m and lifted "
                "features; take larger voxels, or lift from views that see the scenes"
            )
        if measured < len(scenes):
            self.log.left_out["scenes_without_target"] = len(scenes) - int(measured)
        figures: dict[str, float | None] = {}
        if validation and ((epoch + 1) % s.validate_every == 0 or epoch + 1 == s.epochs):
            with self.log.stage("validate"):
                figures = self.validate(validation)
        mean = total / measured
        seconds = time.perf_counter() - start
        self.history.append(Epoch(epoch + 1, s.rate(epoch), mean, seconds, **figures))

    def _step(self, epoch: int, chosen: list[int], scenes: Sequence[TrainingScene]) -> tuple[float, float]:
        """One step of the optimizer; sum of the losses over all processes, and how many scenes had a target.

        The running statistics of the batch normalisations become the mean of what each scene makes of them, so that
        they, too, do not depend on the number of processes.
        """
        net = self.network.net
        figures = torch.zeros(2, dtype=torch.float64, device=self.device)
        statistics = [buffer for buffer in net.buffers() if buffer.is_floating_point()]
        before, sums = ([torch.empty_like(buffer) for buffer in statistics] for _ in range(2))
        torch._foreach_copy_(before, statistics)
        torch._foreach_zero_(sums)
        self.optimizer.zero_grad()
        for index in chosen[self.processes.rank :: self.processes.count]:
            with self.log.stage("prepare"):
                generator = _generator(self.settings.seed, epoch, index)
                example = self._example(scenes[index], generator)
                masks = self._masks(scenes[index], example, generator)
            if not (masks if masks is not None else len(example.rows)):
                continue
            with self.log.stage("train"):
                torch._foreach_copy_(statistics, before)
                loss = self._loss(example, masks)
                loss.backward()
                torch._foreach_add_(sums, statistics)
            figures += torch.tensor([float(loss.detach()), 1.0], dtype=torch.float64, device=self.device)
        self.processes.add_up([figures])
        count = float(figures[1])
        if not math.isfinite(float(figures[0])):
            names = ", ".join(scenes[index].name for index in chosen)
            raise InputError(
                f"{names}: the loss is not finite in epoch {epoch + 1}; lower the learning rate, or look for Gaussians "
                "with extreme values. The state file, if there is one, holds the epoch before"
            )
        if count:
            with self.log.stage("train"):
                # Processes add up the gradients of all, also of one without a target.
                for parameter in net.parameters():
                    if parameter.grad is None:
                        parameter.grad = torch.zeros_like(parameter)
                gradients = [p.grad for p in net.parameters() if p.grad is not None]
                self.processes.add_up([*gradients, *sums])
                torch._foreach_div_([*gradients, *sums], count)
                torch._foreach_copy_(statistics, sums)
                self.optimizer.step()
        return float(figures[0]), count

    def _example(self, scene: TrainingScene, generator: torch.Generator) -> Example:
        gaussians, semantics = scene.load()
        _kind(semantics, scene.name, self.kind)
        s = self.settings
        return make_example(
            gaussians.to(self.device),
            semantics,
            s.inputs,
            s.voxel,
            augment=s.augment,
            generator=generator,
            by_reliability=s.by_reliability,
        )

    def _masks(self, scene: TrainingScene, example: Example, generator: torch.Generator) -> list[MaskRows] | None:
        """Masks of some views at random, for the contrastive loss; None for the other."""
        s = self.settings
        if s.loss == "cosine":
            return None
        if scene.masks is None:
            raise InputError(f"{scene.name}: the contrastive loss needs the masks of its views")
        gaussians = scene.load()[0].to(self.device)
        views = scene.masks()
        chosen = torch.randperm(len(views), generator=generator)[: s.views_per_step].tolist()
        found = [mask_rows(gaussians, example.of_gaussians, views[k](), s.contributors) for k in chosen]
        return [rows for rows in found if len(rows.vectors)]

    def _loss(self, example: Example, masks: list[MaskRows] | None = None) -> Tensor:
        """Mean of 1 - cosine over the voxels that have a target (paper, Sec. III-C), weighted if asked for; with masks
        the mean contrastive loss of their views."""
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.settings.half):
            predicted = self.network.net(example.voxels).features.float()
        if masks is not None:
            losses = [contrastive_loss(predicted, rows, self.settings.temperature) for rows in masks]
            return torch.stack(losses).mean()
        cosine = torch.nn.functional.cosine_similarity(predicted[example.rows], example.targets, dim=1)
        return ((1.0 - cosine) * example.weights).sum() / example.weights.sum()

    def validate(self, scenes: Sequence[TrainingScene]) -> dict[str, float | None]:
        """Cosine and mIoU against the projection over the Gaussians that it has seen, of all scenes together."""
        _, channels, labels = self.kind
        vectors = torch.eye(channels) if labels is not None else self.class_vectors
        sums = torch.zeros(2, dtype=torch.float64)
        confusion = None if vectors is None else ConfusionMatrix.empty(len(vectors))
        for scene in scenes[self.processes.rank :: self.processes.count]:
            gaussians, semantics = scene.load()
            _kind(semantics, scene.name, self.kind)
            prediction = predict(gaussians, self.network)
            known = (semantics.seen.cpu() & prediction.known.cpu()).nonzero()[:, 0]
            for part in known.split(CHUNK):
                rows = prediction.rows[part.to(prediction.rows.device)]
                ours = (prediction.hidden[rows] @ prediction.matrix).cpu()
                theirs = semantics.features[part.to(semantics.features.device)].cpu().to(torch.float32)
                finite = torch.isfinite(theirs).all(dim=1)
                ours, theirs = ours[finite], theirs[finite]
                cosine = torch.nn.functional.cosine_similarity(ours, theirs, dim=1)
                sums += torch.tensor([float(cosine.double().sum()), len(ours)], dtype=torch.float64)
                if confusion is not None and vectors is not None:
                    confusion.add((ours @ vectors.T).argmax(dim=1), (theirs @ vectors.T).argmax(dim=1))
        sums = sums.to(self.device)
        self.processes.add_up([sums])
        figures: dict[str, float | None] = {"cosine": float(sums[0] / sums[1]) if sums[1] else None}
        if confusion is not None:
            counts = confusion.counts.to(self.device)
            self.processes.add_up([counts])
            confusion.counts = counts.cpu()
            figures["miou"] = confusion.miou if bool(counts.any()) else None
        self.network.net.train()
        return figures

    def save(self, path: Path) -> None:
        """Write what `restore` needs."""
        content = {
            "settings": self._signature(),
            "net": self.network.net.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "history": [asdict(epoch) for epoch in self.history],
        }
        save_torch(path, content)

    def restore(self, path: Path) -> None:
        """Go on where `save` left off.

        Raises:
            InputError: The file is no such state, or was written with other settings.
        """
        try:
            with own_files():
                content = load_torch(path)
            stored: dict[str, Any] = content["settings"]
            mine = self._signature()
            changed = [name for name in mine if mine[name] != stored.get(name)]
            if changed:
                values = f"{stored.get(changed[0])!r}, now {mine[changed[0]]!r}"
                raise InputError(
                    f"{path}: is of a run with another {changed[0]} ({values}); remove it, or ask for the same"
                )
            self.network.net.load_state_dict(content["net"])
            for group in content["optimizer"]["param_groups"]:
                group["fused"] = self._fused  # of this device, not of the one that wrote the state
            self.optimizer.load_state_dict(content["optimizer"])
            self.history = [Epoch(**epoch) for epoch in content["history"]]
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
            raise InputError(f"{path}: is no training state, or damaged ({type(error).__name__}); remove it") from None
        self.log.leave_out("epochs_done_before", len(self.history))

    def _signature(self) -> dict[str, Any]:
        """Settings and kind in plain types: what must not change between the parts of a run."""
        space, channels, labels = self.kind
        plain = asdict(self.settings) | {"space": space, "channels": channels, "labels": list(labels or ())}
        augment = plain.pop("augment")
        return plain | {"augment": repr(augment), "scenes": self.data, "first weights": self.first_weights}


def _generator(*numbers: int) -> torch.Generator:
    """Random numbers that depend on all of `numbers`."""
    mixed = 0
    for number in numbers:
        mixed = (mixed * 1_000_003 + number + 1) % 2**62
    return torch.Generator().manual_seed(mixed)


def state_path(out: str | os.PathLike[str]) -> Path:
    """Path of the state of a run that writes the network `out`."""
    return Path(out).with_suffix(".state.pt")
