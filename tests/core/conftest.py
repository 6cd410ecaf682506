"""Pretended installations: distributions that are only metadata on a path."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


class Site:
    """A folder that Python takes for site-packages, to install pretended distributions into."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def install(
        self, name: str, points: dict[str, dict[str, str]], files: dict[str, str], editable: Path | None = None
    ):
        """Write metadata with the entry points (group -> name -> value) and the modules."""
        info = self.folder / f"{name.replace('-', '_')}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in rows.items()) for group, rows in points.items()]
        (info / "entry_points.txt").write_text("\n".join(lines))
        for path, text in files.items():
            target = self.folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text)
        if editable is not None:
            url = {"url": editable.as_uri(), "dir_info": {"editable": True}}
            (info / "direct_url.json").write_text(json.dumps(url))

    def run(self, *arguments: str) -> subprocess.CompletedProcess:
        """`lidarfw ARGUMENTS` in a process of its own; prints at the end whether torch was imported."""
        code = (
            "import sys\nfrom lidarfw.cli import main\ncode = main(sys.argv[1:])\n"
            "print('torch imported' if 'torch' in sys.modules else 'no torch', file=sys.stderr)\nsys.exit(code)"
        )
        fixtures = Path(__file__).parents[1] / "fixtures"
        environment = {"PYTHONPATH": f"{self.folder}:{fixtures}", "PATH": "/usr/bin:/bin", "HOME": str(self.folder)}
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=self.folder, check=False)


@pytest.fixture
def site(tmp_path) -> Site:
    folder = tmp_path / "site"
    folder.mkdir()
    return Site(folder)
