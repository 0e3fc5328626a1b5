"""How the stages of `sgwarp batch` become the other commands: which files each reads and writes, and its options."""

from __future__ import annotations

import io
import logging
import os
import shlex
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import Field, dataclass, fields
from pathlib import Path
from typing import Any

from sgwarp.cluster.listing import Scene
from sgwarp.cluster.tasks import OUT, Stage
from sgwarp.commands.effects import say_without_effect
from sgwarp.commands.evaluate import Evaluate
from sgwarp.commands.fit import Fit
from sgwarp.commands.inputs_kept import guarded
from sgwarp.commands.instances import Instances
from sgwarp.commands.lift import Lift
from sgwarp.commands.options import Options
from sgwarp.commands.predict import Predict
from sgwarp.commands.render import Render
from sgwarp.commands.segment import Segment
from sgwarp.errors import InputError

COMMANDS: dict[str, type[Options]] = {
    "fit": Fit,
    "lift": Lift,
    "predict": Predict,
    "segment": Segment,
    "instances": Instances,
    "render": Render,
    "evaluate": Evaluate,
}
SCENE, LIFTED, PREDICTED = f"{OUT}/scene.ply", f"{OUT}/scene.safetensors", f"{OUT}/predicted.safetensors"
OUTPUTS = {
    "fit": SCENE,
    "lift": LIFTED,
    "predict": PREDICTED,
    "segment": f"{OUT}/labels",
    "instances": f"{OUT}/instances.safetensors",
    "render": f"{OUT}/renders",
    "evaluate": f"{OUT}/evaluation",
}
COMMON = ("views", "scene")  # options of a scene that name its files
FIXED = ("out", "device", "threads", "command_line", "resume", *COMMON)  # not options of a stage
NO_INPUT = ("cache",)  # what lies there does not change the results
PROFILE = "room"  # of an evaluation that names none


@dataclass(frozen=True)
class Plan:
    """What is done with every scene.

    Attributes:
        stages: Names, in order.
        options: "stage.option" or "option": value; those of a scene go before these.
        device: Where each command computes.
    """

    stages: tuple[str, ...]
    options: Mapping[str, str]
    device: str

    def __post_init__(self) -> None:
        if not self.stages:
            raise InputError(f"--do: name what to do, such as fit,lift; there are {', '.join(COMMANDS)}")
        for name in self.stages:
            if name not in COMMANDS:
                raise InputError(f"--do: there is no '{name}'; there are {', '.join(COMMANDS)}")
            if self.stages.count(name) > 1:
                raise InputError(f"--do: '{name}' stands there twice")
        order = [name for name in COMMANDS if name in self.stages]
        if order != list(self.stages):
            raise InputError(f"--do {','.join(self.stages)}: write it in the order of the work, {','.join(order)}")


def stages_of(scene: Scene, plan: Plan) -> tuple[tuple[Stage, ...], tuple[str, ...]]:
    """The stages of a scene, and the files and folders that its results depend on.

    Raises:
        InputError: An option does not exist, or a file that is needed is not named.
    """
    own = {**plan.options, **scene.options}
    views, gaussians = _sources(scene, own, "fit" in plan.stages)
    _check_options(own, plan.stages, scene.name)
    inputs: list[str] = []
    stages = []
    for name in plan.stages:
        given = _given(COMMANDS[name], name, own)
        if name == "evaluate":
            words = _evaluation(scene, given, plan.stages, gaussians)
        else:
            words = [str(views)] if name == "fit" else [str(gaussians)]
        if name in ("lift", "segment", "instances", "render"):
            words += ["--views", str(views)]
        if name == "segment":
            words += ["--semantics", LIFTED]
        if name == "segment" and "predict" in plan.stages and "predicted" not in [option.name for option in given]:
            words += ["--predicted", PREDICTED]
        words += ["--out", OUTPUTS[name], "--device", plan.device]
        for option, value in given.items():
            value = _absolute(value.replace("{scene}", scene.name).replace("{path}", str(scene.path)))
            if option.name not in NO_INPUT:
                inputs += _paths_in(value)
            words += _words(option, value)
        stages.append(Stage(name, tuple(words)))
    inputs += [str(path) for path in (views, gaussians) if not str(path).startswith(OUT)]
    return tuple(stages), tuple(sorted(set(inputs)))


def _evaluation(scene: Scene, given: dict[Field[Any], str], stages: Sequence[str], gaussians: Path) -> list[str]:
    """Words of an evaluation; what it asks is what this batch made, where it says nothing else. `given` loses them."""
    own = {option.name: option for option in given}
    profile = given.pop(own["profile"]) if "profile" in own else PROFILE
    words = [profile] if "data" in own else [profile, "--data", str(scene.path)]
    if "gaussians" not in own:
        words += ["--gaussians", str(gaussians)]
    for name, stage in (("semantics", "lift"), ("predicted", "predict")):
        if stage in stages and name not in own:
            words += [f"--{name}", OUTPUTS[stage]]
    return words


def run_stage(name: str, arguments: Sequence[str]) -> None:
    """Run a command as its command line would; in a worker.

    Raises:
        InputError: The arguments do not fit, or what the command raises.
    """
    command = parse(name, arguments)
    if isinstance(command, Fit):  # a killed process has left it
        command.resume = command.out.with_name(f"{command.out.name}.checkpoint").is_file()
    command.command_line = shlex.join(["sgwarp", name, *arguments])
    _show_notices()
    with guarded(command):
        say_without_effect(command)
        command.run()


def parse(name: str, arguments: Sequence[str]) -> Any:
    """The command with its options.

    Raises:
        InputError: They do not fit.
    """
    import tyro

    said = io.StringIO()
    try:
        with redirect_stderr(said), redirect_stdout(said):
            return tyro.cli(COMMANDS[name], args=list(arguments), console_outputs=True)
    except SystemExit:
        lines = [line.strip("│╭╮╰╯─ ") for line in said.getvalue().splitlines()]
        reason = " ".join(line for line in lines if line)[:300]
        raise InputError(f"{name}: its options do not fit: {reason}") from None


def prepare() -> None:
    """In a worker: keep the networks of encoders for the next scene."""
    from sgwarp.encoders.registry import keep_encoders

    keep_encoders()


def warm(stages: Sequence[str], encoder: str | None, device: str) -> None:
    """Compile the kernels and load the networks that stages use, on the room that comes with the package.

    What goes wrong here will go wrong in a scene, and be recorded there.
    """
    import tempfile

    from sgwarp.cluster.working import written_to
    from sgwarp.demo.data import ROOM

    views, scene = str(ROOM), str(ROOM / "room.compressed.ply")
    with tempfile.TemporaryDirectory() as out:
        lifted = f"{out}/s.safetensors"
        source = encoder if encoder and "{" not in encoder else f"files:{ROOM / 'labels'}"
        small = ["--steps", "4", "--cap", "2000", "--downscale", "8", "--init", "random"]
        arguments = {
            "fit": [views, "--out", f"{out}/fit.ply", *small],
            "lift": [scene, "--views", views, "--encoder", source, "--share-of-views", "0.1", "--out", lifted],
            "segment": [scene, "--views", views, "--semantics", lifted, "--view", "0002", "--out", f"{out}/labels"],
            "render": [scene, "--views", views, "--view", "0002", "--out", f"{out}/renders"],
        }
        for name in stages:
            with suppress(Exception), written_to(Path(os.devnull)):
                if name in arguments:
                    run_stage(name, [*arguments[name], "--device", device])


def _sources(scene: Scene, own: Mapping[str, str], fitted: bool) -> tuple[Path, Path]:
    """Views and Gaussians of a scene."""
    path = scene.path
    views = Path(own["views"].replace("{path}", str(path))) if "views" in own else path
    if "views" not in own and path.suffix == ".ply":
        if fitted:
            raise InputError(f"scene {scene.name}: fit starts from photographs, and {path} is a scene")
        views = path.parent
    if fitted:
        return views.absolute(), Path(SCENE)
    if "scene" in own:
        return views.absolute(), Path(own["scene"].replace("{path}", str(path))).absolute()
    if path.suffix == ".ply":
        return views.absolute(), path
    from sgwarp.cluster.listing import gaussians_in

    return views.absolute(), gaussians_in(path)


def _check_options(own: Mapping[str, str], stages: Sequence[str], scene: str) -> None:
    """Options of stages that are not asked for may stand in a list, which serves several runs."""
    known = {name: {option.name for option in fields(COMMANDS[name])} - set(FIXED) for name in COMMANDS}
    for key in own:
        stage, dot, option = key.replace("-", "_").rpartition(".")
        fits = option in known.get(stage, ()) if dot else option in COMMON or any(option in known[k] for k in stages)
        if not fits:
            raise InputError(
                f"scene {scene}: no stage of --do has the option '{key}'; write stage.option, see `sgwarp STAGE --help`"
            )


def _given(command: type[Options], stage: str, own: Mapping[str, str]) -> dict[Field[Any], str]:
    """The options of a stage; what names the stage goes before what names the option alone."""
    values = {key.replace("-", "_"): value for key, value in own.items()}
    found: dict[Field[Any], str] = {}
    for option in fields(command):
        if option.name in FIXED:
            continue
        for key in (option.name, f"{stage}.{option.name}"):
            if key in values:
                found[option] = values[key]
    return found


def _words(option: Field[Any], value: str) -> list[str]:
    """An option as on the command line."""
    flag, kind = option.name.replace("_", "-"), str(option.type)
    if kind == "bool":
        if value.lower() not in ("true", "false"):
            raise InputError(f"option {option.name}: expected true or false, got {value!r}")
        return [f"--{flag}" if value.lower() == "true" else f"--no-{flag}"]
    return [f"--{flag}", *(shlex.split(value) if kind.startswith("tuple") else [value])]


def _absolute(value: str) -> str:
    """A path that exists, or the path behind "files:", from the root: workers may stand elsewhere."""
    head, colon, tail = value.rpartition(":")
    return f"{head}{colon}{Path(tail).absolute()}" if _is_path(tail) else value


def _paths_in(value: str) -> list[str]:
    tail = value.rpartition(":")[2]
    return [tail] if _is_path(tail) else []


def _is_path(text: str) -> bool:
    return ("/" in text or "." in text) and Path(text).exists()


def _show_notices() -> None:
    """What readers log goes to the scene's log.txt."""
    logger = logging.getLogger("sgwarp")
    if not logger.handlers:
        logger.addHandler(logging.StreamHandler())
        logger.setLevel(logging.INFO)
