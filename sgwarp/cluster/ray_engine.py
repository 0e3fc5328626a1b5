"""The Ray engine: the same tasks on a Ray cluster, or on a Ray of this machine's own. Needs the extra `cluster`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from tempfile import gettempdir
from typing import Any

from sgwarp.cluster.local import TRIES, Call
from sgwarp.cluster.tasks import Outcome, Task, named_function
from sgwarp.cluster.working import give_up, work
from sgwarp.errors import InputError

AHEAD = 2  # tasks handed to Ray per worker: the next one is there when a worker is free
ALONE = {"RAY_worker_niceness": "0"}  # of a Ray of our own; else its workers give way to all others, at 15
STORE = 100_000_000  # bytes of Ray's object store on this machine; only paths travel
_prepared: set[str] = set()  # in a worker of Ray


@dataclass(frozen=True)
class RayEngine:
    """Ray schedules; what a scene is, and what of it is done, is as with the local engine.

    Attributes:
        workers: Scenes at a time; on a cluster not more than it has room for.
        cores: Reserved for each.
        gpus: Reserved for each; may be a fraction.
        address: Of a running cluster; None starts one on this machine, reachable from it alone.
        prepare: Called in each worker before its first task.
        warm: Called once on each machine before its first task: its other workers wait meanwhile.
        environment: Added to that of the workers.
    """

    workers: int = 1
    cores: int = 1
    gpus: float = 0.0
    address: str | None = None
    prepare: Call | None = None
    warm: Call | None = None
    environment: dict[str, str] = field(default_factory=dict)

    def __call__(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Outcomes, as scenes end; Ray does the scenes of killed workers again.

        Raises:
            InputError: Ray is not installed, or its cluster is not to be reached.
        """
        ray = _import_ray(alone=self.address is None)
        with _environment(self._variables() | ALONE if self.address is None else {}):
            self._connect(ray)
            try:
                yield from self._run(ray, iter(tasks))
            finally:
                ray.shutdown()

    def _variables(self) -> dict[str, str]:
        import sys

        return {**self.environment, "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path)}

    def _connect(self, ray: Any) -> None:
        settings: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
        if self.address is None:
            # Its workers inherit the environment: one for the tasks alone would start each of them twice.
            settings |= {"num_cpus": self.workers * self.cores, "include_dashboard": False}
            settings |= {"object_store_memory": STORE, "_node_ip_address": "127.0.0.1"}
        else:
            settings["runtime_env"] = {"env_vars": self._variables()}
        try:
            ray.init(address=self.address or "local", **settings)
        except (ConnectionError, OSError, RuntimeError, ValueError) as error:
            line = (str(error).strip().splitlines() or ["no answer"])[0]
            if self.address is None:
                raise InputError(f"--engine ray: Ray cannot be started on this machine ({line})") from None
            remedy = "check the address, and whether the cluster asks for a token (RAY_AUTH_MODE, RAY_AUTH_TOKEN_PATH)"
            raise InputError(f"--address {self.address}: Ray does not answer ({line}); {remedy}") from None

    def _run(self, ray: Any, tasks: Iterator[Task]) -> Iterator[Outcome]:
        remote = ray.remote(_remote_work).options(num_cpus=self.cores, num_gpus=self.gpus, max_retries=TRIES - 1)
        prepare, warm = (None if call is None else asdict(call) for call in (self.prepare, self.warm))
        flying: dict[Any, Task] = {}
        while True:
            room = AHEAD * self.workers - len(flying)
            flying |= {remote.remote(task.to_json(), prepare, warm): task for task in islice(tasks, room)}
            if not flying:
                return
            ready, _ = ray.wait(list(flying), num_returns=1)
            for reference in ready:
                yield _outcome(ray, reference, flying.pop(reference))


def _outcome(ray: Any, reference: Any, task: Task) -> Outcome:
    try:
        return Outcome(**ray.get(reference))
    except ray.exceptions.RayError as error:
        line = (str(error).strip().splitlines() or [""])[0]
        return give_up(task, f"{TRIES} processes ended at it, or Ray lost them ({type(error).__name__}: {line})")


def _import_ray(alone: bool) -> Any:
    """Ray, which reads these variables when it is imported."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # a worker without GPUs sees them, as locally
    if alone:  # on every system as on macOS: servers listen on 127.0.0.1, not on all addresses
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    try:
        import ray
    except ImportError:
        raise InputError("--engine ray: needs Ray; run: pip install 'sgwarp[cluster]'") from None
    from ray._private.ray_constants import ENABLE_RAY_CLUSTER

    if alone and ENABLE_RAY_CLUSTER:
        raise InputError("--engine ray: Ray was imported before, and would listen on all addresses; give an --address")
    return ray


def _prepare(call: dict[str, Any]) -> None:
    """In a worker: once per process."""
    if call["function"] not in _prepared:
        _prepared.add(call["function"])
        named_function(call["function"])(*call["arguments"])


def _warm_machine(call: dict[str, Any], run: str) -> None:
    """In a worker: once on this machine in a run; who comes later waits until it is done."""
    import fcntl

    with (Path(gettempdir()) / f"sgwarp-warm-{run}").open("a") as mark:
        fcntl.flock(mark, fcntl.LOCK_EX)  # ends with the process
        if not os.fstat(mark.fileno()).st_size:
            named_function(call["function"])(*call["arguments"])
            mark.write("done\n")


def _remote_work(values: dict[str, Any], prepare: dict[str, Any] | None, warm: dict[str, Any] | None) -> dict[str, Any]:
    task = Task.from_json(values)
    if prepare is not None:
        _prepare(prepare)
    if warm is not None and task.run not in _prepared:
        _warm_machine(warm, task.run)
        _prepared.add(task.run)
    return asdict(work(task))


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """In the block, this process has these variables, and what it starts inherits them."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
