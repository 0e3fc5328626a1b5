"""`sgwarp batch`: other commands, on many scenes."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from sgwarp.commands.inputs_kept import LOG
from sgwarp.commands.options import check_folder
from sgwarp.errors import InputError
from sgwarp.runs.log import RunLog
from sgwarp.runs.progress import show_progress

if TYPE_CHECKING:
    from sgwarp.cluster.listing import Scene
    from sgwarp.cluster.summary import Tally
    from sgwarp.cluster.tasks import Engine, Stage, Task
    from sgwarp.commands.scene_stages import Plan

LOOKS = 16  # threads that look at what is done: network file systems answer slowly
MEASURE = "sgwarp.commands.scene_size:measure"
PREPARE = "sgwarp.commands.scene_stages:prepare"
WARM = "sgwarp.commands.scene_stages:warm"


@dataclass(kw_only=True)
class Batch:
    """Run commands on many scenes: what is done is skipped, what changed is done again, what fails stops nothing.

    Results of a scene lie in OUT/SCENE: scene.ply, scene.safetensors (lifted), predicted.safetensors, labels,
    instances.safetensors, renders, and done.json. A table of all scenes is summary.csv. The exit code is 1 if a scene
    failed.
    """

    scenes: tyro.conf.Positional[str]
    """A folder of scenes, a pattern in quotes, a .txt file of paths, or a .csv file with a column `path`."""

    do: str
    """What to do with each, separated by commas: fit, lift, predict, segment, instances,
    render, evaluate."""

    out: Path
    """Folder of the results, one folder per scene."""

    options: tuple[str, ...] = ()
    """Options of the commands, such as fit.steps=7000 lift.encoder=files:{path}/labels; {path} is the scene's in the
    list, {scene} its name. Columns of a .csv list named so hold for one scene."""

    engine: Literal["local", "ray"] = "local"
    """local: processes on this machine. ray: a Ray cluster, or Ray on this machine."""

    address: str | None = None
    """Address of a Ray cluster; if not given, Ray is started on this machine and reachable from it alone."""

    shard: str | None = None
    """i/n: only every n-th scene from the i-th on, counted from 0; for array jobs."""

    workers: int = 1
    """Scenes at a time."""

    threads: int | None = None
    """Host threads of each worker; if not given, the cores of this machine divided by the workers."""

    device: str = "cpu"
    """Where to compute: cpu, cuda or cuda:N."""

    gpus: float | None = None
    """With Ray, GPUs reserved for each worker, such as 0.5; if not given, 1 on CUDA."""

    retry_failed: bool = False
    """Try again what failed before; otherwise it is tried again once its inputs or options have changed."""

    time_limit: float | None = None
    """Longest time that a scene may take [seconds]."""

    memory_limit: float | None = None
    """Largest resident memory that a scene may take [gigabytes]."""

    command_line: tyro.conf.Suppress[str] = ""

    def written(self) -> Iterator[tuple[str, list[Path]]]:
        folder = self.out / "shards" / self.shard.replace("/", "-of-") if self.shard is not None else self.out
        yield "--out", [folder / name for name in ("summary.csv", "summary.png", LOG)]

    def run(self) -> int:
        """Returns the exit code."""
        from sgwarp.cluster.listing import list_scenes, shard_of
        from sgwarp.cluster.plot import write_plot
        from sgwarp.cluster.records import check_apart
        from sgwarp.cluster.summary import Tally, table, write_table

        self._check()
        scenes = list_scenes(self.scenes, self.out)
        chosen = shard_of(scenes, self.shard) if self.shard is not None else scenes
        tasks = self._tasks(chosen)
        check_apart(tasks, self.out, {scene.name for scene in scenes})
        self.out.mkdir(parents=True, exist_ok=True)  # a system that refuses it does so before the work
        log = RunLog(command=self.command_line, device=self.device, threads=self._threads())
        tally = Tally()
        with log.stage("batch", wait=False):
            self._do(tasks, tally)
        folder = self.out / "shards" / self.shard.replace("/", "-of-") if self.shard is not None else self.out
        folder.mkdir(parents=True, exist_ok=True)
        write_table(tally.outcomes, folder / "summary.csv")
        pictures = write_plot(tally.outcomes, folder / "summary.png")
        for outcome in tally.outcomes:
            for stage, seconds in outcome.seconds.items() if outcome.status == "done" else ():
                log.stages[stage] = log.stages.get(stage, 0.0) + seconds
        log.leave_out("scenes_done_before", tally.count("skipped"))
        log.error |= {"done": tally.count("done"), "failed": tally.count("failed")}
        log.outputs += [str(self.out / outcome.name) for outcome in tally.outcomes if outcome.status != "failed"]
        log.outputs += [str(folder / "summary.csv"), *map(str, pictures)]
        log.write(folder)
        print(table(tally.outcomes))
        return 1 if tally.count("failed") else 0

    def _check(self) -> None:
        check_folder("--out", self.out)
        if self.workers < 1:
            raise InputError(f"--workers: expected 1 or more, got {self.workers}")
        if self.threads is not None and self.threads < 1:
            raise InputError(f"--threads: expected 1 or more, got {self.threads}")
        for name, value in (("time-limit", self.time_limit), ("memory-limit", self.memory_limit)):
            if value is not None and not 0 < value < float("inf"):
                raise InputError(f"--{name}: expected a positive number, got {value}")
        if self.engine == "local" and (self.address is not None or self.gpus is not None):
            raise InputError("--address and --gpus: are for --engine ray")

    def _threads(self) -> int:
        affinity = getattr(os, "sched_getaffinity", None)
        cores = len(affinity(0)) if affinity else os.cpu_count() or 1
        return self.threads or max(1, cores // self.workers)

    def _tasks(self, scenes: Iterable[Scene]) -> list[Task]:
        """Tasks of the scenes; bad options are found before anything is done."""
        from sgwarp.cluster.tasks import OUT, Limits, Task
        from sgwarp.commands.scene_stages import Plan, parse

        pairs = [pair.partition("=") for pair in self.options]
        if wrong := [f"{key}{sign}{value}" for key, sign, value in pairs if not (key and sign)]:
            raise InputError(f"--options: expected option=value, got {wrong[0]!r}")
        names = [one.partition("=")[0] for one in self.options]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise InputError(f"--options: '{twice}' stands there twice; leave one")
        options = {key: value for key, _, value in pairs}
        plan = Plan(tuple(filter(None, self.do.split(","))), options, self.device)
        limits = Limits(self.time_limit, None if self.memory_limit is None else int(self.memory_limit * 1e9))
        fixed: dict[str, Any] = {"folder": str(self.out.absolute()), "runner": "sgwarp.commands.scene_stages:run_stage"}
        fixed |= {"run": secrets.token_hex(8), "limits": limits, "retry": self.retry_failed, "measure": MEASURE}
        common, tasks = ("--threads", str(self._threads())), []
        for scene in scenes:
            stages, inputs, fault = _stages_or_fault(scene, plan)
            tasks.append(Task(scene.name, stages=stages, inputs=inputs, fault=fault, common=common, **fixed))
        whole = next((task for task in tasks if not task.fault), None)
        for stage in whole.stages if whole is not None else ():
            parse(stage.name, [word.replace(OUT, "out") for word in stage.arguments])
        return tasks

    def _engine(self, tasks: list[Task]) -> Engine:
        from sgwarp.cluster.local import Call, LocalEngine

        environment = {"OMP_NUM_THREADS": str(self._threads()), "OMP_WAIT_POLICY": "passive"}
        options = dict(pair.split("=", 1) for pair in self.options)
        encoder = options.get("lift.encoder", options.get("encoder", "conse"))
        warm = Call(WARM, (self.do.split(","), encoder, self.device)) if min(self.workers, len(tasks)) > 1 else None
        if self.engine == "local":
            return LocalEngine(self.workers, Call(PREPARE), warm, environment, self._devices())
        from sgwarp.cluster.ray_engine import RayEngine

        gpus = self.gpus if self.gpus is not None else float(self.device.startswith("cuda"))
        return RayEngine(self.workers, self._threads(), gpus, self.address, Call(PREPARE), warm, environment)

    def _devices(self) -> tuple[str, ...]:
        """CUDA devices that workers share out: with plain cuda and several workers those that this process sees."""
        if self.device != "cuda" or self.workers == 1:
            return ()
        import torch

        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        named = visible.split(",") if visible is not None else map(str, range(torch.cuda.device_count()))
        return tuple(name.strip() for name in named)

    def _do(self, tasks: list[Task], tally: Tally) -> None:
        """Fill the tally: with what is settled first, then with what the engine does."""
        from sgwarp.cluster.working import settled

        with show_progress("batch") as progress, ThreadPoolExecutor(LOOKS) as looks:
            progress(0, len(tasks), "")
            known = list(looks.map(settled, tasks))
            tally.outcomes += [outcome for outcome in known if outcome is not None]
            before = len(tally.outcomes)
            waiting = [task for task, outcome in zip(tasks, known, strict=True) if outcome is None]
            by_name = {task.name: task for task in waiting}
            while waiting:
                held = []  # by another batch in the same folder: asked again after the others
                for outcome in self._engine(waiting)(waiting):
                    if outcome.status == "held":
                        held.append(by_name[outcome.name])
                        continue
                    tally.outcomes.append(outcome)
                    progress(len(tally.outcomes), len(tasks), tally.line(len(tasks), before))
                waiting = held


def _stages_or_fault(scene: Scene, plan: Plan) -> tuple[tuple[Stage, ...], tuple[str, ...], str]:
    """Stages and inputs of a scene, and why there are none: a folder without Gaussians is that scene's fault alone."""
    from sgwarp.cluster.listing import MissingScene
    from sgwarp.commands.scene_stages import stages_of

    try:
        return *stages_of(scene, plan), ""
    except MissingScene as error:
        return (), (str(scene.path),), str(error)
