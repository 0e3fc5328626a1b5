"""Every road to an installed package carries the kernels: sdist -> wheel, and the editable install."""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]


def run(*command: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=cwd,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    run("-m", "hatchling", "build", "-t", "sdist", "-d", folder)
    (archive,) = folder.glob("sgwarp-*.tar.gz")
    return archive


def test_sdist_is_complete(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    for path in (
        "kernels/gaussian.py",
        "sgwarp/kernels.py",
        "tests/test_packaging.py",
        "constraints.txt",
        "LICENSE",
        "Makefile",
    ):
        assert path in names


def test_wheel_from_the_sdist_brings_its_kernels(sdist, tmp_path):
    target = tmp_path / "installed"
    quiet = ("--quiet", "--disable-pip-version-check", "--no-deps", "--no-build-isolation", "--no-index")
    run("-m", "pip", "install", *quiet, "--target", target, sdist)
    code = (
        "import sgwarp.kernels, sgwarp.kernels.gaussian as gaussian, sgwarp\n"
        "print(sgwarp.__file__, gaussian.__file__, *sgwarp.kernels.__path__, sep='\\n')"
    )
    package, gaussian, folder = run("-c", code, cwd=tmp_path, PYTHONPATH=str(target)).splitlines()[-3:]
    assert Path(package) == target / "sgwarp" / "__init__.py"
    assert Path(gaussian) == target / "sgwarp" / "kernels" / "gaussian.py"
    assert Path(folder) == target / "sgwarp" / "kernels"
    shipped = {path.name for path in (target / "sgwarp" / "kernels").glob("*.py")}
    assert shipped == {path.name for path in (ROOT / "kernels").glob("*.py")}
    # Data travels too: the demo's room, the encoder's class names, the marker of a typed package.
    source = ROOT / "sgwarp"
    wanted = {
        path.relative_to(source) for path in source.rglob("*") if path.is_file() and "__pycache__" not in path.parts
    }
    installed = {path.relative_to(target / "sgwarp") for path in (target / "sgwarp").rglob("*")}
    assert Path("py.typed") in wanted
    assert not wanted - installed
    assert not (target / "tests").exists()
    assert list(target.glob("sgwarp-*.dist-info/licenses/LICENSE"))


def test_editable_install_finds_the_kernels_of_the_checkout(tmp_path):
    code = f"from hatchling.build import build_editable; build_editable({str(tmp_path)!r})"
    run("-c", code)
    (wheel,) = tmp_path.glob("sgwarp-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    # -S and -I: nothing of this environment, only what the editable wheel puts on the path.
    code = f"import site; site.addsitedir({str(site)!r}); import sgwarp.kernels as k; print(k.__file__, *k.__path__)"
    bridge, folder = run("-I", "-S", "-c", code, cwd=tmp_path).split()
    assert Path(bridge) == ROOT / "sgwarp" / "kernels.py"
    assert Path(folder) == ROOT / "kernels"


def test_constraints_pin_every_requirement():
    """Each direct requirement of pyproject.toml has exactly one version for each Python, so that a year from now the
    same packages are installed."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    blocks = re.findall(r"^(?:dependencies|[a-z]+) = \[(.*?)\]$", text, flags=re.MULTILINE | re.DOTALL)
    wanted = {name.lower() for block in blocks for name in re.findall(r'"([A-Za-z][\w-]*)[><=]', block)}
    assert {"torch", "warp-lang", "tyro", "pytest", "ruff"} <= wanted
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.split("==")[0].lower() for line in pins if line and not line.startswith("#")}
    assert wanted <= pinned
    assert all("==" in line for line in pins if line and not line.startswith("#"))
    assert "torch==2.13.0" in pins


def test_what_extras_ask_for():
    """Extras within extras are resolved without a build of the package, which would fetch its tools unseen."""
    sys.path.insert(0, str(ROOT))
    try:
        from tools.install import requirements
    finally:
        sys.path.remove(str(ROOT))
    plain, demo = requirements([]), requirements(["demo"])
    assert any(text.startswith("torch") for text in plain)
    assert set(plain) < set(demo)
    assert any(text.startswith("tyro") for text in demo)
    assert not any(text.startswith("sgwarp") for text in demo)
    with pytest.raises(KeyError):
        requirements(["none"])


def test_an_install_without_hashes_fails(monkeypatch, capsys):
    sys.path.insert(0, str(ROOT))
    try:
        from tools import install
    finally:
        sys.path.remove(str(ROOT))
    ran = []
    monkeypatch.setattr(install.subprocess, "run", lambda command, **_: ran.append(command))
    with pytest.raises(LookupError, match=r"torch==0\.0"):
        install._install_hashed([("torch", "0.0")])
    assert ran == []
    monkeypatch.setattr(install, "_install", lambda wanted: install._install_hashed([("torch", "0.0")]))
    assert install.main("demo") == 1
    assert "has no hashes of torch==0.0; run make lock" in capsys.readouterr().err
    assert "export HASHED=1" in (ROOT / ".ci" / "run").read_text()


def test_the_lock_has_hashes_of_every_pin():
    """`make lock` after constraints.txt has changed."""
    sys.path.insert(0, str(ROOT))
    try:
        from tools.lock import LOCK, entries, normalized
    finally:
        sys.path.remove(str(ROOT))
    known = entries(LOCK)
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {tuple(line.split(";")[0].strip().split("==")) for line in lines if line and not line.startswith("#")}
    missing = [f"{name}=={version}" for name, version in pins if not known.get((normalized(name), version))]
    assert not missing
    assert len(pins) > 100
