"""`lidarfw check data`: faults with file and reason, a table, and the exit code."""

from __future__ import annotations

import numpy as np
import pytest

from lidarfw.cli import main


@pytest.fixture
def root(tmp_path):
    """Two scans of SemanticKITTI."""
    folder = tmp_path / "sequences/08"
    for name in ("velodyne", "labels"):
        (folder / name).mkdir(parents=True)
    (folder / "calib.txt").write_text("Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n")
    (folder / "times.txt").write_text("0\n0.1\n")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    for name in ("000000", "000001"):
        np.tile(np.array([3, 4, 0, 0.5], "<f4"), (6, 1)).tofile(folder / "velodyne" / f"{name}.bin")
        np.array([10, 10, 252, 40, 0, 0], "<u4").tofile(folder / "labels" / f"{name}.label")
    return tmp_path


def check(root, *words):
    return main(["check", "data", "semantic_kitti", f"root={root}", "split=08", *words])


def test_whole_data(root, capsys):
    assert check(root, "task=moving") == 0
    out = capsys.readouterr().out
    for text in ("2 in 1 sequences", "6 .. 6, median 6; farthest 5.0 m", "6 (50.00%)", "2 (16.67%)", "unlabelled"):
        assert text in out


def test_every_fault_is_told_with_its_file(root, capsys):
    folder = root / "sequences/08"
    (folder / "labels/000000.label").write_bytes(b"\0" * 8)
    (folder / "velodyne/000001.bin").write_bytes(b"")
    assert check(root) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("08/000000: ")
    assert "000000.label: expected 24 bytes" in lines[0]
    assert lines[1].startswith("08/000001: ")
    assert "000001.bin: the file is empty" in lines[1]


def test_missing_files_and_a_split_that_cannot_be_listed(root, capsys):
    (root / "sequences/08/labels/000001.label").unlink()
    assert check(root) == 1
    out = capsys.readouterr().out
    assert out.startswith("split 08: ")
    assert "1 of 2 label files are missing" in out
    assert "\n08/000001: " in out
    (root / "sequences/08/poses.txt").unlink()
    assert check(root) == 1
    assert "poses.txt" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data"], "which dataset?"),
        (["data", "semantic_kiti", "root=x"], "no dataset named 'semantic_kiti'"),
        (["data", "semantic_kitti", "rot=x"], "no option 'rot'"),
        (["data", "semantic_kitti", "root=[x"], "cannot read the options"),
        (["lidarfw", "data"], "one target at a time"),
    ],
)
def test_wrong_words(words, message, capsys):
    assert main(["check", *words]) == 2
    assert message in capsys.readouterr().err
