"""Fixtures shared by all tests: the catalogue of scenes, and central differences.

`scene` runs a test once per named scene; `make_scene("name")` builds one; both are in tests/scenes.py. `stage` is a
small labeled scene with views, `stage_files` the same as files (tests/stage.py). These files, like
tests/differences.py, are loaded by their paths, because importlib mode puts no folder of tests on sys.path.
"""

import importlib.util
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

from sgwarp.errors import InputError
from sgwarp.scene import Camera, Gaussians


def _load(name: str, path: Path):
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


catalogue = _load("sgwarp_test_scenes", Path(__file__).with_name("scenes.py"))
differences = _load("sgwarp_test_differences", Path(__file__).with_name("differences.py"))
devices = _load("sgwarp_test_devices", Path(__file__).with_name("devices.py"))
_pretended = _load("sgwarp_test_pretended", Path(__file__).with_name("pretended.py"))
_slow_tests = _load("sgwarp_slow_tests", Path(__file__).with_name("slow_tests.py"))
_stage = _load("sgwarp_test_stage", Path(__file__).with_name("stage.py"))
stage, toy_text, stage_files = _stage.stage, _stage.toy_text, _stage.stage_files


class NamedScene(NamedTuple):
    name: str
    gaussians: Gaussians
    camera: Camera


@pytest.fixture(params=list(catalogue.SCENES))
def scene(request: pytest.FixtureRequest) -> NamedScene:
    """Every scene of the catalogue in turn: name, gaussians, camera."""
    return NamedScene(request.param, *catalogue.SCENES[request.param]())


@pytest.fixture(scope="session")
def make_scene() -> Callable[[str], NamedScene]:
    """Build one scene of the catalogue by name."""
    return lambda name: NamedScene(name, *catalogue.SCENES[name]())


@pytest.fixture(scope="session")
def scenes():
    """The module tests/scenes.py itself, for its builders (cloud, pinhole, look_at, changed)."""
    return catalogue


@pytest.fixture(scope="session")
def assert_central_differences():
    """Compare gradients with central differences of a float64 loss."""
    return differences.assert_central_differences


@pytest.fixture(autouse=True)
def notices_end_with_the_test() -> Iterator[None]:
    """A handler that a test leaves behind would write to a stream that is closed by then."""
    logger = logging.getLogger("sgwarp")
    handlers, level = logger.handlers[:], logger.level
    yield
    logger.handlers[:] = handlers
    logger.setLevel(level)


@pytest.fixture
def pretended_cuda():
    """A CUDA device that is not there, for the length of the test (tests/pretended.py)."""
    with _pretended.pretended_cuda() as device:
        yield device


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record-slow", action="store_true", help="add tests that take long to tests/slow_tests.txt")


def pytest_make_parametrize_id(config: pytest.Config, val: object, argname: str) -> str | None:
    """Bytes do not name a test: packed ones may hold the time, and workers that collect other names run nothing."""
    return argname if isinstance(val, bytes) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    _slow_tests.mark(items)


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> tuple[set[str], set[str]]:
    """Names of kernel modules that are loaded together from now on, and of those whose kernels are launched."""
    import warp as wp

    from sgwarp.ops import launcher

    loaded: set[str] = set()
    launched: set[str] = set()
    load, launch = wp.force_load, wp.launch

    def spy_on_loading(device, *, modules, **options):
        loaded.update(module.name for module in modules)
        load(device, modules=modules, **options)

    def spy_on_launching(kernel, *arguments, **options):
        launched.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    monkeypatch.setattr(wp, "force_load", spy_on_loading)
    monkeypatch.setattr(wp, "launch", spy_on_launching)
    monkeypatch.setattr(launcher, "_loaded", set())
    monkeypatch.setattr(launcher, "_thread_count", 2)
    return loaded, launched


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--record-slow"):
        config.pluginmanager.register(_slow_tests.Recorder())
    config.addinivalue_line("markers", "cpu_only(why): stays on the CPU, whatever SGWARP_TEST_DEVICE says")
    if devices.NAME != "cpu":
        # The machine with the device may have another torch, whose warnings are no fault of what is tested.
        config.addinivalue_line("filterwarnings", "default")


@pytest.fixture(autouse=True)
def operations_on_the_device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Runs the operations that a test calls on SGWARP_TEST_DEVICE (tests/devices.py)."""
    if devices.NAME == "cpu" or request.node.get_closest_marker("cpu_only"):
        yield
        return
    devices.replace_operations(request.module, monkeypatch)
    if devices.NAME != "pretended":
        yield
        return
    with _pretended.pretended_cuda():
        yield


@contextmanager
def _allow_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        if not str(error).startswith(str(path)) or "\n" in str(error):
            pytest.fail(f"not one line that begins with {path}: {error}")


@pytest.fixture(scope="session")
def allow_input_error():
    """Context manager for random input: either the block passes or an InputError names the file on one line."""
    return _allow_input_error


@pytest.fixture
def disk():
    """`with disk(n):` a disk on which no file can grow beyond n bytes, as the operating system enforces it."""
    resource = pytest.importorskip("resource")

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limited


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test reads or writes the maps that the user's own runs keep."""
    folder = tmp_path_factory.mktemp("maps")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SGWARP_CACHE", str(folder))
        yield
