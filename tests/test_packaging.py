"""Wheels of lidarfw and of a third party's plugin, installed where no checkout is in reach."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from lidarfw.registry import tomllib
from lidarfw.testing.checks.packaging import build_wheel
from lidarfw.testing.synthetic import frames

ROOT = Path(__file__).resolve().parents[1]
ACME = ROOT / "tests" / "fixtures" / "acme_plugin"
OURS = ("lidarfw", "__editable__", "acme", "distutils-precedence")  # what a clean environment must not see


@dataclass(frozen=True)
class Environment:
    """A virtual environment, and a folder outside the checkout to work in."""

    python: Path
    folder: Path

    def lidarfw(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the installed command."""
        return self.run(str(self.python.with_name("lidarfw")), *arguments)

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        environment |= {"PYTHONDONTWRITEBYTECODE": "1", "COLUMNS": "200"}
        return subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=300, check=False
        )


def dependencies(folder: Path) -> Path:
    """Links to everything installed here but lidarfw and its plugins."""
    folder.mkdir()
    for site in {Path(sysconfig.get_paths()[name]) for name in ("purelib", "platlib")}:
        for path in site.iterdir():
            if not path.name.lower().startswith(OURS) and not (folder / path.name).exists():
                (folder / path.name).symlink_to(path)
    return folder


def make(folder: Path, packages: Path, wheels: list[Path]) -> Environment:
    """An environment with these wheels, which sees the dependencies by a .pth file."""
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    query = "import sysconfig; print(sysconfig.get_paths()['purelib'])"
    site = subprocess.run([str(python), "-c", query], capture_output=True, text=True, check=True).stdout.strip()
    Path(site, "dependencies.pth").write_text(f"{packages}\n")
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, *map(str, wheels)], check=True)
    work = folder / "work"
    work.mkdir()
    return Environment(python, work)


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("wheels")
    return {name: build_wheel(project, folder / name) for name, project in (("lidarfw", ROOT), ("acme", ACME))}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dependencies(tmp_path_factory.mktemp("dependencies") / "site")


@pytest.fixture(scope="module")
def with_acme(tmp_path_factory: pytest.TempPathFactory, packages: Path, wheels: dict[str, Path]) -> Environment:
    return make(tmp_path_factory.mktemp("with_acme"), packages, list(wheels.values()))


@pytest.fixture(scope="module")
def without_acme(tmp_path_factory: pytest.TempPathFactory, packages: Path, wheels: dict[str, Path]) -> Environment:
    return make(tmp_path_factory.mktemp("without_acme"), packages, [wheels["lidarfw"]])


@pytest.fixture(scope="module")
def checkpoint(with_acme: Environment) -> Path:
    """One training step with the third party's head."""
    one_step = ["trainer.max_epochs=1", "trainer.limit_train_batches=1", "trainer.limit_val_batches=1"]
    near = ["backbone.pillars.lower=[0,-16,-3]", "backbone.pillars.upper=[32,16,1]", "logger=none"]
    small = ["dataset.synthetic.frames=2", "dataset.synthetic.points=1024", "hydra.run.dir=run"]
    done = with_acme.lidarfw("train", "head=acme", "trainer=cpu", *one_step, *near, *small)
    assert done.returncode == 0, done.stdout + done.stderr
    found = sorted((with_acme.folder / "run").rglob("*.ckpt"))
    assert found, done.stdout + done.stderr
    return found[-1]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    points = frames(1)[0].inputs["points"]
    file = tmp_path / "scan.bin"
    np.concatenate([points.xyz.numpy(), points.features.numpy()], 1).astype("<f4").tofile(file)
    return file


def tracked(folder: Path, inside: str) -> set[str]:
    """Files of a package folder as they should stand in the wheel."""
    suffixes = (".py", ".yaml", ".js", ".template", ".typed")
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix in suffixes)
    return {f"{inside}/{path.relative_to(folder).as_posix()}" for path in files}


def test_the_wheel_holds_the_tree_and_nothing_else(wheels: dict[str, Path]) -> None:
    with zipfile.ZipFile(wheels["lidarfw"]) as wheel:
        shipped = {name for name in wheel.namelist() if ".dist-info/" not in name}
    expected = tracked(ROOT / "lidarfw", "lidarfw") | tracked(ROOT / "conf", "lidarfw/conf")
    assert "lidarfw/py.typed" in shipped
    assert "lidarfw/conf/experiment/pillars_kitti.yaml" in shipped
    assert sorted(shipped ^ expected) == []


def test_pyproject_lists_every_package_folder() -> None:
    listed = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / "lidarfw").rglob("__init__.py")}
    assert sorted(listed) == sorted({".".join(f.parts) for f in folders} | {"lidarfw.conf"})


def test_list_shows_the_third_party(with_acme: Environment, without_acme: Environment) -> None:
    lines = with_acme.lidarfw("list", "head").stdout.splitlines()
    rows = [line.split() for line in lines]
    assert ["acme", "acme-lidar", "1.0.0"] in rows
    assert ["acme_small", "acme-lidar", "1.0.0", "(preset)"] in rows
    assert ["center", "lidarfw", "0.1.0"] in rows
    assert "acme" not in without_acme.lidarfw("list").stdout


def test_the_installed_package_is_not_the_checkout(with_acme: Environment) -> None:
    done = with_acme.run(str(with_acme.python), "-c", "import lidarfw; print(lidarfw.__file__)")
    assert not Path(done.stdout.strip()).is_relative_to(ROOT)


def test_the_third_party_passes_its_own_conformance_test(with_acme: Environment) -> None:
    file = shutil.copy(ACME / "tests" / "test_conformance.py", with_acme.folder)
    options = ["-q", "-p", "no:cacheprovider", "--rootdir", str(with_acme.folder)]
    done = with_acme.run(str(with_acme.python), "-m", "pytest", *options, str(file))
    assert done.returncode == 0, done.stdout[-3000:]
    assert "passed" in done.stdout


def test_its_head_trains_and_predicts(with_acme: Environment, checkpoint: Path, scan: Path) -> None:
    done = with_acme.lidarfw("predict", str(checkpoint), str(scan), "-o", "out", "--score", "0")
    assert done.returncode == 0, done.stdout + done.stderr
    assert {path.suffix for path in (with_acme.folder / "out").iterdir()} >= {".json", ".png"}


def test_without_it_predict_says_what_is_missing(without_acme: Environment, checkpoint: Path, scan: Path) -> None:
    done = without_acme.lidarfw("predict", str(checkpoint), str(scan))
    assert done.returncode == 2
    assert "head 'acme' from acme-lidar 1.0.0, which is not installed" in done.stderr
    assert "pip install acme-lidar" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_it_training_names_what_there_is(without_acme: Environment) -> None:
    done = without_acme.lidarfw("train", "head=acme")
    assert done.returncode == 2
    assert "no head named 'acme'" in done.stderr
    assert "center (lidarfw 0.1.0)" in done.stderr
