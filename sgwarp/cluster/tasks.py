"""What a worker is told, and what it answers: plain values, so that they travel as JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from importlib import import_module
from typing import Any, Literal, TypeAlias

OUT = "{out}"  # in arguments: the folder that a scene is worked on in

Status: TypeAlias = Literal["done", "skipped", "failed", "held"]


@dataclass(frozen=True)
class Stage:
    """One command on one scene.

    Attributes:
        name: Of the command.
        arguments: As on its command line, with `OUT` for the folder of results.
    """

    name: str
    arguments: tuple[str, ...]


@dataclass(frozen=True)
class Limits:
    """What a scene may take.

    Attributes:
        seconds: Wall clock; None for no limit.
        memory: Resident bytes of the process; None for no limit.
    """

    seconds: float | None = None
    memory: int | None = None


@dataclass(frozen=True)
class Task:
    """One scene.

    Attributes:
        name: Of the scene.
        folder: Folder of all results; this scene's go to folder/name.
        stages: What to do, in order.
        inputs: Files and folders that the results depend on.
        runner: "module:function" that does a stage: `run(stage, arguments) -> None`, with `OUT` replaced.
        run: Of the driver's start; what failed in it is not tried again in it.
        limits: What the scene may take.
        common: Arguments of every stage that do not change the results, such as the number of threads.
        retry: Try again what failed in an earlier run.
        measure: "module:function" that says how large a scene was: `measure(stages) -> {"gaussians": N, "views": V}`,
            given the arguments by stage with `OUT` replaced; nothing is measured if empty.
        fault: Why nothing can be done with this scene, found before the start; recorded when it is its turn.
    """

    name: str
    folder: str
    stages: tuple[Stage, ...]
    inputs: tuple[str, ...]
    runner: str
    run: str
    limits: Limits = Limits()
    common: tuple[str, ...] = ()
    retry: bool = False
    measure: str = ""
    fault: str = ""

    @property
    def options(self) -> dict[str, list[str]]:
        """Arguments by stage, as they are recorded and compared."""
        return {stage.name: list(stage.arguments) for stage in self.stages}

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Task:
        stages = tuple(Stage(stage["name"], tuple(stage["arguments"])) for stage in values["stages"])
        tuples = {name: tuple(values[name]) for name in ("inputs", "common")}
        return cls(**{**values, **tuples, "stages": stages, "limits": Limits(**values["limits"])})


@dataclass(frozen=True)
class Outcome:
    """What became of a scene.

    Attributes:
        name: Of the scene.
        status: "skipped" if it was done before, "held" if another process is at it.
        error: One line, if it failed.
        seconds: By stage; empty if it failed.
        peak_memory: Resident bytes, of the scene.
        figures: The error figures of its commands, by stage.
        size: How many Gaussians and views, as far as they are known.
    """

    name: str
    status: Status
    error: str = ""
    seconds: dict[str, float] = field(default_factory=dict)
    peak_memory: int = 0
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)
    size: dict[str, int] = field(default_factory=dict)


Engine: TypeAlias = Callable[[Iterable[Task]], Iterator[Outcome]]  # outcomes come as scenes end, in any order


def named_function(path: str) -> Callable[..., Any]:
    """The function behind "module:function"."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)
