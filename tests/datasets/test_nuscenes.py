"""nuScenes on tables of the official layout: boxes, velocities, ten scans, splits, broken files, a real frame."""

from __future__ import annotations

import json
import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from lidarfw.components.datasets.nuscenes import NuScenesDataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import points_in_boxes_mask
from lidarfw.testing.checks import run_checks
from lidarfw.types import Boxes, DataSpec, Poses, Tracks

sys.path.insert(0, str(Path(__file__).parent))
from nuscenes_tables import Writer

SAMPLE = Path(__file__).parents[3] / "shared" / "data" / "nuscenes_sample"
FOREIGN = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])  # our LiDAR frame -> theirs
START, PERIOD, STEPS = 1_500_000_000_000_000, 50_000, 11  # microseconds; a key frame every 10 scans
SPEED = 0.5  # metres a scan
CAR = {"points": 30, "category": "vehicle.car", "size": (4.0, 1.8, 1.5)}


def matrix(x=0.0, y=0.0, z=0.0, yaw=0.0):
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def ego(step):
    """The vehicle drives north from (100, 200)."""
    return matrix(100, 200 + SPEED * step, 0, math.pi / 2)


LIDAR = matrix(1, 0, 1.8) @ FOREIGN.T  # theirs -> vehicle; the sensor looks ahead, a metre before the axle
CAMERA = np.array([[0, 0, 1, 1.5], [-1, 0, 0, 0], [0, -1, 0, 1.6], [0, 0, 0, 1.0]])  # camera -> vehicle
CORNER = np.array([105.0, 221.0, 1.0])  # stands still, in the global frame


def write_scene(root, writer, name, version="v1.0-mini"):
    """Two key frames; a car that drives north with the vehicle, one without points, an animal, a parked one."""
    for folder in ("samples/LIDAR_TOP", "sweeps/LIDAR_TOP", "samples/CAM_FRONT"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    scene = writer.add("scene", name=name)
    lidar = writer.sensor("LIDAR_TOP", LIDAR)
    camera = writer.sensor("CAM_FRONT", CAMERA, [[500, 0, 400], [0, 500, 300], [0, 0, 1]])
    radar = writer.sensor("RADAR_FRONT", matrix())
    samples = [writer.add("sample", scene_token=scene, timestamp=START + 10 * k * PERIOD) for k in range(2)]
    for step in range(STEPS):
        key = step % 10 == 0
        file = f"{'samples' if key else 'sweeps'}/LIDAR_TOP/{name}_{step}.pcd.bin"
        seen = np.linalg.inv(ego(step) @ LIDAR) @ [*CORNER, 1]
        rows = [[*seen[:3], 255, 3], [0.3, 0.4, -1, 10, 4], *np.random.default_rng(step).uniform(2, 9, (8, 5))]
        np.array(rows, "<f4").tofile(root / file)
        writer.data(samples[step // 10], lidar, START + step * PERIOD, ego(step), file, key)
    for k, sample in enumerate(samples):
        picture = f"samples/CAM_FRONT/{name}_{k}.jpg"
        Image.new("RGB", (800, 600)).save(root / picture)
        writer.data(sample, camera, START + 10 * k * PERIOD, ego(10 * k), picture, True, (800, 600))
        writer.data(sample, radar, START + 10 * k * PERIOD, ego(10 * k), "samples/none.pcd")
        driving = matrix(95, 230 + 5 * k, 0.9, math.pi / 2 + 0.1)
        writer.object(sample, f"{name} driving", driving, attribute="vehicle.moving", **CAR)
        writer.object(sample, f"{name} hidden", matrix(90, 240, 0.9), **CAR | {"points": 0})
        writer.object(sample, f"{name} dog", matrix(90, 220, 0.3), **CAR | {"category": "animal"})
    writer.object(samples[1], f"{name} parked", matrix(98, 215, 0.9), attribute="vehicle.parked", **CAR)
    writer.write(root / version)


@pytest.fixture
def root(tmp_path):
    """v1.0-mini with two scenes, one for training and one for validation."""
    writer = Writer()
    for name in ("scene-0061", "scene-0103"):
        write_scene(tmp_path, writer, name)
    return tmp_path


def dataset(root, split="scene-0061", version="v1.0-mini", **options):
    return NuScenesDataset(root=str(root), split=split, version=version, **options)


def test_points_in_our_convention(root):
    frame = dataset(root, sweeps=1)[0]
    points = frame.inputs["points"]
    raw = np.fromfile(root / "samples/LIDAR_TOP/scene-0061_0.pcd.bin", "<f4").reshape(-1, 5)
    assert np.allclose(points.xyz, np.stack([raw[:, 1], -raw[:, 0], raw[:, 2]], 1))
    assert np.allclose(points.features[:, 0], raw[:, 3] / 255)
    # the LiDAR stands at (100, 201, 1.8) and looks north: the corner is 20 m ahead and 5 m to the right
    assert points.xyz[0].tolist() == pytest.approx([20, -5, -0.8], abs=1e-4)
    assert (frame.meta.id, frame.meta.sequence, frame.meta.index) == ("scene-0061/00", "scene-0061", 0)
    assert frame.meta.time == pytest.approx(START / 1e6)


def test_pose_is_that_of_the_lidar(root):
    frame = dataset(root, pose=True)[1]
    assert np.allclose(frame.targets.poses.matrix[0], matrix(100, 201 + 10 * SPEED, 1.8, math.pi / 2), atol=1e-4)
    assert torch.equal(frame.inputs["pose"].matrix, frame.targets.poses.matrix)


def test_boxes(root):
    """A car 29 m ahead and 5 m to the left, turned by 0.1 rad against the LiDAR; it drives 5 m in half a second."""
    targets = dataset(root)[0].targets
    assert targets.boxes.label.tolist() == [0]
    assert targets.boxes.tensor[0].tolist() == pytest.approx([29, 5, -0.9, 4, 1.8, 1.5, 0.1], abs=1e-4)
    assert targets.boxes.velocity[0].tolist() == pytest.approx([10, 0], abs=1e-4)
    assert targets.boxes.moving.tolist() == [1]
    assert targets.ignored.label.tolist() == [0]  # no point in it; the animal is no class
    second = dataset(root)[1].targets
    assert second.boxes.moving.tolist() == [1, 0]
    assert second.boxes.velocity[1].isnan().all()  # annotated once
    assert second.tracks.id[0] == targets.tracks.id[0] != second.tracks.id[1]


def test_velocity_is_unknown_across_a_gap(root):
    path = root / "v1.0-mini/sample.json"
    rows = json.loads(path.read_text())
    rows[1]["timestamp"] = rows[0]["timestamp"] + 1_600_000
    path.write_text(json.dumps(rows))
    assert dataset(root)[0].targets.boxes.velocity.isnan().all()


def test_classes_are_those_asked_for(root):
    targets = dataset(root, classes=("pedestrian", "car"))[0].targets
    assert targets.boxes.label.tolist() == [1]
    assert len(dataset(root, classes=("bus",))[0].targets.boxes) == 0


def test_ten_scans(root):
    """The corner is at one place in all of them; past returns of the vehicle itself are left out."""
    points = dataset(root)[1].inputs["points"]
    time, count = points.time.unique(return_counts=True)
    assert time.tolist() == pytest.approx([-0.05 * k for k in range(9, -1, -1)], abs=1e-5)
    assert count.tolist() == [9] * 9 + [10]
    corner = points.xyz[points.features[:, 0] == 1]
    assert len(corner) == 10
    assert (corner - corner[0]).abs().max() < 1e-4
    assert len(dataset(root)[0].inputs["points"]) == 10  # the scene starts


def test_cameras(root):
    frame = dataset(root)[1]
    camera = frame.meta.cameras["CAM_FRONT"]
    assert (camera.width, camera.height) == (800, 600)
    assert frame.meta.images == {"CAM_FRONT": str(root / "samples/CAM_FRONT/scene-0061_1.jpg")}
    uv, depth, _ = camera.project(frame.inputs["points"].xyz[:1])
    ahead, right, down = 221 - 206.5, 5, 0.6  # of the corner, from the camera at (100, 206.5, 1.6)
    assert uv[0].tolist() == pytest.approx([400 + 500 * right / ahead, 300 + 500 * down / ahead], abs=1e-2)
    assert depth[0] == pytest.approx(ahead, abs=1e-4)


def test_the_picture_of_a_camera_is_an_input(root):
    Image.new("RGB", (800, 600), (0, 255, 51)).save(root / "samples/CAM_FRONT/scene-0061_1.jpg")
    data = dataset(root, image="CAM_FRONT")
    image = data[1].inputs["image"]
    assert image.features.shape == (1, 3, 600, 800)
    assert image.features[0, :, 300, 400].tolist() == pytest.approx([0, 1, 0.2], abs=0.02)
    assert image.cameras == (data[1].meta.cameras["CAM_FRONT"],)
    assert set(data.spec.inputs) == {"points", "image"}
    with pytest.raises(DataError, match="no picture of CAM_BACK; of: CAM_FRONT"):
        dataset(root, image="CAM_BACK")[1]


def test_splits(root):
    def scenes(split):
        return [drive.name for drive in dataset(root, split).drives]

    assert (scenes("train"), scenes("val")) == (["scene-0061"], ["scene-0103"])
    assert scenes("all") == scenes("train+val") == ["scene-0061", "scene-0103"]
    assert [list(s) for s in dataset(root, "all").sequences()] == [[0, 1], [2, 3]]
    with pytest.raises(DataError, match=r"scene.json: has no scene 'scene-0001'"):
        len(dataset(root, "scene-0001"))


def test_splits_of_the_whole_dataset(tmp_path):
    writer = Writer()
    for number in (1, 2, 3, 35, 37, 1073, 1074):
        writer.add("scene", name=f"scene-{number:04d}")
    writer.write(tmp_path / "v1.0-trainval")
    data = dataset(tmp_path, "val", version="v1.0-trainval")
    assert data.named == ["scene-0003", "scene-0035", "scene-1073"]
    data = dataset(tmp_path, "train", version="v1.0-trainval")
    assert data.named == ["scene-0001", "scene-0002", "scene-0037", "scene-1074"]


def test_test_version_has_no_labels(root):
    (root / "v1.0-mini").rename(root / "v1.0-test")
    (root / "v1.0-test/sample_annotation.json").write_text("[]")
    data = dataset(root, "all", version="v1.0-test")
    assert data.spec.targets == frozenset({Poses})
    assert data[0].targets.boxes is None


def test_spec_needs_no_disk():
    data = dataset("/nowhere", "train", classes=("car",), pose=True)
    assert data.spec.targets == frozenset({Boxes, Tracks, Poses})
    assert (data.spec.sweeps, set(data.spec.inputs)) == (10, {"points", "pose"})
    assert DataSpec.from_plain(data.spec.to_plain()) == data.spec


def test_import_and_spec_do_not_import_torch():
    code = (
        "import sys; from lidarfw.components.datasets.nuscenes import NuScenesDataset as D; "
        "D(root='x').spec; sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_keeps_the_rules_of_a_dataset(root, monkeypatch):
    example = {"root": str(root), "split": "all", "version": "v1.0-mini", "pose": True}
    monkeypatch.setattr(NuScenesDataset, "example", example, False)
    results = run_checks(NuScenesDataset)
    assert [r for r in results if r.status == "failed"] == []
    assert {"frames_match_the_spec", "frames_can_be_read_anywhere"} <= {
        r.check for r in results if r.status == "passed"
    }


def change(root, table, number, **values):
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    rows[number] = {key: value for key, value in (rows[number] | values).items() if value != "-"}
    path.write_text(json.dumps(rows))


@pytest.mark.parametrize(
    ("table", "values", "message"),
    [
        ("sample_annotation", {"size": "-"}, r"sample_annotation.json: row 0 has no size"),
        (
            "sample_annotation",
            {"rotation": [0, 0, 0, 0]},
            r"sample_annotation.json: expected .* quaternion of length 1",
        ),
        ("sample_annotation", {"translation": [1, 2]}, r"sample_annotation.json: expected translation of 3"),
        ("sample_annotation", {"instance_token": "x"}, r"sample_annotation.json|instance.json: has no token 'x'"),
        ("sample_data", {"ego_pose_token": "x"}, r"ego_pose.json: has no token 'x'"),
        ("calibrated_sensor", {"sensor_token": "x"}, r"sensor.json: has no token 'x'"),
        ("instance", {"category_token": "x"}, r"category.json: has no token 'x'"),
    ],
)
def test_broken_tables_are_named(root, table, values, message):
    change(root, table, 0, **values)
    with pytest.raises(DataError, match=message):
        len(dataset(root))


def test_broken_files_are_named(root):
    for content, message in ((b"[{", "ego_pose.json: is no JSON"), (b"{}", "ego_pose.json: expected a list")):
        (root / "v1.0-mini/ego_pose.json").write_bytes(content)
        with pytest.raises(DataError, match=message):
            len(dataset(root))
    (root / "v1.0-mini/ego_pose.json").unlink()
    with pytest.raises(DataError, match=r"cannot read .*ego_pose.json"):
        len(dataset(root))


def test_missing_scans_show_before_training(root):
    (root / "sweeps/LIDAR_TOP/scene-0061_4.pcd.bin").unlink()
    with pytest.raises(DataError, match=r"scene-0061_4.pcd.bin: no such file, nor 0 other scans of scene-0061"):
        dataset(root).prepare()
    dataset(root, sweeps=1).prepare()
    (root / "samples/LIDAR_TOP/scene-0061_0.pcd.bin").write_bytes(b"\0" * 24)
    with pytest.raises(DataError, match=r"scene-0061_0.pcd.bin: 24 bytes is not a multiple of 20"):
        dataset(root)[0]


def test_wrong_options(root):
    with pytest.raises(ConfigError, match="no class 'tram'"):
        dataset("x", classes=("tram",))
    with pytest.raises(ConfigError, match="sweeps must be at least 1"):
        dataset("x", sweeps=0)
    with pytest.raises(DataError, match="root is not set"):
        len(dataset(""))
    with pytest.raises(DataError, match=r"v1.0-trainval: no such folder"):
        len(dataset(root, version="v1.0-trainval"))


# a real key frame


class _Plain(pickle.Unpickler):
    """Plain values and numpy numbers only."""

    def find_class(self, module, name):
        if (module, name) == ("numpy.core.multiarray", "scalar"):
            return np.core.multiarray.scalar if not hasattr(np, "_core") else np._core.multiarray.scalar
        return {("numpy", "dtype"): np.dtype, ("_codecs", "encode"): __import__("_codecs").encode}[module, name]


def _write_real(folder, info, root):
    """The key frame in the official layout: the sample's boxes are given in nuScenes' LiDAR frame."""
    names = ("car", "truck", "trailer", "bus.rigid", "construction", "bicycle", "motorcycle")
    category = [f"vehicle.{n}" for n in names]
    category += ["human.pedestrian.adult", "movable_object.trafficcone", "movable_object.barrier"]
    writer, vehicle = Writer(category), np.array(info["ego2global"])
    lidar = np.array(info["lidar_points"]["lidar2ego"])
    sample = writer.add("sample", scene_token=writer.add("scene", name="scene-0061"), timestamp=START)
    (root / "samples").mkdir()
    (root / "samples/scan.pcd.bin").write_bytes((folder / info["lidar_points"]["lidar_path"]).read_bytes())
    writer.data(sample, writer.sensor("LIDAR_TOP", lidar), START, vehicle, "samples/scan.pcd.bin")
    for number, box in enumerate(info["instances"]):
        x, y, z, length, width, height, yaw = box["bbox_3d"]
        place = vehicle @ lidar @ matrix(x, y, z, yaw)
        writer.object(
            sample, number, place, (length, width, height), int(box["num_lidar_pts"]), category[box["bbox_label"]]
        )
    writer.write(root / "v1.0-mini")


def test_real_boxes_hold_the_points_that_the_file_counts(tmp_path):
    if not SAMPLE.is_dir():
        pytest.skip(f"no real key frame in {SAMPLE}")
    with next(SAMPLE.glob("*.pkl")).open("rb") as file:
        info = _Plain(file).load()["data_list"][0]
    _write_real(SAMPLE, info, tmp_path)
    frame = dataset(tmp_path)[0]
    counts = points_in_boxes_mask(frame.inputs["points"].xyz, frame.targets.boxes.tensor).sum(0)
    given = torch.tensor([int(box["num_lidar_pts"]) for box in info["instances"] if box["num_lidar_pts"]])
    apart = (counts - given).abs()
    assert len(given) > 40
    assert int((apart > 1).sum()) <= 4
    assert int((apart > 0).sum()) <= 8
    ahead = frame.targets.boxes.center[:, 0] > 0
    assert 0.3 < ahead.float().mean() < 0.95
