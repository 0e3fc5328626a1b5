"""The files for Slurm and Kubernetes: their shells accept them, and every option in them is one of the command's."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from sgwarp.cluster.listing import parse_shard
from sgwarp.commands.batch import Batch

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "cluster"


def batch_of(script: str, values: dict[str, str]) -> Batch:
    """The command in a shell script, with these values for its variables."""
    import tyro

    text = script.replace("\\\n", " ")
    for name, value in values.items():
        text = text.replace(f"${name}", value)
    (line,) = re.findall(r"sgwarp batch ([^\n]*)", text)
    return tyro.cli(Batch, args=shlex.split(line))


def test_the_slurm_script():
    path = EXAMPLES / "slurm.sh"
    if shutil.which("bash"):
        subprocess.run(["bash", "-n", str(path)], check=True)
    script = path.read_text()
    first, last = map(int, re.search(r"--array=(\d+)-(\d+)", script).groups())
    shards = set()
    for index in range(first, last + 1):
        values = {"SLURM_ARRAY_TASK_ID": str(index), "SLURM_ARRAY_TASK_COUNT": str(last - first + 1)}
        batch = batch_of(script, values)
        shards.add(parse_shard(batch.shard))
    assert shards == {(index, 20) for index in range(20)}
    cores = int(re.search(r"--cpus-per-task=(\d+)", script).group(1))
    gigabytes = int(re.search(r"--mem=(\d+)G", script).group(1))
    assert batch.workers * batch.threads <= cores
    assert batch.workers * batch.memory_limit <= gigabytes


def test_the_kubernetes_job():
    (job,) = yaml.safe_load_all((EXAMPLES / "kubernetes.yaml").read_text())
    spec = job["spec"]
    assert (job["kind"], spec["completionMode"]) == ("Job", "Indexed")
    (container,) = spec["template"]["spec"]["containers"]
    (script,) = container["args"]
    if shutil.which("sh"):
        subprocess.run(["sh", "-n", "-c", script], check=True)
    batches = [batch_of(script, {"JOB_COMPLETION_INDEX": str(index)}) for index in range(spec["completions"])]
    assert {parse_shard(batch.shard) for batch in batches} == {(index, 20) for index in range(20)}
    requests = container["resources"]["requests"]
    assert batches[0].workers * batches[0].threads <= int(requests["cpu"])
    assert batches[0].workers * batches[0].memory_limit <= int(requests["memory"].removesuffix("Gi"))
    mounts = {mount["name"] for mount in container["volumeMounts"]}
    assert mounts == {volume["name"] for volume in spec["template"]["spec"]["volumes"]}
    rules = spec["podFailurePolicy"]["rules"]
    assert {code for rule in rules for code in rule["onExitCodes"]["values"]} == {1, 2}  # those of failures


def test_variables_are_named_as_the_schedulers_name_them():
    used = {name for path in EXAMPLES.iterdir() for name in re.findall(r"\$\{?([A-Z_]{2,})", path.read_text())}
    assert used == {
        "HOME",
        "JOB_COMPLETION_INDEX",
        "SLURM_ARRAY_TASK_COUNT",
        "SLURM_ARRAY_TASK_ID",
        "TMPDIR",
    }


@pytest.mark.parametrize("name", ["slurm.sh", "kubernetes.yaml"])
def test_the_guide_links_to_them(name):
    assert f"cluster/{name}" in (EXAMPLES.parent / "many-scenes.md").read_text()
