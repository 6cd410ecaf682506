"""NCLT on files of the official layout: frames, poses, splits, broken files."""

from __future__ import annotations

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch

from lidarfw.components.datasets.nclt import LIDAR, NcltDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.testing.checks import run_checks
from lidarfw.types import DataSpec, Poses

SESSION = "2012-01-08"
START = 1_326_030_975_000_000  # microseconds
STAMPS = [START + offset for offset in (-50_000, 100_000, 300_000, 500_000)]  # the first is before the first pose
SPEED = 5.0  # m/s to the east
LAMP = (112.0, 220.0, -4.0)  # north, east, down
WIDTH, HEIGHT = 40, 30  # of pictures; the files say how large they are
FOCAL, CENTRE = 16.0, (19.0, 14.0)


def truth(stamp):
    """The body drives east and looks east; a wheel lifts it by 0.1 rad of roll."""
    return f"{stamp},100,{200 + SPEED * (stamp - START) / 1e6},-2,0.1,0,{math.pi / 2}\n"


def write_session(root, name=SESSION):
    (root / name / "velodyne_sync").mkdir(parents=True)
    (root / "ground_truth").mkdir(exist_ok=True)
    rows = "".join(truth(START + 200_000 * k) for k in range(4))
    (root / "ground_truth" / f"groundtruth_{name}.csv").write_text(f"{START - 10},nan,nan,nan,nan,nan,nan\n" + rows)
    for stamp in STAMPS:
        north, east, down = np.array(LAMP) - (100, 200 + SPEED * (stamp - START) / 1e6, -2)
        ahead, right = east, -north
        right, down = math.cos(0.1) * right + math.sin(0.1) * down, math.cos(0.1) * down - math.sin(0.1) * right
        places = np.concatenate([[[ahead, right, down]], np.random.default_rng(stamp).uniform(-50, 50, (9, 3))])
        table = np.zeros(10, [("place", "<u2", (3,)), ("intensity", "u1"), ("laser", "u1")])
        table["place"] = ((places + 100) / 0.005).round()
        table["intensity"] = [255, *range(9)]
        table.tofile(root / name / "velodyne_sync" / f"{stamp}.bin")


@pytest.fixture
def root(tmp_path):
    """Two sessions."""
    for name in (SESSION, "2012-02-05"):
        write_session(tmp_path, name)
    return tmp_path


def write_pictures(root, name=SESSION, times=(100_000, 350_000, 480_000), camera="Cam5"):
    """Pictures with one bright pixel where the lamp is when they are undistorted: two columns to the right of it.

    The camera looks ahead with its right side down, from where the rig is.
    """
    folder = root / name / "lb3" / camera
    folder.mkdir(parents=True, exist_ok=True)
    for time in times:
        picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        picture[14, 25] = (0, 0, 200)  # blue, green, red
        cv2.imwrite(str(folder / f"{START + time}.tiff"), picture)
    (root / "cam_params").mkdir(exist_ok=True)
    (root / "U2D_ALL_1616X1232").mkdir(exist_ok=True)
    number = camera[-1]
    lens = f"{FOCAL},0,{CENTRE[0]}\n0,{FOCAL},{CENTRE[1]}\n0,0,1\n"
    (root / f"cam_params/K_cam{number}.csv").write_text(lens)
    (root / f"cam_params/x_lb3_c{number}.csv").write_text("0.04,-0.002,0,160.868615,89.914152,160.619894\n")
    pixels = [f"{row} {column} {row} {column + 2}" for row in range(HEIGHT) for column in range(WIDTH)]
    text = f"width/cols = {WIDTH} , height/rows = {HEIGHT}\n" + "\n".join(pixels) + "\n"
    (root / f"U2D_ALL_1616X1232/U2D_{camera}_1616X1232.txt").write_text(text)


def dataset(root, split=SESSION, **options):
    return NcltDataset(root=str(root), split=split, **options)


def test_points_in_our_convention(root):
    data = dataset(root)
    frame = data[0]
    points = frame.inputs["points"]
    ahead, left, up = 20 - SPEED * 0.1, 12, 2  # of the lamp, level
    lamp = [ahead, math.cos(0.1) * left + math.sin(0.1) * up, math.cos(0.1) * up - math.sin(0.1) * left]
    assert (points.xyz[0].numpy() + LIDAR).tolist() == pytest.approx(lamp, abs=0.006)
    assert points.features[:2, 0].tolist() == [1, 0]
    assert [data.meta(i).id for i in range(len(data))] == [f"{SESSION}/{stamp}" for stamp in STAMPS[1:]]
    assert frame.meta.time == pytest.approx(STAMPS[1] / 1e6)


def test_pose(root):
    """North, west, up; half way between two rows of the ground truth. Roll to the right is about the nose."""
    matrix = dataset(root, pose=True)[0].inputs["pose"].matrix[0].numpy()
    assert matrix[:3, 3] == pytest.approx([100, -200.5, 2] + matrix[:3, :3] @ LIDAR, abs=1e-4)
    assert matrix[:3, 0] == pytest.approx([0, -1, 0], abs=1e-6)  # looks east
    assert matrix[:3, 2] == pytest.approx([-math.sin(0.1), 0, math.cos(0.1)], abs=1e-6)  # leans to the south


def test_past_scans_stand_in_the_current_frame(root):
    points = dataset(root, sweeps=3)[2].inputs["points"]
    lamp = points.xyz[points.features[:, 0] == 1]
    assert len(lamp) == 3
    assert (lamp - lamp[0]).abs().max() < 0.012  # files have steps of 5 mm
    assert points.time.unique().tolist() == pytest.approx([-0.4, -0.2, 0], abs=1e-5)


def test_pictures_are_undistorted_and_their_cameras_look_where_the_rig_does(root):
    write_pictures(root)
    frame = dataset(root, images=("Cam5",))[0]
    image = frame.inputs["Cam5"]
    assert image.features.shape == (1, 3, HEIGHT, WIDTH)
    bright = (image.features[0, 0] == image.features.max()).nonzero()
    assert bright.tolist() == [[14, 23]]  # two to the left of where it was recorded
    assert image.features.max() == pytest.approx(200 / 255)
    camera = image.cameras[0]
    places = torch.tensor([[20.07, 0, 1.23], [20, 0, -3], [20, 4, 1]]).double() - torch.tensor(LIDAR)
    ahead, below, left = camera.project(places)[0]
    assert ahead.tolist() == pytest.approx(CENTRE, abs=0.3)  # the rig is turned by half a degree
    assert below[0] > CENTRE[0] + 3  # right of the picture is down
    assert left[1] > CENTRE[1] + 3  # down is left
    assert frame.meta.images["Cam5"].endswith(f"lb3/Cam5/{START + 100_000}.tiff")
    assert frame.meta.cameras["Cam5"] == camera


def test_only_frames_with_a_picture_at_most_a_tenth_of_a_second_off(root):
    write_pictures(root, times=(201_000, 480_000))
    data = dataset(root, images=("Cam5",))
    assert [data.meta(i).id for i in range(len(data))] == [f"{SESSION}/{stamp}" for stamp in STAMPS[2:]]
    assert [data.meta(i).images["Cam5"][-11:-5] for i in range(2)] == ["201000", "480000"]


def test_smaller_pictures(root):
    write_pictures(root)
    data = dataset(root, images=("Cam5",), image_scale=0.5)
    image = data[0].inputs["Cam5"]
    assert image.features.shape[2:] == (HEIGHT // 2, WIDTH // 2)
    assert image.cameras[0] == data.meta(0).cameras["Cam5"].scaled(0.5)
    assert data.spec.inputs["Cam5"].geometry.width == 808


def test_splits(root):
    assert [d.name for d in dataset(root, "all").drives] == [SESSION, "2012-02-05"]
    assert dataset(root, "train").named == [SESSION]
    assert len(dataset(root, "test").named) == 4
    with pytest.raises(DataError, match=r"2012-06-15/velodyne_sync: no such folder"):
        len(dataset(root, "test"))


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", sweeps=2, pose=True)
    assert data.spec.targets == frozenset({Poses})
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.nclt import NcltDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("options", [{"sweeps": 2, "pose": True}, {}, {"images": ["Cam5"]}])
def test_keeps_the_rules_of_a_dataset(root, options, monkeypatch):
    for name in (SESSION, "2012-02-05"):
        write_pictures(root, name)
    monkeypatch.setattr(NcltDataset, "example", {"root": str(root), "split": "all", **options}, False)
    results = run_checks(NcltDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        (f"{SESSION}/velodyne_sync/{STAMPS[1]}.bin", b"\0" * 9, r".bin: expected 8 bytes a point.*found 9 bytes"),
        (f"{SESSION}/velodyne_sync/{STAMPS[1]}.bin", b"", r".bin: expected 8 bytes a point.*found 0 bytes"),
        (f"{SESSION}/velodyne_sync/x.bin", b"", r"x.bin: expected a number as the name"),
        (f"ground_truth/groundtruth_{SESSION}.csv", b"1,2\n", r"08.csv, line 1: expected utime,x,y,z,roll"),
        (f"ground_truth/groundtruth_{SESSION}.csv", b"1,2,3,4,5,6,x\n", r"08.csv: expected 7 numbers per line"),
        (
            f"ground_truth/groundtruth_{SESSION}.csv",
            b"1,nan,3,4,5,6,7\n",
            r"08.csv: expected two poses or more, found 0",
        ),
        (
            f"ground_truth/groundtruth_{SESSION}.csv",
            (truth(9) + truth(8)).encode(),
            r"08.csv: the time goes back after 9",
        ),
        (f"ground_truth/groundtruth_{SESSION}.csv", (truth(8) + truth(9)).encode(), r"has no frames"),
    ],
)
def test_broken_files_are_named(root, path, content, message):
    (root / path).write_bytes(content)
    with pytest.raises(DataError, match=message):
        dataset(root)[0]


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("cam_params/K_cam5.csv", "1,2,3\n", r"K_cam5.csv: expected 9 finite numbers, found 3"),
        ("cam_params/K_cam5.csv", "a\n", r"K_cam5.csv: expected 9 numbers"),
        ("cam_params/x_lb3_c5.csv", "1,2,3,4,5,nan\n", r"x_lb3_c5.csv: expected 6 finite numbers"),
        ("U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt", "nothing\n", r"line 1: expected width/cols = 1616"),
        ("U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt", "1, 1\n0 0 a 0\n", r"1232.txt: expected 4 numbers per line"),
        (
            "U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt",
            "2, 1\n0 0 0 0\n",
            r"expected 2 lines of 4 numbers, found \(1, 4\)",
        ),
        ("U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt", "2, 1\n0 0 0 0\n0 2 0 0\n", r"found none for row 0, column 1"),
        (
            "U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt",
            "2, 1\n0 0 0 0\n0 1 0 0\n",
            r"expected 2 x 1 pixels .*found 40 x 30",
        ),
        (f"{SESSION}/lb3/Cam5/{START + 100_000}.tiff", "II*", r"100000.tiff: cannot be decoded as a picture"),
    ],
)
def test_broken_files_of_pictures_are_named(root, path, content, message):
    write_pictures(root)
    (root / path).write_text(content)
    with pytest.raises(DataError, match=message):
        dataset(root, images=("Cam5",))[0]


def test_pictures_that_are_not_there(root):
    with pytest.raises(DataError, match=r"lb3/Cam5: no such folder"):
        dataset(root, images=("Cam5",)).prepare()
    write_pictures(root, times=())
    with pytest.raises(DataError, match=r"lb3/Cam5: no .tiff pictures.*\n.*unpack them"):
        dataset(root, images=("Cam5",)).prepare()
    write_pictures(root)
    (root / "U2D_ALL_1616X1232/U2D_Cam5_1616X1232.txt").unlink()
    with pytest.raises(DataError, match=r"U2D_Cam5_1616X1232.txt: cannot be read(.|\n)*unpack U2D_ALL"):
        dataset(root, images=("Cam5",)).prepare()
    with pytest.raises(ConfigError, match=r"has no camera 'Cam6'\. Cameras: Cam0"):
        dataset("x", images=("Cam6",))
    with pytest.raises(ConfigError, match="image_scale must be over 0"):
        dataset("x", image_scale=0)


def test_nothing_there(root):
    (root / f"ground_truth/groundtruth_{SESSION}.csv").unlink()
    with pytest.raises(DataError, match=r"cannot read .*groundtruth_2012-01-08.csv"):
        len(dataset(root))
    with pytest.raises(DataError, match="no such folder"):
        len(dataset("/nowhere"))
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))
    with pytest.raises(ConfigError, match="sweeps must be at least 1"):
        dataset("x", sweeps=0)
