"""Every kernel that CUDA runs compiles to PTX without a GPU; with ptxas at hand, none of them uses local memory."""

import importlib
import itertools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

import sgwarp.kernels
from sgwarp.kernels.compositing import block as compositing_block
from sgwarp.kernels.compositing import block_backward as compositing_block_backward
from sgwarp.kernels.contributors import pairs as pixel_lists
from sgwarp.kernels.lifting import block as lifting_block
from sgwarp.kernels.sparse import convolution_block, normalization_block, voxels
from sgwarp.ops import launcher  # noqa: F401 - starts Warp quietly

pytestmark = pytest.mark.slow

ARCHITECTURES = (80, 86, 89, 90)
# The exact cosine of a huge angle, and the eigenvectors of a matrix, keep a frame; neither stands in an inner loop.
WITH_A_FRAME = ("add_noise", "deform_shapes")
WRITTEN = {80: 80, 86: 80, 89: 80, 90: 90}  # whose PTX an architecture is assembled from: 86 and 89 only add to 80


def cuda_kernels() -> list[wp.Kernel]:
    """All kernels defined in kernels/ but the lane schedule's, which only the CPU runs, and one of each factory."""
    kernels = []
    root = Path(sgwarp.kernels.__path__[0])
    for file in sorted(root.rglob("*.py")):
        if "lanes" not in file.stem:
            dotted = ".".join(file.relative_to(root).with_suffix("").parts)
            module = importlib.import_module(f"sgwarp.kernels.{dotted}")
            kernels += [
                k for k in vars(module).values() if isinstance(k, wp.Kernel) and k.module.name == module.__name__
            ]
    pairs = list(itertools.product((False, True), repeat=2))
    for flag in (False, True):
        kernels += [compositing_block.make_composite_colors_block(depth, flag) for depth in (False, True)]
        kernels.append(compositing_block.make_composite_features_block(flag))
        kernels += [lifting_block.make_lift_dense_block(flag, squared, wide) for squared, wide in pairs]
        kernels += [lifting_block.make_lift_ids_block(flag, squared) for squared in (False, True)]
        kernels.append(pixel_lists.make_list_contributors(flag))
        kernels.append(voxels.make_list_pairs(flag))
    half, single = (wp.float16, wp.bfloat16), wp.float32
    for types in ((single, single), *((value, single) for value in half), *((value, value) for value in half)):
        for module in (convolution_block, normalization_block):
            kernels += [make(*types) for name, make in vars(module).items() if name.startswith("make_")]
    for wide, ordered in pairs:
        # The options go together here: each adds its own lines to a kernel, and together they need most registers.
        kernels.append(compositing_block_backward.make_composite_backward_block(wide, ordered, ordered, ordered))
    return kernels


def test_the_list_of_kernels_is_complete():
    names = {kernel.key.split("__locals__")[-1] for kernel in cuda_kernels()}
    assert {"project_gaussians", "evaluate_harmonics", "list_sorted", "sum_rows", "find_center_pixels"} <= names
    assert "rank_contributors_block" in names
    factories = {
        "list_contributors",
        "composite_colors_block",
        "composite_features_block",
        "composite_backward_block",
        "lift_dense_block",
        "lift_ids_block",
    }
    assert factories <= names
    assert {"project_backward", "harmonics_backward", "sum_intersections", "sum_groups"} <= names
    assert {"key_points", "list_pairs", "tabulate_neighbors"} <= names
    assert {"convolve_blocks", "convolve_and_finish_blocks", "convolve_backward_blocks"} <= names
    assert {"normalize_elements", "sum_normalized_blocks", "normalize_backward_elements"} <= names


@pytest.fixture(scope="module")
def ptx(tmp_path_factory) -> dict[int, list[Path]]:
    folder = tmp_path_factory.mktemp("ptx")
    modules = {kernel.module.name: kernel.module for kernel in cuda_kernels()}
    for arch in set(WRITTEN.values()):
        for module in modules.values():
            wp.compile_aot_module(module, device=None, arch=arch, module_dir=folder / str(arch), use_ptx=True)
    return {arch: sorted((folder / str(written)).glob("*.ptx")) for arch, written in WRITTEN.items()}


def test_every_kernel_compiles_for_every_architecture(ptx):
    modules = {kernel.module.name for kernel in cuda_kernels()}
    for arch in ARCHITECTURES:
        assert len(ptx[arch]) == len(modules)
        for file in ptx[arch]:
            text = file.read_text(errors="ignore")
            assert f".target sm_{WRITTEN[arch]}" in text
            assert ".entry" in text


def find_ptxas() -> str | None:
    for root in map(Path, sys.path):
        for candidate in root.glob("nvidia/*/bin/ptxas"):
            return str(candidate)
    return shutil.which("ptxas")


def test_no_kernel_uses_local_memory(ptx, tmp_path, record_property):
    ptxas = find_ptxas()
    if ptxas is None:
        pytest.skip("no ptxas; pip install 'sgwarp[ptx]' brings one")
    seen = 0
    for arch in ARCHITECTURES:
        for file in ptx[arch]:
            clean = tmp_path / file.name
            clean.write_bytes(file.read_bytes().rstrip(b"\0"))  # ptxas takes the closing NUL for a broken file
            command = [ptxas, "-v", f"-arch=sm_{arch}", str(clean), "-o", str(tmp_path / "out.cubin")]
            done = subprocess.run(command, capture_output=True, text=True)
            if "Unsupported .version" in done.stderr:
                pytest.skip(f"{ptxas} is older than the PTX that Warp writes")
            assert done.returncode == 0, done.stderr
            numbers = (
                r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads.*?Used (\d+) registers"
            )
            for found in re.findall(rf"entry function '(\w+)'.*?{numbers}", done.stderr, flags=re.DOTALL):
                name, frame, stores, loads, registers = found
                seen += 1
                record_property(f"sm_{arch} {name}", f"{registers} registers")
                assert (stores, loads) == ("0", "0"), f"{name} spills on sm_{arch}"
                assert frame == "0" or name.startswith(WITH_A_FRAME), f"{name} has {frame} bytes on sm_{arch}"
    assert seen >= len(ARCHITECTURES) * len({k.key + str(k.module.name) for k in cuda_kernels()})
