"""What the CUDA kernels cost before any GPU runs them: registers, shared memory, occupancy, machine instructions.

    python -m benchmarks.kernel_costs [--out benchmarks/kernel_costs.json] [--page docs/kernel_costs.md]

Every kernel is compiled for one architecture without a GPU; `ptxas` says what it holds, `nvdisasm` lists its machine
code. Loops are found by their backward branches. A phase of a batch (alphas, products, ...) is the loop that holds most
of an instruction which that phase needs a known number of times; that says how often the loop runs. All branches count
as taken, so the figures are upper bounds of what is issued for a batch whose every fragment reaches every warp; memory
may still be what a kernel waits for. The roofline below is arithmetic over these counts, not a measurement.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

WARPS = 8  # of a block
REGISTERS, SHARED, THREADS = 65_536, 227 * 1024, 2048  # of a multiprocessor (compute capability 9.0)
SHARED_OF_BLOCK = 1024  # that the driver takes
ISSUE = 132 * 4 * 1.755e9  # warp instructions per second of an H100 SXM
BANDWIDTH = 3.35e12  # bytes per second


@dataclass(frozen=True)
class Subject:
    """A kernel to look at.

    Attributes:
        name: In the table.
        make: Returns the kernel.
        batch: Fragments that a block handles at a time; 0 = a kernel with one thread per item.
        phases: Instruction that marks a phase, and how many of them a thread needs for a batch.
        items: What one thread handles, if there is no batch.
    """

    name: str
    make: Callable[[], Any]
    batch: int = 0
    phases: tuple[tuple[str, int], ...] = ()
    items: str = "Gaussian"


def subjects() -> list[Subject]:
    """The kernels of a rendering, a training step, a lift, and the network on voxels."""
    import warp as wp

    from sgwarp.kernels.compositing import block, block_backward
    from sgwarp.kernels.contributors import block as contributors
    from sgwarp.kernels.fitting import adam, adam_elements, photometric_block
    from sgwarp.kernels.harmonics import backward as harmonics_backward
    from sgwarp.kernels.harmonics import forward as harmonics
    from sgwarp.kernels.lifting import block as lifting
    from sgwarp.kernels.projection import backward, forward
    from sgwarp.kernels.sparse import convolution_block, normalization_block, voxels

    def replay(*flags: bool) -> Callable[[], Any]:
        return lambda: block_backward.make_composite_backward_block(*flags)

    def lift(wide: bool) -> Callable[[], Any]:
        return lambda: lifting.make_lift_dense_block(False, False, wide)

    def single(make: Callable[..., Any]) -> Callable[[], Any]:
        return lambda: make(wp.float32, wp.float32)

    alphas, replayed = ("MUFU.EX2", 64), ("MUFU.EX2", 16)
    return [
        Subject("composite colours", lambda: block.make_composite_colors_block(False, False), 64, (alphas,)),
        Subject("the same, recorded", lambda: block.make_composite_colors_block(False, True), 64, (alphas,)),
        Subject("the same, with depth", lambda: block.make_composite_colors_block(True, True), 64, (alphas,)),
        Subject("composite 16 channels", lambda: block.make_composite_features_block(True), 64, (alphas,)),
        Subject("backward, colours", replay(False, False, False, False), 16, (replayed,)),
        Subject("backward, colours and depth", replay(False, True, True, False), 16, (replayed,)),
        Subject("backward, in order", replay(False, True, True, True), 16, (replayed,)),
        Subject("backward, 16 channels", replay(True, False, False, False), 16, (replayed, ("LDS.128", 64))),
        Subject("lift 64 channels", lift(True), 16, (replayed, ("FFMA", 32 * 32))),
        Subject("lift 32 channels", lift(False), 16, (replayed, ("FFMA", 32 * 16))),
        Subject("lift ids, one id", lambda: lifting.make_lift_ids_block(False), 16, (replayed,)),
        Subject("contributors", lambda: contributors.rank_contributors_block, 64, (alphas,)),
        Subject("loss", lambda: photometric_block.compare_tiles, items="tile"),
        Subject("gradient of the loss", lambda: photometric_block.gather_tiles, items="tile"),
        Subject("project", lambda: forward.project_gaussians),
        Subject("backward, project", lambda: backward.project_backward),
        Subject("harmonics", lambda: harmonics.evaluate_harmonics),
        Subject("backward, harmonics", lambda: harmonics_backward.harmonics_backward),
        Subject("count steps", lambda: adam.count_steps),
        Subject("Adam", lambda: adam_elements.update_elements, items="parameter"),
        Subject("kernel map", lambda: voxels.tabulate_neighbors, items="offset and voxel"),
        Subject("convolution, statistics", single(convolution_block.make_convolve_blocks), items="16 sums"),
        Subject("layer in inference", single(convolution_block.make_convolve_and_finish_blocks), items="16 sums"),
        Subject("backward, convolution", single(convolution_block.make_convolve_backward_blocks), items="16 or 4 sums"),
        Subject("normalize", single(normalization_block.make_normalize_elements), items="element"),
        Subject("backward, sums", single(normalization_block.make_sum_normalized_blocks), items="share of a channel"),
        Subject("backward, normalize", single(normalization_block.make_normalize_backward_elements), items="element"),
    ]


@dataclass
class Loop:
    """A loop of machine code, by the lines it spans.

    Attributes:
        counts: Instructions of the loop and not of loops within.
    """

    first: int
    last: int
    counts: Counter[str] = field(default_factory=Counter)
    inner: list[Loop] = field(default_factory=list)

    @property
    def own(self) -> int:
        return sum(self.counts.values())

    def holds(self, marker: str) -> int:
        """Instructions that begin with the marker, here."""
        return sum(count for name, count in self.counts.items() if name.startswith(marker))

    def walk(self) -> list[Loop]:
        """The loop and all loops within."""
        return [self, *(loop for child in self.inner for loop in child.walk())]


def parse(listing: str) -> Loop:
    """Loops of one kernel in the listing of `nvdisasm -c`."""
    labels: dict[str, int] = {}
    lines: list[tuple[str, str]] = []  # operation and the label it jumps to
    for line in listing.splitlines():
        if label := re.match(r"\s*(\.L_x_\d+):", line):
            labels[label[1]] = len(lines)
        elif found := re.match(r"\s*/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([A-Z][\w.]*)(.*)", line):
            target = re.search(r"`\((\.L_x_\d+)\)", found[2])
            lines.append((found[1], target[1] if target and found[1].startswith("BRA") else ""))
    ends: dict[int, int] = {}
    for at, (_, target) in enumerate(lines):
        if target and labels.get(target, at + 1) < at:
            ends[labels[target]] = max(at, ends.get(labels[target], 0))
    whole = Loop(0, len(lines))
    stack = [whole]
    for at, (operation, _) in enumerate(lines):
        while at > stack[-1].last:
            stack.pop()
        if at in ends:
            loop = Loop(at, min(ends[at], stack[-1].last))
            stack[-1].inner.append(loop)
            stack.append(loop)
        if operation != "NOP":
            stack[-1].counts[operation] += 1
    return whole


def batch_instructions(whole: Loop, phases: tuple[tuple[str, int], ...]) -> tuple[int, dict[str, float]]:
    """Instructions of a thread for one batch, and for each phase those of one step (fragment, product, ...)."""
    loops = whole.walk()
    main = {marker: max(loops, key=lambda loop: loop.holds(marker)) for marker, _ in phases}
    around = [loop for loop in loops if all(any(inner is main[m] for inner in loop.walk()) for m in main)]
    batch = around[-1] if around[-1] not in main.values() else around[-2]
    total, steps = float(batch.own), {}
    for marker, needed in phases:
        loop = main[marker]
        steps[marker] = loop.own / loop.holds(marker)
        total += steps[marker] * needed
    for loop in batch.walk()[1:]:
        # Rests of unrolled loops run for the last batch of a tile only; other loops (staging) once.
        if not any(loop is m or loop.holds(name) for name, m in main.items()) and not loop.inner:
            total += loop.own
    return round(total), steps


def find_tool(name: str) -> str:
    """Path of `ptxas` or `nvdisasm`."""
    for root in map(Path, sys.path):
        for candidate in root.glob(f"nvidia/*/bin/{name}"):
            return str(candidate)
    found = shutil.which(name)
    if found is None:
        raise SystemExit(f"{name} was not found; pip install 'sgwarp[ptx]' brings it")
    return found


def compiled(kernel: Any, arch: int, folder: Path) -> tuple[str, int, Loop]:
    """What `ptxas` says of a kernel, its shared memory but for what is static [bytes], and its machine code."""
    import warp as wp

    wp.compile_aot_module(kernel.module, device=None, arch=arch, module_dir=folder, use_ptx=True)
    (ptx,) = folder.glob("*.ptx")
    ptx.write_bytes(ptx.read_bytes().rstrip(b"\0"))
    cubin = folder / "kernel.cubin"
    command = [find_tool("ptxas"), "-v", f"-arch=sm_{arch}", str(ptx), "-o", str(cubin)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    name = kernel.get_mangled_name() + "_cuda_kernel_forward"
    meta = json.loads(next(folder.glob("*.meta")).read_text())
    code = subprocess.run([find_tool("nvdisasm"), "-c", str(cubin)], capture_output=True, text=True, check=True).stdout
    start = code.index(f".text.{name}:")
    listing = code[start : code.find("\n\t.section", start)]
    return said[said.index(f"'{name}'") :], meta.get(f"{name}_smem_bytes", 0), parse(listing)


def measure(subject: Subject, arch: int, folder: Path) -> dict[str, Any]:
    """A row of the table."""
    about, dynamic, whole = compiled(subject.make(), arch, folder)
    numbers = r"(\d+) bytes stack frame, (\d+) bytes spill stores.*?Used (\d+) registers.*?(?:(\d+) bytes smem|\n)"
    found = re.search(numbers, about, flags=re.DOTALL)
    assert found is not None
    stack, spills, registers, static = (int(number or 0) for number in found.groups())
    shared = dynamic + static
    by_registers = REGISTERS // (-(-registers // 8) * 8 * 256)
    blocks = min(by_registers, SHARED // (shared + SHARED_OF_BLOCK), THREADS // 256)
    row: dict[str, Any] = {"kernel": subject.name, "registers": registers, "stack": stack, "spills": spills}
    row |= {"shared": shared, "occupancy": blocks * 256 / THREADS}
    if subject.batch:
        per_batch, steps = batch_instructions(whole, subject.phases)
        row |= {"per": "intersection", "warp_instructions": per_batch * WARPS / subject.batch, "steps": steps}
    else:
        row |= {"per": subject.items, "instructions": sum(loop.own for loop in whole.walk())}
    return row


def bucket_step(arch: int, folder: Path) -> int:
    """Instructions of the per-bucket backward pass for one step of its lanes."""
    from benchmarks.bucket_backward import replay_buckets

    *_, whole = compiled(replay_buckets, arch, folder)
    loops = whole.walk()
    inner = max(loops, key=lambda loop: loop.holds("MUFU.EX2"))
    # The compiler makes two loops of it: one that hands over, within it the one that replays.
    around = [loop for loop in loops if inner in loop.inner and loop.holds("SHFL")]
    return inner.own + sum(loop.own for loop in around)


def estimates(rows: list[dict[str, Any]]) -> list[tuple[str, float]]:
    """Milliseconds on an H100 for 1M Gaussians at 1920 x 1080: the larger of issue and memory, stage by stage."""
    cost = {row["kernel"]: row.get("warp_instructions", row.get("instructions", 0)) for row in rows}
    count, intersections, pixels = 1e6, 3e6, 1920 * 1080

    def stage(instructions: float, read_and_written: float) -> float:
        return 1e3 * max(instructions / ISSUE, read_and_written / BANDWIDTH)

    project = stage(cost["project"] * count / 32, 110 * count)
    colors = stage(cost["harmonics"] * count / 32, (192 + 12 + 12) * count)
    lists = stage(0, 24 * count * 4 + intersections * 8 * 10 + 64 * 2 * count)  # two sorts, four and two digits
    shown = stage(cost["composite colours"] * intersections, 68 * intersections + 16 * pixels)
    recorded = stage(cost["the same, recorded"] * intersections, 68 * intersections + 20 * pixels)
    loss = stage(0, 4 * 3 * pixels * 13)  # three images, derivatives written and read, gradient
    replayed = stage(cost["backward, colours"] * intersections, 132 * intersections + 28 * pixels)
    adjoint = stage((cost["backward, project"] + cost["backward, harmonics"]) * count / 32, 650 * count)
    adam = stage(0, 59 * 4 * 8 * count)
    lift = 8 * stage(cost["lift 64 channels"] * intersections, 260 * intersections + 256 * pixels)
    render = project + colors + lists
    step = loss + replayed + adjoint + adam
    return [
        ("a rendering in colours", render + shown),
        ("a training step (rendering, loss, gradients, Adam of all)", render + recorded + step),
        ("lifting 512 dense channels of one view", project + lists + lift),
        (
            "lifting an id map with one id per tile",
            project + lists + stage(cost["lift ids, one id"] * intersections, 0),
        ),
    ]


PAGE = """# What the CUDA kernels cost, counted without a GPU

**Nothing here is a GPU time.** The kernels were compiled for sm_{arch}; registers, stack and shared memory are what
`ptxas` reports, instructions were counted in the machine code that `nvdisasm` lists. For a batch of fragments every
branch counts as taken, so a count is an upper bound: a warp that a fragment does not reach skips most of its share.
Occupancy is what registers and shared memory allow on a multiprocessor of an H100.
`python -m benchmarks.kernel_costs` makes this page and `benchmarks/kernel_costs.json`.

## Per intersection of a splat with a tile

Warp instructions: what eight warps issue for one fragment of a tile. One step is one (fragment, pixel) of a thread.

| kernel | registers | stack, spills | shared memory [bytes] | occupancy | warp instructions | before | of a step |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |
{batches}

Before: one sum of 256 pixels per thread and column, 16 channels per block, features read from global memory through
a local frame of 1,024 bytes (backward, 16 channels). That column was counted by
hand in the listings of the earlier kernels; no script makes it again. Lifting 16 channels took {dense:.0f}; lifting 32
in blocks of 16 x 32 sums took 984.

The backward pass of Taming 3DGS and Faster-GS, a lane per Gaussian that walks the 256 pixels of a tile, needs 287
steps for 32 fragments: to issue as little as the two-step sum it would have {limit:.0f} instructions a step. The
prototype in `benchmarks/bucket_backward.py` has {bucket} (replaying a fragment at a pixel, nine sums, handing the pixel
over; some of them selects that a hand would save), which makes {buckets:,.0f} per intersection. No warp could skip, and
128 bytes per intersection would be stored and read. So it is not adopted.

## Per thread

Static machine instructions of the whole kernel, all branches and loops once.

| kernel | thread per | registers | shared memory [bytes] | occupancy | instructions |
| --- | --- | ---: | ---: | ---: | ---: |
{threads}

## Roofline estimate

**An estimate, not a measurement**: one million Gaussians with harmonics of degree 3, 3 million intersections,
1920 x 1080, an H100 with 132 x 4 warp instructions per cycle at 1.755 GHz and 3.35 TB/s. For each stage the larger of
the counts above at full issue and of the bytes that have to move; sorting and Adam by bytes alone. Latency, launches
and the host are left out.

| | estimated floor [ms] |
| --- | ---: |
{floors}
"""


def write_page(result: dict[str, Any]) -> str:
    """The page in docs/."""
    batches, threads, before = [], [], result["before"]
    for row in result["kernels"]:
        held = f"{row['registers']} |", f"{row['shared']:,} | {row['occupancy']:.1%} |"
        if "warp_instructions" in row:
            was = f"{before[row['kernel']]:,.0f}" if row["kernel"] in before else ""
            step = row["steps"]["MUFU.EX2"]
            spilled = f"{row['stack']}, {row['spills']} |"
            count = f"{row['warp_instructions']:.0f} | {was} | {step:.1f} |"
            batches.append(f"| {row['kernel']} | {held[0]} {spilled} {held[1]} {count}")
        else:
            threads.append(f"| {row['kernel']} | {row['per']} | {' '.join(held)} {row['instructions']:,} |")
    replay = next(row for row in result["kernels"] if row["kernel"] == "backward, colours")
    return PAGE.format(
        arch=result["arch"],
        batches="\n".join(batches),
        threads="\n".join(threads),
        dense=before.get("lift 16 channels", 0),
        limit=replay["warp_instructions"] * 32 / 287,
        bucket=result["bucket_step"],
        buckets=result["bucket_step"] * 287 / 32,
        floors="\n".join(f"| {name} | {value:.1f} |" for name, value in estimates(result["kernels"])),
    )


def main() -> None:
    """Measure all kernels; write JSON and the page."""
    from sgwarp.ops import launcher  # noqa: F401 - starts Warp quietly

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/kernel_costs.json"))
    parser.add_argument("--page", type=Path, default=Path("docs/kernel_costs.md"))
    parser.add_argument("--arch", type=int, default=90)
    arguments = parser.parse_args()
    rows = []
    for subject in subjects():
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(subject, arguments.arch, Path(folder)))
        print(rows[-1], flush=True)
    kept = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        step = bucket_step(arguments.arch, Path(folder))
    result = {"arch": arguments.arch, "kernels": rows, "bucket_step": step, "before": kept.get("before", {})}
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    arguments.page.write_text(write_page(result))


if __name__ == "__main__":
    main()
