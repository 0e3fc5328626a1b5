"""A CUDA device that is not there: `with pretended_cuda() as device:` drives code for one on a machine without.

Its tensors lie in the CPU's memory and say they are on cuda:0. They refuse to meet tensors of the CPU where real ones
would. `device` counts the kernels launched, the calls of torch, how often the host waits for the device and how often
it sends something there, each with its place in the package. Only the host's side is pretended: kernels run on the CPU,
those of the block schedule on its fibers, and streams are checked but do not run side by side.
"""

from __future__ import annotations

import importlib
import itertools
import pkgutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures.thread import _WorkItem
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.utils._device
import warp as wp
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

import sgwarp
import sgwarp.ops
from sgwarp.ops import devices, memory

CUDA = torch.device("cuda", 0)
OUTSIDE = "outside the package"
PACKAGE = str(Path(sgwarp.__file__).parent)
aten = torch.ops.aten

# Operations whose result the host has to know, or whose size it has to.
WAITS = {
    aten._local_scalar_dense,
    aten.nonzero,
    aten.equal,
    aten.masked_select,
    aten._unique,
    aten._unique2,
    aten.unique_dim,
    aten.unique_consecutive,
    aten.bincount,
}
INDEXING = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
CROSSING = INDEXING | {aten.copy_, aten._copy_from}  # may take a tensor of each device
ALLOCATIONS = ("empty", "empty_like", "empty_strided", "new_empty")  # launch nothing either, but are counted as calls
HOST = {aten.detach, aten.alias, aten.view, aten.lift_fresh, aten._unsafe_view}  # launch nothing


# Tensors that one launch over lists of tensors takes, by the number of lists; elements of a block; blocks of a launch.
# From torch's aten/src/ATen/native/cuda/MultiTensorApply.cuh.
TOGETHER, CHUNK, BLOCKS = {1: 110, 2: 64, 3: 48, 4: 36, 5: 30}, 65536, 320


def kernels_of(name: str, args: Any) -> int:
    """How many kernels an operation of torch launches on CUDA.

    Counted are batch normalization, which takes statistics or sums in one kernel and maps in another, and operations on
    lists of tensors; all else counts as one, though sorting takes several.
    """
    if name in ALLOCATIONS:
        return 0
    if name.startswith("native_batch_norm"):
        return 2 if name.endswith("backward") or args[5] else 1
    if name.startswith(("_foreach_", "_fused_")):
        lists = [a for a in args if isinstance(a, (list, tuple)) and a and isinstance(a[0], torch.Tensor)]
        depth = min(len(lists), 4 if name.startswith("_fused_") else 5)  # the counters of steps come along
        return _launches_over([tensor.numel() for tensor in lists[0]], TOGETHER[depth])
    return 1


def _launches_over(sizes: list[int], together: int) -> int:
    launches, tensors, blocks = 0, 0, 0
    for size in sizes:
        tensors += 1
        chunks = -(-size // CHUNK)
        for chunk in range(1, chunks + 1):
            blocks += 1
            if blocks == BLOCKS or (tensors == together and chunk == chunks):
                launches, blocks, tensors = launches + 1, 0, 0 if chunk == chunks else 1
    return launches + (blocks > 0)


class MixedDevicesError(RuntimeError):
    """A tensor of the CPU met one of the device."""


class NotCapturableError(RuntimeError):
    """Something that a CUDA graph cannot hold happened during a capture."""


class DeviceTensor(torch.Tensor):
    """Memory of the CPU that claims to be of cuda:0."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    device = property(lambda self: CUDA)  # type: ignore[assignment]
    is_cuda = property(lambda self: True)  # type: ignore[assignment]
    is_cpu = property(lambda self: False)  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return func(*tree_map(plain, args), **tree_map(plain, kwargs or {}))  # only beyond the block: at its end


def plain(value: Any) -> Any:
    """The tensor as one of the CPU, sharing its memory; anything else as it is."""
    if not isinstance(value, DeviceTensor):
        return value
    with torch._C._DisableTorchDispatch():
        return value.as_subclass(torch.Tensor)  # type: ignore[arg-type]


def claimed(value: Any) -> Any:
    """The tensor as one of the device, sharing its memory; anything else as it is."""
    if not isinstance(value, torch.Tensor) or isinstance(value, DeviceTensor):
        return value
    return torch.Tensor._make_subclass(DeviceTensor, value)


def is_cuda(device: Any) -> bool:
    return device is not None and torch.device(device).type == "cuda"


class _Upload(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
        with torch._C._DisableTorchDispatch():
            return claimed(tensor.clone())

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        with torch._C._DisableTorchDispatch():
            return plain(gradient).clone()


class _Download(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: torch.Tensor) -> torch.Tensor:
        with torch._C._DisableTorchDispatch():
            return plain(tensor).clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        with torch._C._DisableTorchDispatch():
            return claimed(plain(gradient).clone())


class PretendedStream:
    """What `wp.stream_from_torch` gives for a stream of the pretended device."""

    def __init__(self, stream: TorchStream) -> None:
        self.torch_stream = stream
        self.device = wp.get_device("cpu")
        self.cuda_stream = stream.cuda_stream


class TorchStream:
    """A stream of torch; `with torch.cuda.stream(stream):` makes it the current one. The default one is number 0."""

    handles = itertools.count(1)

    def __init__(self, handle: int | None = None) -> None:
        self.cuda_stream = next(self.handles) if handle is None else handle
        self.device = CUDA
        self.device_index = 0

    def wait_stream(self, other: TorchStream) -> None:
        pass


class PretendedDevice:
    """What happened on the device.

    Attributes:
        launches: Keys of the kernels launched, in order.
        calls: How often each operation of torch ran there, those left out that only look at memory in another way.
        kernels: How many kernels these operations launch, by their names.
        waits: What the host waited for, and the line of the package that made it: (operation, file:line).
        uploads: What the host sent there, likewise. Copies from pageable memory do not wait, but no graph holds them.
    """

    def __init__(self) -> None:
        self.launches: list[str] = []
        self.calls: Counter[str] = Counter()
        self.kernels: Counter[str] = Counter()
        self.waits: list[tuple[str, str]] = []
        self.uploads: list[tuple[str, str]] = []
        self.is_capturing = False
        self.stream = TorchStream(0)
        self.sorting_on: PretendedStream | None = None
        self._recent = False  # whether the latest operation on tensors was one on the device

    @property
    def work(self) -> int:
        """Launches of Warp, and of torch: as many as `kernels_of` knows, one at least."""
        return len(self.launches) + self.kernels.total()

    def reset(self) -> None:
        """Forget what happened."""
        for record in (self.launches, self.calls, self.kernels, self.waits, self.uploads):
            record.clear()

    @contextmanager
    def capturing(self) -> Iterator[None]:
        """Refuse what a CUDA graph cannot hold: waiting for the device, and sending it what the host has now."""
        self.is_capturing = True
        try:
            yield
        finally:
            self.is_capturing = False

    @contextmanager
    def on_stream(self, stream: TorchStream) -> Iterator[None]:
        before, self.stream = self.stream, stream
        try:
            yield
        finally:
            self.stream = before

    def wait(self, what: str) -> None:
        self._note(self.waits, what, "waits for the device")

    def upload(self, what: str) -> None:
        self._note(self.uploads, what, "sends the device something")

    def _note(self, record: list[tuple[str, str]], what: str, does: str) -> None:
        place = _place()
        if self.is_capturing:
            raise NotCapturableError(f"{place}: {what} {does}")
        if place != OUTSIDE:
            record.append((what, place))

    def run(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        """One operation of torch, on whichever device its tensors or its argument `device` say."""
        packet = func.overloadpacket
        in_formula = _in_formula_of_torch()
        tensors = [value for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)]
        ours = any(isinstance(tensor, DeviceTensor) for tensor in tensors)
        if ours and not in_formula:
            self._check(packet, func, args, kwargs, tensors)
        device = kwargs.get("device")
        if device is not None:
            if is_cuda(device) and kwargs.get("generator") is not None:
                raise MixedDevicesError(f"{_place()}: {func} with a generator of the CPU")
            if ours and not is_cuda(device) and packet is not aten._to_copy:
                ours = False
            kwargs = kwargs | {"device": torch.device("cpu")}
        there = is_cuda(device) if device is not None else ours
        if packet is aten._to_copy:  # moves to the CPU are made by the mode below
            there = there or ours
        if tensors:
            self._recent = ours
        elif in_formula:
            there = self._recent
        if func._schema.is_mutable and tensors and isinstance(args[0] if args else None, torch.Tensor):
            there = isinstance(args[0], DeviceTensor) or isinstance(kwargs.get("out"), DeviceTensor)
        if there and packet not in HOST and not func.is_view:
            name = packet._qualified_op_name.removeprefix("aten::")
            self.calls[name] += 1
            self.kernels[name] += kernels_of(name, args)
        with torch._C._DisableTorchDispatch():
            result = func(*tree_map(plain, args), **tree_map(plain, kwargs))
        return tree_map(claimed, result) if there else result

    def _check(self, packet: Any, func: Any, args: Any, kwargs: Any, tensors: list[torch.Tensor]) -> None:
        name = packet._qualified_op_name.removeprefix("aten::")
        others = [t for t in tensors if not isinstance(t, DeviceTensor)]
        if packet in WAITS or (packet is aten.repeat_interleave and kwargs.get("output_size") is None):
            self.wait(name)
        if packet in (aten.copy_, aten._copy_from):
            down = isinstance(args[1 if packet is aten.copy_ else 0], DeviceTensor)
            if others and not (down and (args[2:] or kwargs.get("non_blocking"))):
                (self.wait if down else self.upload)(name)
        elif packet in INDEXING:
            self._check_index(name, args)
        elif any(t.ndim for t in others):
            sizes = ", ".join(f"{'cuda' if isinstance(t, DeviceTensor) else 'cpu'} {list(t.shape)}" for t in tensors)
            raise MixedDevicesError(f"{_place()}: {name} of {sizes}")

    def _check_index(self, name: str, args: Any) -> None:
        target, indices = args[0], [i for i in args[1] if i is not None]
        values = args[2] if len(args) > 2 else None
        if not isinstance(target, DeviceTensor):
            raise MixedDevicesError(f"{_place()}: {name} of a tensor of the CPU by one of cuda")
        if values is not None and values.ndim and not isinstance(values, DeviceTensor):
            raise MixedDevicesError(f"{_place()}: {name} of values of the CPU")
        if any(not isinstance(i, DeviceTensor) for i in indices):
            self.upload(f"{name} by a tensor of the CPU")
        fills = values is not None and values.numel() == 1  # becomes a masked fill
        if any(i.dtype in (torch.bool, torch.uint8) for i in indices) and not fills:
            self.wait(f"{name} by a mask")


def _in_formula_of_torch() -> bool:
    """Whether a backward formula of torch itself is running: those make tensors where the memory is, on the CPU."""
    node = torch._C._current_autograd_node()
    return node is not None and not isinstance(node, torch.autograd.function.BackwardCFunction)


class _Dispatch(TorchDispatchMode):
    def __init__(self, device: PretendedDevice) -> None:
        super().__init__()
        self.pretended = device

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self.pretended.run(func, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Moves between devices, and what torch does without an operation."""

    def __init__(self, device: PretendedDevice) -> None:
        super().__init__()
        self.pretended = device

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.Tensor.to:
            target, rest, kwargs = _parsed_to(args[1:], kwargs)
            moved = self._moved(args[0], target, kwargs)
            return moved if not rest and not kwargs else func(moved, *rest, **kwargs)
        if func in (torch.Tensor.cpu, torch.Tensor.cuda):
            return self._moved(args[0], "cuda" if func is torch.Tensor.cuda else "cpu", kwargs)
        if func is torch.Tensor.pin_memory:
            return args[0]
        device = kwargs.get("device") or torch.utils._device.CURRENT_DEVICE
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and is_cuda(device):
            tensor = func(*args, **(kwargs | {"device": "cpu"})) if not isinstance(args[0], DeviceTensor) else args[0]
            return tensor if isinstance(tensor, DeviceTensor) else self._moved(tensor, "cuda", {})
        if args and isinstance(args[0], DeviceTensor):
            if func in (torch.Tensor.numpy, torch.Tensor.__array__):
                raise TypeError(f"{_place()}: can't convert cuda:0 device type tensor to numpy")
            if func in (torch.Tensor.tolist, torch.Tensor.__repr__):
                self.pretended.wait(func.__name__)
                return func(plain(args[0].detach()))
            if func is torch.Tensor.__format__:
                self.pretended.wait("__format__")
                return func(plain(args[0].detach()), *args[1:])
            if func is torch.Tensor.new_tensor:
                return self._moved(torch.tensor(*args[1:], **({"dtype": args[0].dtype} | kwargs)), "cuda", {})
            if func is torch.Tensor.__deepcopy__:
                return claimed(plain(args[0].detach()).clone()).requires_grad_(args[0].requires_grad)
        return func(*args, **kwargs)

    def _moved(self, tensor: Any, device: Any, kwargs: dict[str, Any]) -> Any:
        if device is None or is_cuda(device) == isinstance(tensor, DeviceTensor):
            return tensor
        if is_cuda(device):
            self.pretended.upload("to(cuda)")
            return _Upload.apply(tensor)
        self.pretended.wait("to(cpu)")
        return _Download.apply(tensor)


def _parsed_to(args: Any, kwargs: dict[str, Any]) -> tuple[Any, list[Any], dict[str, Any]]:
    """Device, positional arguments and others of `Tensor.to` without it."""
    device, rest = kwargs.pop("device", None), []
    for value in (*args, *((kwargs.pop("other"),) if "other" in kwargs else ())):
        if isinstance(value, torch.Tensor):
            device = value.device
            rest.append(value.dtype)
        elif isinstance(value, (str, torch.device)):
            device = value
        elif value is not None:
            rest.append(value)
    kwargs = {name: value for name, value in kwargs.items() if value is not None and name != "non_blocking"}
    return device, [value for value in rest if isinstance(value, (torch.dtype, torch.memory_format))], kwargs


def _place() -> str:
    """The innermost line of the package that is running."""
    frame = sys._getframe(1)
    while frame is not None and not frame.f_code.co_filename.startswith(PACKAGE):
        frame = frame.f_back
    return OUTSIDE if frame is None else f"{frame.f_code.co_filename[len(PACKAGE) + 1 :]}:{frame.f_lineno}"


@contextmanager
def pretended_cuda() -> Iterator[PretendedDevice]:
    """Pretend that there is a CUDA device, within the block and in the calling thread."""
    device = PretendedDevice()
    with pytest.MonkeyPatch.context() as patch:
        _pretend_torch(patch, device)
        _pretend_warp(patch, device)
        _pretend_gradients(patch, device)
        overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        try:
            with _Functions(device), _Dispatch(device):
                yield device
        finally:
            torch.__future__.set_overwrite_module_params_on_conversion(overwrites)
            memory.release_scratch()


def _pretend_torch(patch: pytest.MonkeyPatch, device: PretendedDevice) -> None:
    replaced = {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "current_device": lambda: 0,
        "set_device": lambda index: None,
        "synchronize": lambda *args: device.wait("synchronize"),
        "current_stream": lambda *args: device.stream,
        "Stream": TorchStream,
        "stream": device.on_stream,
        "is_current_stream_capturing": lambda: device.is_capturing,
        "get_rng_state": lambda *args: torch.get_rng_state(),
        "set_rng_state": lambda *args: None,
    }
    for name, value in replaced.items():
        patch.setattr(torch.cuda, name, value)
    save, load = torch.save, torch.load
    patch.setattr(torch, "save", lambda content, *args, **kwargs: save(tree_map(plain, content), *args, **kwargs))

    def loaded(*args: Any, map_location: Any = None, **kwargs: Any) -> Any:
        content = load(*args, map_location="cpu", **kwargs)
        return tree_map(claimed, content) if is_cuda(map_location) else content

    patch.setattr(torch, "load", loaded)
    work = _WorkItem.run

    def run(item: Any) -> None:
        with _Functions(device), _Dispatch(device):  # modes belong to a thread
            work(item)

    patch.setattr(_WorkItem, "run", run)
    autocast = torch.autocast
    patch.setattr(torch, "autocast", lambda kind, *args, **kwargs: autocast("cpu", *args, **kwargs))
    enabled, dtype = torch.is_autocast_enabled, torch.get_autocast_dtype
    patch.setattr(torch, "is_autocast_enabled", lambda *kind: enabled("cpu"))
    patch.setattr(torch, "get_autocast_dtype", lambda kind: dtype("cpu"))


def _pretend_gradients(patch: pytest.MonkeyPatch, device: PretendedDevice) -> None:
    """The engine fills in zeros of the CPU for gradients that nobody gave; on a real device they would lie there."""

    def filled(backward: Callable[..., Any]) -> Callable[..., Any]:
        def run(ctx: Any, *gradients: Any) -> Any:
            known = (*gradients, *ctx.saved_tensors)
            ours = any(isinstance(tensor, DeviceTensor) for tensor in known)
            with _Functions(device):  # `Tensor.backward` is called by that mode, and so runs without it
                return backward(ctx, *(claimed(g) if ours else g for g in gradients))

        return run

    for module in pkgutil.walk_packages(sgwarp.ops.__path__, "sgwarp.ops."):
        importlib.import_module(
            module.name
        )  # all functions with a backward pass, whatever the test has imported so far
    for function in torch.autograd.Function.__subclasses__():
        if function.__module__.startswith("sgwarp."):
            patch.setattr(function, "backward", staticmethod(filled(function.backward)))


def _pretend_warp(patch: pytest.MonkeyPatch, device: PretendedDevice) -> None:
    import warp._src.torch as bridge

    host = wp.get_device("cpu")
    for holder in (wp, bridge):
        patch.setattr(holder, "device_from_torch", lambda _: host)
    patch.setattr(wp, "is_cuda_available", lambda: True)
    patch.setattr(wp, "stream_from_torch", PretendedStream)
    patch.setattr(devices, "_streams", {})

    def on_fibers(function: Callable[..., Any]) -> Callable[..., Any]:
        def launch(kernel: Any, *args: Any, stream: Any = None, **kwargs: Any) -> Any:
            if stream is None:
                return function(kernel, *args, **kwargs)
            assert stream.torch_stream is device.stream, f"{_place()}: {kernel.key} on another stream than torch's"
            device.launches.append(kernel.key.split("__locals__")[-1])
            before = wp.config.enable_cpu_blocks
            wp.config.enable_cpu_blocks = function is wp_launch_tiled
            try:
                return function(kernel, *args, **kwargs, device=host)
            finally:
                wp.config.enable_cpu_blocks = before

        return launch

    wp_launch_tiled = wp.launch_tiled
    patch.setattr(wp, "launch", on_fibers(wp.launch))
    patch.setattr(wp, "launch_tiled", on_fibers(wp_launch_tiled))
    sort = wp.utils.radix_sort_pairs

    @contextmanager
    def scoped(stream: PretendedStream, sync_enter: bool = True) -> Iterator[None]:
        assert not sync_enter, "entering the stream must not wait for Warp's own"
        device.sorting_on = stream
        try:
            yield
        finally:
            device.sorting_on = None

    def sorting(*args: Any, **kwargs: Any) -> Any:
        if device.sorting_on is not None:
            assert device.sorting_on.torch_stream is device.stream
            device.launches.append("radix_sort_pairs")
        return sort(*args, **kwargs)

    patch.setattr(wp, "ScopedStream", scoped)
    patch.setattr(wp.utils, "radix_sort_pairs", sorting)
