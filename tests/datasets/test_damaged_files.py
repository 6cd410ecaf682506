"""Whatever happens to a file of a dataset, reading gives a DataError that names it, or frames; never another error."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from lidarfw import registry
from lidarfw.errors import DataError

HERE = Path(__file__).parent
PICTURES = (".png", ".jpg")


def _module(name):
    spec = importlib.util.spec_from_file_location(f"{name}_files", HERE / f"test_{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _semantic_kitti(root):
    _module("semantic_kitti").write_sequence(root / "sequences/08")
    return {"split": "08", "sweeps": 2}


def _kitti_tracking(root):
    _module("kitti_tracking").write_sequence(root / "training", "0000")
    return {"split": "0000", "sweeps": 2}


def _folder(root):
    _module("folder").write_sequence(root / "a")
    return {"classes": ("car", "tree"), "tracks": True, "labels": True, "poses": True, "sweeps": 2}


def _nuscenes(root):
    files = _module("nuscenes")
    files.write_scene(root, files.Writer(), "scene-0061")
    return {"split": "all", "version": "v1.0-mini", "sweeps": 2}


def _kitti_360(root):
    files = _module("kitti_360")
    files.write_calibration(root / "calibration")
    files.write_drive(root)
    return {"split": "03", "images": ("image_00", "image_02"), "sweeps": 2}


def _oxford(root):
    files = _module("oxford")
    files.write_traversal(root)
    (root / "extrinsics").mkdir()
    (root / "extrinsics/velodyne_left.txt").write_text("-0.5 -0.3 -0.2 0 0 3.14\n")
    (root / "extrinsics/ins.txt").write_text("-1.5 0.2 0.6 0 0 0\n")
    return {"split": files.TRAVERSAL, "boxes": True, "sweeps": 2}


def _nclt(root):
    files = _module("nclt")
    files.write_session(root)
    return {"split": files.SESSION, "sweeps": 2}


WRITERS = {
    "semantic_kitti": _semantic_kitti,
    "kitti_tracking": _kitti_tracking,
    "folder": _folder,
    "nuscenes": _nuscenes,
    "kitti_360": _kitti_360,
    "oxford": _oxford,
    "nclt": _nclt,
}


def _damaged(content, rng):
    """The file cut off, emptied, with noise in the middle, with a number replaced, a line twice, and as noise."""
    middle = len(content) // 2
    yield b""
    yield content[:middle]
    yield content[: len(content) - 3]
    yield content[:middle] + rng.bytes(8) + content[middle + 8 :]
    yield content.replace(b"1", b"nan", 1)
    yield content.replace(b"0", b"-9e30", 3)
    yield content.replace(b":", b" ", 2)
    yield content + content.splitlines(keepends=True)[0]
    yield rng.bytes(64)
    yield b"\xff" * len(content)


def _read(name, root, options):
    """None, or the message of the DataError."""
    dataset = registry.load("dataset", name)(root=str(root), **options)
    try:
        dataset.prepare()
        for index in range(len(dataset)):
            dataset[index]
    except DataError as error:
        return str(error)
    return None


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", list(WRITERS))
def test_damaged_files_are_data_errors(name, tmp_path):
    options = WRITERS[name](tmp_path)
    assert _read(name, tmp_path, options) is None
    rng, refused = np.random.default_rng(0), 0
    seen = set()
    for path in sorted(path for path in tmp_path.rglob("*") if path.is_file()):
        if (path.parent, path.suffix) in seen and path.suffix in (".bin", ".label", *PICTURES):
            continue  # one of a kind is enough
        seen.add((path.parent, path.suffix))
        content = path.read_bytes()
        for damaged in _damaged(content, rng):
            path.write_bytes(damaged)
            message = _read(name, tmp_path, options)
            refused += message is not None
            assert message is None or str(tmp_path) in message
        path.unlink()
        message = _read(name, tmp_path, options)
        assert message is None or str(tmp_path) in message
        path.write_bytes(content)
    assert refused > 5
