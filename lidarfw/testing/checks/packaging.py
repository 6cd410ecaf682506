"""Checks of a distribution: its entry points, metadata, configs and wheel."""

from __future__ import annotations

import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from lidarfw import assembly, config, registry
from lidarfw.errors import LidarfwError
from lidarfw.interfaces import SLOTS
from lidarfw.testing.checks.subject import SkippedError, require

PACKAGE_CHECKS: list[Callable[[str], None]] = []
_SHIPPED = (".py", ".yaml", ".js", ".template")


def package_check(function: Callable[[str], None]) -> Callable[[str], None]:
    """Make a function of a distribution's name one of its checks."""
    PACKAGE_CHECKS.append(function)
    return function


def entries(distribution: str) -> list[registry.Entry]:
    """Every component that a distribution declares."""
    return [e for slot in SLOTS for e in registry.entries(slot) if e.distribution == distribution]


def conf_packages(distribution: str) -> list[registry.Entry]:
    """The config packages that it declares."""
    return [e for e in registry.conf_packages() if e.distribution == distribution]


@package_check
def entry_points_load(distribution: str) -> None:
    """Every component can be imported, and no other distribution has one of the same name."""
    for entry in entries(distribution):
        try:
            registry.load(entry.slot, entry.name)
        except LidarfwError as error:
            require(False, str(error))


@package_check
def metadata_is_current(distribution: str) -> None:
    """The installed metadata says what pyproject.toml says."""
    stale = [message for message in registry.stale_metadata() if message.startswith(f"{distribution}:")]
    require(not stale, "\n".join(stale))


@package_check
def importing_needs_no_torch(distribution: str) -> None:
    """Importing the top package imports neither torch nor lightning."""
    for package in _top_packages(distribution):
        code = f"import sys, {package}; print(*(m for m in ('torch', 'lightning') if m in sys.modules))"
        path = os.pathsep.join(filter(None, sys.path))  # a plugin may be on the path without being installed
        environment = {**os.environ, "PYTHONPATH": path}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
        require(done.returncode == 0, f"import {package} fails: {done.stderr.strip().splitlines()[-1:]}")
        require(not done.stdout.strip(), f"import {package} imports {done.stdout.strip()}")


@package_check
def configs_compose(distribution: str) -> None:
    """Every preset composes; every experiment composes and can be wired."""
    failures = []
    for group, name in config_options(distribution):
        try:
            composed = config.compose([f"{group}={name}"])
            if group == "experiment":
                assembly.plan(composed)
        except LidarfwError as error:
            failures.append(f"{group}={name}: {error}")
    require(not failures, "\n".join(failures))


def config_options(distribution: str) -> Iterator[tuple[str, str]]:
    """Group and name of every preset and experiment that a distribution ships."""
    for _, folder in _conf_folders(distribution):
        for file in sorted(folder.rglob("*.yaml")):
            group = file.relative_to(folder).parent.as_posix()
            if group in (*SLOTS, "experiment"):
                yield group, file.stem


@package_check
def config_packages_are_packages(distribution: str) -> None:
    """A config package has an __init__.py, without which its files are left out of wheels, and holds configs."""
    for package, folder in _conf_folders(distribution):
        require((folder / "__init__.py").is_file(), f"{package} has no __init__.py")
        require(any(folder.rglob("*.yaml")), f"{package} holds no .yaml file")


@package_check
def wheel_is_complete(distribution: str) -> None:
    """A wheel built from the project holds every module, config and marker of its packages."""
    project = registry.editable_projects().get(distribution)
    if project is None:
        raise SkippedError("it is not installed from a project folder")
    if not (importlib.util.find_spec("pip") and importlib.util.find_spec("setuptools")):
        raise SkippedError("building a wheel here needs pip and setuptools")
    shipped = _wheel_files(project)
    folders = [*_package_folders(_top_packages(distribution)), *_conf_folders(distribution)]
    expected = {f"{package.replace('.', '/')}/{path}" for package, folder in folders for path in _files(folder)}
    missing = sorted(expected - shipped)
    require(not missing, f"the wheel lacks {len(missing)} files: {', '.join(missing[:5])}")


def _top_packages(distribution: str) -> list[str]:
    declared = [*entries(distribution), *conf_packages(distribution)]
    return sorted({entry.value.partition(":")[0].partition(".")[0] for entry in declared})


def _package_folders(packages: list[str]) -> Iterator[tuple[str, Path]]:
    for package in packages:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec is not None else []:
            yield package, Path(folder)


def _conf_folders(distribution: str) -> list[tuple[str, Path]]:
    return list(_package_folders([entry.value for entry in conf_packages(distribution)]))


def _files(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        if path.is_file() and (path.suffix in _SHIPPED or path.name == "py.typed"):
            yield path.relative_to(folder).as_posix()


def build_wheel(project: Path, into: Path) -> Path:
    """Build the wheel of a project with the packages installed here; needs no network and leaves no file in it."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "project"
        ignored = shutil.ignore_patterns(".*", "build", "dist", "runs", "outputs", "*.egg-info", "__pycache__")
        shutil.copytree(project, copy, ignore=ignored)
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
        done = subprocess.run([*command, "--wheel-dir", str(into), str(copy)], capture_output=True, text=True)
    require(done.returncode == 0, f"the wheel of {project} cannot be built:\n{done.stderr.strip()[-2000:]}")
    return sorted(into.glob("*.whl"))[-1]


def _wheel_files(project: Path) -> set[str]:
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(build_wheel(project, Path(folder))) as wheel:
        return set(wheel.namelist())
