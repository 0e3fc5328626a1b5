"""A rendering in a process that was forked, or spawned, after its parent has used several threads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import multiprocessing, os, sys
import torch
import sgwarp as sg
from sgwarp.ops.launcher import set_threads

torch.manual_seed(0)
SCENE = sg.Gaussians(torch.rand(400, 3) - torch.tensor([0.5, 0.5, -2.0]), torch.rand(400, 4) + 0.1,
                     torch.rand(400, 3) * 0.1, torch.rand(400), torch.rand(400, 4, 3))
CAMERA = sg.Camera(torch.tensor([[300.0, 0, 160], [0, 300, 160], [0, 0, 1]]), torch.eye(4), 320, 320)


def total():
    return float(sg.render(SCENE, CAMERA).double().sum())


def send(queue):
    queue.put(total())


class Renderings(torch.utils.data.Dataset):
    def __len__(self):
        return 2

    def __getitem__(self, index):
        return total()


def from_process(kind):
    context = multiprocessing.get_context(kind)
    queue = context.Queue()
    process = context.Process(target=send, args=(queue,))
    process.start()
    found = queue.get(timeout=100)
    process.join(20)
    return found


if __name__ == "__main__":
    set_threads(2)
    want = total()
    assert want > 0
    loader = torch.utils.data.DataLoader(
        Renderings(), batch_size=None, num_workers=2, timeout=100, multiprocessing_context="fork"
    )
    assert [float(value) for value in loader] == [want, want], "DataLoader"
    for kind in ("fork", "spawn"):
        assert from_process(kind) == want, kind
    child = os.fork()
    if child == 0:
        os._exit(0 if total() == want else 1)
    assert os.waitpid(child, 0)[1] == 0, "os.fork"
    assert total() == want
    print("all equal")
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork here")
def test_forked_and_spawned_processes_render_the_same(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": root, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "all equal"
