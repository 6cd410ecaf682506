"""`lidarfw new`: what it writes passes every check as it is, for every slot."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lidarfw import assembly, config, registry
from lidarfw.cli import main
from lidarfw.interfaces import SLOTS
from lidarfw.testing.checks import CHECKS, cases

ROOT = Path(__file__).resolve().parents[1]


def install(project: Path) -> None:
    """Write the metadata that `pip install` would, next to the packages."""
    meta = registry.tomllib.loads((project / "pyproject.toml").read_text())["project"]
    info = project / f"{meta['name'].replace('-', '_')}-{meta['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {meta['name']}\nVersion: {meta['version']}\n")
    groups = (
        f"[{group}]\n" + "".join(f"{n} = {v}\n" for n, v in e.items()) for group, e in meta["entry-points"].items()
    )
    (info / "entry_points.txt").write_text("\n".join(groups))


@pytest.fixture(scope="module")
def plugins(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """One new distribution for every slot, installed for this process."""
    root = tmp_path_factory.mktemp("plugins")
    with pytest.MonkeyPatch.context() as patch:
        projects = {}
        for slot in SLOTS:
            projects[slot] = root / slot
            assert main(["new", f"fresh-{slot}", "--slot", slot, "-o", str(projects[slot])]) == 0
            install(projects[slot])
            patch.syspath_prepend(str(projects[slot]))
        registry._installed.cache_clear()
        registry.editable_projects.cache_clear()
        yield projects
    registry._installed.cache_clear()
    registry.editable_projects.cache_clear()


@pytest.mark.parametrize("slot", SLOTS)
def test_a_new_plugin_passes_every_check(plugins: dict[str, Path], slot: str) -> None:
    results = [case.result() for case in cases(f"fresh-{slot}")]
    assert [f"{r.component} {r.check}: {r.message}" for r in results if r.status == "failed"] == []
    assert sum(r.status == "passed" for r in results) >= 10
    assert f"{slot}.fresh_{slot}" in {r.component for r in results}


@pytest.mark.parametrize("slot", [slot for slot in SLOTS if slot != "retriever"])
def test_its_experiment_uses_it_with_the_option_of_its_preset(plugins: dict[str, Path], slot: str) -> None:
    plan = assembly.plan(config.compose([f"experiment=fresh_{slot}_demo"]))
    if slot in ("dataset", "transform"):
        assert f"fresh_{slot}" in plan.config[slot]
        return
    step = next(s for s in plan.steps if s.id == f"{slot}.fresh_{slot}")
    assert any(step.options[name] != o.default for name, o in step.declared.options.items())


def test_what_is_written_is_tidy_and_typed(plugins: dict[str, Path]) -> None:
    rules = registry.tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["lint"]
    lint = ["check", "--select", ",".join(rules["select"]), "--ignore", ",".join(rules["ignore"])]
    for project in plugins.values():
        for tool in (lint, ["format", "--check"]):
            command = [sys.executable, "-m", "ruff", *tool, "--isolated", "--line-length", "120", "."]
            done = subprocess.run(command, capture_output=True, text=True, cwd=project)
            assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["Acme_Lidar"], "'Acme_Lidar' is no name for a distribution"),
        (["acme-lidar", "--component", "Acme"], "'Acme' is no name for a component"),
        (["lidarfw-center"], "head 'center' exists already, in lidarfw 0.1.0.\n  fix: --component OTHER_NAME"),
        (["torch"], "a package named 'torch' is installed already"),
    ],
)
def test_names_that_cannot_work_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    target = tmp_path / "out"
    assert main(["new", *arguments, "--slot", "head", "-o", str(target)]) == 2
    assert message in capsys.readouterr().err
    assert not target.exists()


def test_a_folder_in_use_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "precious").write_text("mine")
    assert main(["new", "acme-lidar", "--slot", "neck", "-o", str(tmp_path)]) == 2
    assert "exists and is not empty" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["precious"]


def test_the_guide_shows_what_new_writes(tmp_path: Path) -> None:
    """Every python, toml and yaml block of the guide stands in the files of the plugin that it makes."""
    guide = (ROOT / "docs" / "write-a-plugin.md").read_text(encoding="utf-8")
    command = re.search(r"^\$ lidarfw (new .*)$", guide, re.MULTILINE)
    assert command is not None
    assert main([*command[1].split(), "-o", str(tmp_path / "plugin")]) == 0
    files = {
        p.relative_to(tmp_path / "plugin").as_posix(): p.read_text()
        for p in (tmp_path / "plugin").rglob("*.*")
        if p.is_file()
    }
    blocks = re.findall(r"^```(?:python|toml|yaml)\n(.*?)^```$", guide, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 7
    assert [block for block in blocks if not any(block in text for text in files.values())] == []
    named = re.findall(r"^\| `([\w/.]+)` \|", guide, re.MULTILINE)
    assert set(named) - {check.name for check in CHECKS} <= set(files)
