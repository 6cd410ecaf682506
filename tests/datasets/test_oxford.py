"""Oxford Radar RobotCar on files of the official layout: frames, poses, boxes, splits, broken files."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from lidarfw.components.datasets.oxford import OxfordDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.testing.checks import run_checks
from lidarfw.types import Boxes, DataSpec, Poses

TRAVERSAL = "2019-01-11-14-02-26"
START = 1_547_215_346_000_000  # microseconds
STAMPS = [START + offset for offset in (-10_000, 20_000, 70_000, 120_000)]  # the first is before the first pose
SPEED = 10.0  # m/s to the east
HEADER = "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,roll,pitch,yaw\n"
LAMP = (5_735_105.0, 620_030.0, -112.0)  # northing, easting, down


def ins(stamp):
    """The inertial unit drives east."""
    east = 620_000 + SPEED * (stamp - START) / 1e6
    return f"{stamp},INS_SOLUTION_GOOD,51.7,-1.2,110,5735100,{east},-110,30U,0,0,{math.pi / 2}\n"


def write_traversal(root, name=TRAVERSAL):
    """The LiDAR looks back, z down. It is 1 m ahead of the inertial unit, 0.5 m to its left and 0.8 m above."""
    folder = root / f"{name}-radar-oxford-10k"
    for part in ("velodyne_left", "gps", "boxes"):
        (folder / part).mkdir(parents=True)
    (folder / "gps/ins.csv").write_text(HEADER + "".join(ins(START + 20_000 * k) for k in range(8)))
    for stamp in STAMPS:
        north, east, down = np.array(LAMP) - (5_735_100, 620_000 + SPEED * (stamp - START) / 1e6, -110)
        ahead, left, up = east - 1, north - 0.5, -down - 0.8
        rng = np.random.default_rng(stamp)
        table = np.column_stack([rng.uniform(-20, 20, (20, 3)), rng.uniform(0, 200, 20)])
        table[0] = -ahead, left, -up, 255
        table.T.astype("<f4").tofile(folder / "velodyne_left" / f"{stamp}.bin")
        (folder / "boxes" / f"{stamp}.txt").write_text("Vehicle 10 2 -1 4 1.8 1.5 0.1\nTram 1 2 3 9 3 3 0\n")


@pytest.fixture
def root(tmp_path):
    """Two traversals and the extrinsics."""
    for name in (TRAVERSAL, "2019-01-15-13-06-37"):
        write_traversal(tmp_path, name)
    (tmp_path / "extrinsics").mkdir()
    (tmp_path / "extrinsics/velodyne_left.txt").write_text(f"-0.5 -0.3 -0.2 0 0 {math.pi}\n")
    (tmp_path / "extrinsics/ins.txt").write_text("-1.5 0.2 0.6 0 0 0\n")
    return tmp_path


def dataset(root, split=TRAVERSAL, **options):
    return OxfordDataset(root=str(root), split=split, **options)


def test_points_in_our_convention(root):
    data = dataset(root)
    frame = data[0]
    path = root / f"{TRAVERSAL}-radar-oxford-10k/velodyne_left/{STAMPS[1]}.bin"
    raw = np.fromfile(path, "<f4").reshape(4, -1)
    points = frame.inputs["points"]
    assert np.allclose(points.xyz, np.stack([-raw[0], raw[1], -raw[2]], 1))
    assert np.allclose(points.features[:, 0], raw[3] / 255)
    assert points.xyz[0].tolist() == pytest.approx([30 - 0.2 - 1, 4.5, 1.2], abs=1e-4)
    assert [data.meta(i).id for i in range(len(data))] == [f"{TRAVERSAL}/{stamp}" for stamp in STAMPS[1:]]
    assert frame.meta.time == pytest.approx(STAMPS[1] / 1e6)
    assert frame.meta.path == str(path)


def test_pose_is_that_of_the_lidar(root):
    """North, west, up from the origin of the map; half way between two inertial poses."""
    matrix = dataset(root, pose=True)[1].inputs["pose"].matrix[0]
    expected = [[0, 1, 0, 100.5], [-1, 0, 0, -(0.7 + 1)], [0, 0, 1, 110.8], [0, 0, 0, 1]]
    assert np.allclose(matrix, expected, atol=1e-4)


def test_past_scans_stand_in_the_current_frame(root):
    points = dataset(root, sweeps=3)[2].inputs["points"]
    lamp = points.xyz[points.features[:, 0] == 1]
    assert len(lamp) == 3
    assert (lamp - lamp[0]).abs().max() < 1e-4
    assert points.time.unique().tolist() == pytest.approx([-0.1, -0.05, 0], abs=1e-5)


def test_boxes_with_track_ids_are_tracks(root):
    data = dataset(root, boxes=True)
    assert data[0].targets.tracks is None
    labels = next(root.glob(f"**/boxes/{STAMPS[1]}.txt"))
    labels.write_text("Vehicle 10 2 -1 4 1.8 1.5 0.1 7\nTram 1 2 3 9 3 3 0 8\n")
    assert dataset(root, boxes=True)[0].targets.tracks.id.tolist() == [7]


def test_boxes(root):
    data = dataset(root, boxes=True)
    boxes = data[0].targets.boxes
    assert boxes.tensor.tolist() == [pytest.approx([10, 2, -1, 4, 1.8, 1.5, 0.1])]
    assert boxes.label.tolist() == [0]
    assert data.spec.targets == frozenset({Boxes, Poses})


def test_splits(root):
    assert [d.name for d in dataset(root, "all").drives] == [TRAVERSAL, "2019-01-15-13-06-37"]
    assert len(dataset(root, "train").named) == len(dataset(root, "test").named) == 4
    assert set(dataset(root, "train").named).isdisjoint(dataset(root, "test").named)
    with pytest.raises(DataError, match=r"2019-01-14-12-05-52-radar-oxford-10k: no such folder"):
        len(dataset(root, "train"))
    plain = root / TRAVERSAL
    (root / f"{TRAVERSAL}-radar-oxford-10k").rename(plain)
    assert len(dataset(root)) == 3


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", sweeps=2, pose=True)
    assert (data.spec.targets, data.spec.classes) == (frozenset({Poses}), ())
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.oxford import OxfordDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("options", [{"boxes": True, "sweeps": 2, "pose": True}, {}])
def test_keeps_the_rules_of_a_dataset(root, options, monkeypatch):
    monkeypatch.setattr(OxfordDataset, "example", {"root": str(root), "split": "all", **options}, False)
    results = run_checks(OxfordDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        (f"velodyne_left/{STAMPS[1]}.bin", b"\0" * 20, r".bin: expected 4 rows of float32 .* found 20 bytes"),
        (f"velodyne_left/{STAMPS[1]}.bin", b"", r".bin: expected 4 rows of float32 .* found 0 bytes"),
        (f"velodyne_left/{STAMPS[1]}.bin", np.full(8, 300, "<f4").tobytes(), r".bin: expected finite points with int"),
        (f"boxes/{STAMPS[1]}.txt", b"Vehicle 1 2\n", r".txt, line 1: expected 8 columns"),
        ("gps/ins.csv", b"timestamp,x\n1,2\n", r"ins.csv: has no rows with the column northing"),
        ("gps/ins.csv", (HEADER + ins(START) * 2).encode(), r"ins.csv, line 3: expected finite numbers and a rising"),
        ("gps/ins.csv", (HEADER + ins(START).replace("5735100", "x")).encode(), r"ins.csv: expected numbers in"),
        ("../extrinsics/ins.txt", b"1 2 3\n", r"ins.txt, line 1: expected 6 numbers, found 3"),
        ("../extrinsics/ins.txt", b"", r"ins.txt: expected one line"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    (root / f"{TRAVERSAL}-radar-oxford-10k" / path).write_bytes(content)
    with pytest.raises(DataError, match=message):
        dataset(root, boxes=True)[0]


def test_nothing_there(root):
    (root / "extrinsics/velodyne_left.txt").unlink()
    with pytest.raises(DataError, match=r"velodyne_left.txt: no such file.\n  fix: copy the folder extrinsics"):
        len(dataset(root))
    with pytest.raises(DataError, match="no such folder"):
        len(dataset("/nowhere"))
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))


def test_wrong_options():
    with pytest.raises(ConfigError, match="no lidar 'radar'"):
        dataset("x", lidar="radar")
    with pytest.raises(ConfigError, match="sweeps must be at least 1"):
        dataset("x", sweeps=0)
