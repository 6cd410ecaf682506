"""The town's files in every layout, read by the core's loader of the real data."""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw.assembly import make_dataset
from lidarfw.components.datasets.nclt import NcltDataset
from lidarfw.datacheck import check_dataset
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset
from scipy.spatial import cKDTree

from lidarfw_town import generate as generating
from lidarfw_town.__main__ import main
from lidarfw_town.camera import ladybug_cameras
from lidarfw_town.drive import Drive, Object, TownFrame
from lidarfw_town.generate import Job, drive_of, generate
from lidarfw_town.layouts import LAYOUTS
from lidarfw_town.layouts.kitti_360 import rig
from lidarfw_town.layouts.nuscenes import cameras
from lidarfw_town.render import photograph

FRAMES, STRIDE, WIDTH = 3, 5, 120
OPTIONS: dict[str, dict[str, Any]] = {
    "kitti": {"image": True, "camera_view": False, "classes": ("Car", "Van", "Truck", "Misc", "Pedestrian", "Cyclist")},
    "kitti_tracking": {"camera_view": False, "classes": ("Car", "Van", "Truck", "Misc", "Pedestrian", "Cyclist")},
    "semantic_kitti": {"task": "moving", "sweeps": 2},
    "nuscenes": {"sweeps": 2},
    "kitti_360": {"images": ("image_00", "image_01", "image_02", "image_03"), "sweeps": 2},
    "oxford": {"boxes": True, "sweeps": 2},
    "nclt": {"sweeps": 2, "images": ("Cam0", "Cam1", "Cam5")},
}
BOXED, POSED = ("kitti", "kitti_tracking", "nuscenes", "oxford"), [name for name in OPTIONS if name != "kitti"]


def job_of(layout: str, root: str | Path) -> Job:
    return Job(layout, str(root), frames=FRAMES, length=FRAMES, stride=STRIDE, sensor="small", picture_width=WIDTH)


@pytest.fixture(scope="module", params=OPTIONS)
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Job]:
    """Three frames of one drive, half a second apart, by the command; layouts that share a drive are neighbours."""
    job = job_of(request.param, tmp_path_factory.mktemp(request.param))
    words = {"layout": job.layout, "out": job.root, "frames": FRAMES, "length": FRAMES, "stride": STRIDE}
    words |= {"sensor": "small", "picture-width": WIDTH, "workers": 1}
    assert main([word for key, value in words.items() for word in (f"--{key}", str(value))]) == 0
    return job


@pytest.fixture(scope="module")
def dataset(written: Job) -> Dataset:
    """The loader of the real data, as it is."""
    options = {"type": written.layout, "root": written.root, **OPTIONS[written.layout]}
    return make_dataset({"dataset": {written.layout: options}}, _split(written.layout))


def _split(layout: str) -> str:
    """The only drive that is there; the official splits name others too."""
    return LAYOUTS[layout].drives["train"][0] if LAYOUTS[layout].drives else "train"


def truth(job: Job, number: int) -> TownFrame:
    return drive_of(job, 0).frame(10 + number * STRIDE)


def hashes(root: str | Path) -> dict[str, str]:
    files = sorted(path for path in Path(root).rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_loader_of_the_real_data_finds_no_fault(written: Job, dataset: Dataset) -> None:
    found = check_dataset(dataset)
    assert found.faults == []
    assert found.frames == FRAMES
    assert found.reach > 40
    assert sum(found.boxes.values()) > 4 or written.layout not in BOXED


def test_points_are_those_of_the_scan(written: Job, dataset: Dataset) -> None:
    frame = truth(written, 1)
    points = dataset[1].inputs["points"]
    now = slice(0, len(frame.points))
    coarse = 0.0026 if written.layout == "nclt" else 1e-4
    assert np.abs(points.xyz[now].numpy() - frame.points[:, :3]).max() < coarse
    assert np.abs(points.features[now, 0].numpy() - frame.points[:, 3]).max() <= 0.5 / 255 + 1e-6


def test_boxes_are_those_of_the_objects_and_hold_their_points(written: Job, dataset: Dataset) -> None:
    if written.layout not in BOXED:
        pytest.skip("the layout has no boxes")
    checked = 0
    for number in range(FRAMES):
        frame, boxes = truth(written, number), dataset[number].targets.boxes
        assert boxes is not None
        for box, label in zip(boxes.tensor.double().numpy(), boxes.label.tolist()):
            thing = min(frame.objects, key=lambda one: np.linalg.norm(np.array(one.box[:3]) - box[:3]))
            assert box[:6] == pytest.approx(thing.box[:6], abs=0.011)  # KITTI's files have two digits
            assert np.cos(box[6] - thing.box[6]) > 0.9999
            assert _of_class(dataset.spec.classes[label], thing.kind)
            checked += _holds(drive_of(written, 0), frame, thing, box)
    assert checked > 1


def _of_class(name: str, kind: str) -> bool:
    same = {"Misc": ("bus", "motorcyclist"), "Vehicle": ("car", "van", "truck", "bus"), "car": ("car", "van")}
    same |= {"Cyclist": ("cyclist", "motorcyclist"), "bicycle": ("cyclist",), "motorcycle": ("motorcyclist",)}
    return kind in same.get(name, (name.lower(),))


def _holds(drive: Drive, frame: TownFrame, thing: Object, box: np.ndarray) -> bool:
    """Points of the object are in its box, and those in the box are of the object; whether there was one to look at."""
    own, mixed = (frame.label >> 16) == thing.id, (frame.label & 0xFFFF) == 1
    stored = replace(thing, box=tuple(box.tolist()))
    out = (np.abs(drive.in_box(stored, frame, drive.in_world(frame))) - box[3:6] / 2).max(1)
    # three deviations of the range, and what two digits of metres and radians leave out
    assert (out[own] < 3 * drive.lidar.noise + 0.03).all(), thing
    assert own.sum() < 20 or (own | mixed)[out < -0.1].mean() > 0.9, thing
    return bool(own.sum() >= 3)


def test_poses_are_those_of_the_drive_and_align_what_stands_still(written: Job, dataset: Dataset) -> None:
    if written.layout not in POSED:
        pytest.skip("the layout has no poses")
    loaded = [dataset[n].targets.poses.matrix[0].double().numpy() for n in range(FRAMES)]
    frames = [truth(written, n) for n in range(FRAMES)]
    relative = np.linalg.inv(loaded[0]) @ np.stack(loaded)
    expected = np.linalg.inv(frames[0].pose) @ np.stack([frame.pose for frame in frames])
    assert relative == pytest.approx(expected, abs=2e-3)
    assert np.linalg.norm(relative[2, :3, 3]) > 1
    if LAYOUTS[written.layout].compensated:
        clouds = []
        for frame, pose in zip(frames[:2], loaded):
            flat = np.isin(frame.label & 0xFFFF, (40, 44, 48, 50))
            clouds.append(frame.points[flat, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
        assert np.median(_distance_to_surface(*clouds)) < 0.03


def _distance_to_surface(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance of points of the second cloud from planes through their neighbours in the first."""
    distance, index = cKDTree(first).query(second[::5], k=12)
    near = distance[:, -1] < 1.5
    patch = first[index[near]]
    middle = patch.mean(1)
    _, values, axes = np.linalg.svd(patch - middle[:, None], full_matrices=False)
    planar = values[:, 2] < 0.25 * values[:, 1]
    assert planar.sum() > 100
    return np.abs(((second[::5][near] - middle) * axes[:, 2]).sum(1))[planar]


def test_written_again_the_files_are_the_same(written: Job, tmp_path: Path) -> None:
    again = job_of(written.layout, tmp_path)
    for place in reversed(again.places()):  # no frame depends on those before
        generating.make_frame(again, place)
    generate(again, quiet=True)
    assert hashes(tmp_path) == hashes(written.root)


def test_an_interrupted_run_goes_on(written: Job) -> None:
    before, root = hashes(written.root), Path(written.root)
    last = written.places()[-1]
    scans = sorted(path for path in root.rglob("*.bin") if "." not in path.stem or path.stem.endswith("pcd"))
    for path in (written.part(last), written.part(last).with_name("done"), scans[-1]):
        path.unlink()
    left = scans[0].parent / f".{'0a' * 16}.bin"
    left.write_bytes(b"half")
    first = scans[0].stat().st_mtime_ns
    generate(written, quiet=True)
    assert hashes(root) == before
    assert scans[0].stat().st_mtime_ns == first


def test_two_workers_write_the_same_files(tmp_path: Path) -> None:
    jobs = [
        Job("kitti_360", str(tmp_path / name), frames=2, length=2, sensor="small", picture_width=60)
        for name in ("one", "two")
    ]
    for count, job in enumerate(jobs, 1):
        generate(job, count, quiet=True)
    assert hashes(jobs[0].root) == hashes(jobs[1].root)
    assert len(hashes(jobs[0].root)) > 30


def test_a_worker_that_fails_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    job = replace(job_of("nclt", tmp_path), sensor="vlp16")  # which `generate` would have refused
    with pytest.raises(DataError, match="says why above"):
        list(generating._made(job, job.places(), 2))
    assert "KeyError: 'vlp16'" in capfd.readouterr().err


def test_two_at_once_make_every_frame_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def slowly(job: Job, place: generating.Place) -> None:
        made.append(place.number)
        threading.Event().wait(0.05)
        generating.write_text(job.part(place), json.dumps({"name": str(place.number)}))

    monkeypatch.setattr(generating, "make_frame", slowly)
    threads = [
        threading.Thread(target=generate, args=(job_of("kitti", tmp_path),), kwargs={"quiet": True}) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == list(range(FRAMES))


@pytest.mark.parametrize("change", [{"seed": 4}, {"sensor": "hdl32"}, {"frames": 2}, {"split": "val", "seed": 4}])
def test_other_settings_are_refused_in_the_same_folder(tmp_path: Path, change: dict[str, Any]) -> None:
    job_of("nuscenes", tmp_path).claim()
    key, value = list(change.items())[-1]
    settings = {**vars(job_of("nuscenes", tmp_path)), **change}
    with pytest.raises(DataError, match=f"{key}: .* there, {value} now"):
        generate(Job(**settings), quiet=True)


def test_another_split_may_join(tmp_path: Path) -> None:
    job_of("nuscenes", tmp_path).claim()
    Job(**{**vars(job_of("nuscenes", tmp_path)), "split": "val", "frames": 9, "length": 9}).claim()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sensor": "vlp16"}, "sensor: expected one of hdl64"),
        ({"frames": 0}, "frames: expected 1 or more"),
        ({"weather": "snow"}, "weather"),
        ({"layout": "kity"}, "layout: expected one of kitti"),
        ({"layout": "oxford", "split": "val"}, "split: expected one of train, test"),
        ({"layout": "semantic_kitti", "split": "val", "frames": 6, "length": 3}, "1 drives at most, found 2"),
    ],
)
def test_wrong_settings_are_named(wrong: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        generate(Job(**{**vars(job_of("kitti", tmp_path)), **wrong}))
    assert not list(tmp_path.iterdir())


def test_the_command_reports_errors_plainly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    job_of("kitti", tmp_path).claim()
    assert main(["--out", str(tmp_path), "--seed", "3"]) == 2
    assert "other settings" in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["--out", str(tmp_path / "file" / "town")]) == 2
    told = capsys.readouterr().err
    assert f"cannot write {tmp_path / 'file' / 'town'}" in told
    assert "fix: another folder" in told


# what only one layout has


@pytest.mark.parametrize("written", ["kitti"], indirect=True)
def test_scans_are_a_folder_of_ones_own(written: Job, dataset: Dataset) -> None:
    scans = make_dataset(
        {"dataset": {"folder": {"type": "folder", "root": f"{written.root}/training/velodyne"}}}, "all"
    )
    assert len(scans) == FRAMES
    assert check_dataset(scans).faults == []
    for number in range(FRAMES):
        expected, found = dataset[number].inputs["points"], scans[number].inputs["points"]
        assert torch.equal(found.xyz, expected.xyz)
        assert torch.equal(found.features, expected.features)


def test_kitti_360_scans_lie_on_depth_and_semantics_of_the_pictures(written: Job, dataset: Dataset) -> None:
    if written.layout != "kitti_360":
        pytest.skip("of KITTI-360 only")
    frame, scan = dataset[1], truth(written, 1)
    folder = Path(written.root)
    still = torch.tensor(scan.label & 0xFFFF != 1)
    for name in rig(WIDTH):
        camera = frame.meta.cameras[name]
        file = f"{_split('kitti_360')}/{name}"
        stored = _png(folder / "data_2d_depth" / file / "0000000001.png") / 256
        assert stored.shape == frame.inputs[name].features.shape[2:]
        classes = _png(folder / "data_2d_semantics/train" / file / "semantic/0000000001.png")
        uv, measured, seen = camera.project(torch.tensor(scan.points[:, :3]))
        column, row = uv[seen & still].round().long().T.numpy()
        expected = measured[seen & still].numpy()
        assert (seen & still).sum() > 300
        apart = np.abs(stored[row, column] - expected) / expected
        plain = apart < 0.05  # not at an edge, nor behind the own vehicle
        assert plain.mean() > 0.5, name
        label = scan.label[np.asarray(seen & still)] & 0xFFFF
        road = (label == 40) & plain
        assert (classes[row, column][road] == 7).mean() > 0.9


def _png(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture).astype(np.float64)


def test_kitti_360_calibration_is_that_of_the_rig(written: Job, dataset: Dataset) -> None:
    if written.layout != "kitti_360":
        pytest.skip("of KITTI-360 only")
    for name, camera in rig(WIDTH).items():
        read = dataset.meta(0).cameras[name]
        assert (read.model, read.width, read.height) == (camera.model, camera.width, camera.height)
        assert np.array(read.from_sensor) == pytest.approx(np.array(camera.from_sensor), abs=1e-9)
        assert [*read.intrinsics, *read.distortion] == pytest.approx([*camera.intrinsics, *camera.distortion])


def test_nclt_cameras_are_those_of_the_rig(written: Job, dataset: Dataset) -> None:
    if written.layout != "nclt":
        pytest.skip("of NCLT only")
    frame, points = dataset[1], torch.randn(50, 3, dtype=torch.double) * 10
    for name in ("Cam0", "Cam1", "Cam5"):
        camera, read = ladybug_cameras(WIDTH)[name], frame.inputs[name].cameras[0]
        (expected, _, seen), (found, _, _) = camera.project(points), read.project(points)
        assert bool(seen.any())
        assert (found - expected)[seen].abs().max() < 1e-3
        shot = photograph(drive_of(written, 0), truth(written, 1), camera).image
        assert torch.equal((frame.inputs[name].features[0] * 255).round().byte().permute(1, 2, 0), torch.tensor(shot))


def test_nclt_leaves_out_what_the_format_cannot_hold(tmp_path: Path) -> None:
    job = replace(job_of("nclt", tmp_path), picture_width=0)
    drive, frame, parts = drive_of(job, 0), truth(job, 0), []
    points = frame.points.copy()
    points[:5, :3] = [[-100.1, 0, 0], [0, 100.1, 0], [0, 0, 100], [119, 0, 0], [0, -119, 0]]
    for place in job.places()[:2]:  # a pose alone is no ground truth
        parts.append(job.writer().write(replace(frame, points=points, time=float(place.index)), drive, place))
    job.writer().finish([parts])
    scan = NcltDataset(root=str(tmp_path), split="train")[0].inputs["points"]
    assert np.abs(scan.xyz.numpy() - points[3:, :3]).max() < 0.0026
    assert np.abs(scan.features[:, 0].numpy() - points[3:, 3]).max() <= 0.5 / 255 + 1e-6


def test_nuscenes_tables(written: Job, dataset: Dataset) -> None:
    if written.layout != "nuscenes":
        pytest.skip("of nuScenes only")
    tables = {p.stem: json.loads(p.read_text()) for p in (Path(written.root) / "v1.0-trainval").glob("*.json")}
    by_token = {name: {row["token"]: row for row in rows} for name, rows in tables.items()}
    assert len(tables) == 13
    for name in ("sample", "sample_data", "sample_annotation"):
        for row in tables[name]:
            assert not row["next"] or by_token[name][row["next"]]["prev"] == row["token"]
    first = by_token["instance"][tables["sample_annotation"][0]["instance_token"]]
    assert first["first_annotation_token"] in by_token["sample_annotation"]
    frame, targets = truth(written, 1), dataset[1].targets
    assert set(dataset.meta(1).cameras) == set(cameras(WIDTH))
    for name, camera in cameras(WIDTH).items():
        assert np.array(dataset.meta(1).cameras[name].from_sensor) == pytest.approx(
            np.array(camera.from_sensor), abs=1e-6
        )
    moving = [thing for thing in frame.objects if thing.moving and thing.points >= 3 and thing.kind == "car"]
    checked = 0
    for box, speed, state in zip(targets.boxes.center.numpy(), targets.boxes.velocity.numpy(), targets.boxes.moving):
        near = [thing for thing in moving if np.linalg.norm(np.array(thing.box[:3]) - box) < 0.05]
        for thing in near:
            checked += 1
            assert state == 1
            assert np.isnan(speed).any() or speed == pytest.approx(thing.velocity, abs=1.5)
    assert checked or not moving


def test_nuscenes_splits_share_the_tables_in_any_order(written: Job, tmp_path: Path) -> None:
    if written.layout != "nuscenes":
        pytest.skip("of nuScenes only")
    parts = [[json.loads(written.part(place).read_text()) for place in written.places()]]
    for name, order in (("a", ("train", "val")), ("b", ("val", "train"))):
        for split in order:
            LAYOUTS["nuscenes"](tmp_path / name, 0, split).finish(parts)
    assert hashes(tmp_path / "a") == hashes(tmp_path / "b")
    scenes = [row["name"] for row in json.loads((tmp_path / "a/v1.0-trainval/scene.json").read_text())]
    assert scenes == ["scene-0001", "scene-0003"]
    shutil.copytree(Path(written.root) / "samples", tmp_path / "a/samples")
    options = {"type": "nuscenes", "root": str(tmp_path / "a")}
    datasets = [make_dataset({"dataset": {"nuscenes": options}}, split) for split in ("train", "val")]
    assert [data.named for data in datasets] == [["scene-0001"], ["scene-0003"]]


def test_tracking_files_keep_ids(written: Job) -> None:
    if written.layout != "kitti_tracking":
        pytest.skip("of KITTI tracking only")
    folder = Path(written.root) / "training"
    rows = [line.split() for line in (folder / "label_02/0000.txt").read_text().splitlines()]
    ids = [{row[1] for row in rows if row[0] == str(frame) and row[2] != "DontCare"} for frame in range(FRAMES)]
    assert np.loadtxt(folder / "oxts/0000.txt").shape == (FRAMES, 30)
    assert all(len(row) == 17 for row in rows)
    assert ids[0] & ids[1] & ids[2]
    assert (folder / "calib/0000.txt").read_text().count("\n") == 7


def test_moving_points_are_labelled_so(written: Job, dataset: Dataset) -> None:
    if written.layout != "semantic_kitti":
        pytest.skip("of SemanticKITTI only")
    targets = dataset[1].targets
    assert len(targets.points.label) == len(dataset[1].inputs["points"])
    assert {0, 1} <= set(targets.points.label.tolist())
