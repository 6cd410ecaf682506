"""What the town promises: the same seed gives the same files, and the truth fits what the sensors measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from lidarfw import kitti
from lidarfw.types import Camera
from PIL import Image
from scipy.spatial import cKDTree

from lidarfw_town import statistics
from lidarfw_town.__main__ import main
from lidarfw_town.bodies import KINDS, make
from lidarfw_town.camera import kitti_camera
from lidarfw_town.drive import Drive, Object, TownFrame
from lidarfw_town.generate import Job, generate
from lidarfw_town.layouts import labels_of
from lidarfw_town.render import photograph
from lidarfw_town.sensors import LIDARS
from lidarfw_town.world import World

STEPS = 40
GROUND = {40, 44, 48, 60, 72}
PEOPLE_AND_VEHICLES = {10, 13, 18, 30, 31, 32, 252, 253, 254, 255, 257, 258}


@pytest.fixture(scope="module")
def world() -> World:
    return World(7)


@pytest.fixture(scope="module")
def drive(world: World) -> Drive:
    return Drive(7, STEPS, LIDARS["hdl64"], world=world)


@pytest.fixture(scope="module")
def frame(drive: Drive) -> TownFrame:
    return drive.frame(20)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Job:
    job = Job("kitti", str(tmp_path_factory.mktemp("kitti")), seed=7, frames=2, sensor="small", picture_width=310)
    generate(job, quiet=True)
    return job


def beyond(drive: Drive, frame: TownFrame, thing: Object, world: np.ndarray) -> np.ndarray:
    """Metres (N,) by which points leave the box of an object at the moment of the box; below 0 inside."""
    return np.asarray((np.abs(drive.in_box(thing, frame, world)) - np.array(thing.box[3:6]) / 2).max(1))


@pytest.mark.parametrize("compensated", [True, False])
def test_without_noise_boxes_hold_exactly_the_points_of_their_objects(world: World, compensated: bool) -> None:
    quiet = replace(LIDARS["hdl64"], noise=0.0, mixed=0.0)
    drive, own_points, strange = Drive(7, STEPS, quiet, compensated=compensated, world=world), 0, 0
    for step in (15, 30):
        frame = drive.frame(step)
        places, instance, semantic = drive.in_world(frame), frame.label >> 16, frame.label & 0xFFFF
        assert len(frame.objects) > 10
        for thing in frame.objects:
            own, out = instance == thing.id, beyond(drive, frame, thing, places)
            assert own.sum() == thing.points
            assert (out[own] < 1e-3).all(), thing
            kind = KINDS[thing.kind]
            assert set(semantic[own].tolist()) <= {kind.moving if thing.moving else kind.semantic}
            assert set(semantic[(out < -1e-3) & ~own].tolist()) <= GROUND, thing
            own_points, strange = own_points + own.sum(), strange + ((out < -1e-3) & ~own).sum()
        assert set(np.unique(instance).tolist()) - {0} <= {thing.id for thing in frame.objects}
    assert own_points > 2000
    assert strange > 0  # the ground under vehicles was looked at


@pytest.mark.parametrize("compensated", [True, False])
def test_with_noise_points_leave_the_box_by_three_deviations_at_most(world: World, compensated: bool) -> None:
    drive = Drive(7, STEPS, LIDARS["hdl64"], compensated=compensated, world=world)
    frame = drive.frame(30)
    places, instance = drive.in_world(frame), frame.label >> 16
    out = np.concatenate([beyond(drive, frame, t, places)[instance == t.id] for t in frame.objects])
    assert len(out) > 500
    assert 0.02 < out.max() < 3 * drive.lidar.noise + 1e-3


def test_mixed_points_belong_to_no_object(frame: TownFrame) -> None:
    mixed = (frame.label & 0xFFFF) == 1
    assert mixed.sum() > 50
    assert not (frame.label[mixed] >> 16).any()


def test_every_movable_point_belongs_to_an_object(frame: TownFrame) -> None:
    movable = np.isin(frame.label & 0xFFFF, list(PEOPLE_AND_VEHICLES))
    assert movable.any()
    assert ((frame.label >> 16 > 0) == movable).all()


def test_poses_align_consecutive_scans(tmp_path: Path) -> None:
    job = Job("semantic_kitti", str(tmp_path), seed=1, frames=2, sensor="hdl64", picture_width=0)
    generate(job, quiet=True)
    folder = tmp_path / "dataset" / "sequences" / "00"
    lines = (folder / "calib.txt").read_text().splitlines()
    extrinsic = np.eye(4)
    extrinsic[:3] = np.array(lines[4].split()[1:], float).reshape(3, 4)
    clouds = []
    for number, row in enumerate(np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)):
        pose = np.linalg.inv(extrinsic) @ np.concatenate([row, [[0, 0, 0, 1]]]) @ extrinsic
        points = np.fromfile(folder / "velodyne" / f"{number:06d}.bin", "<f4").reshape(-1, 4)[:, :3].astype(float)
        label = np.fromfile(folder / "labels" / f"{number:06d}.label", "<u4") & 0xFFFF
        assert len(label) == len(points)
        flat = np.isin(label, (40, 44, 48, 50))
        clouds.append(points[flat] @ pose[:3, :3].T + pose[:3, 3])
    assert np.median(_distance_to_surface(*clouds)) < 0.03


def _distance_to_surface(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance of points of the second cloud from planes through their neighbours in the first."""
    tree = cKDTree(first)
    distance, index = tree.query(second[::20], k=12)
    near = distance[:, -1] < 0.7
    patch = first[index[near]]
    middle = patch.mean(1)
    _, values, axes = np.linalg.svd(patch - middle[:, None], full_matrices=False)
    planar = values[:, 2] < 0.25 * values[:, 1]
    assert planar.sum() > 300
    offset = second[::20][near] - middle
    return np.abs((offset * axes[:, 2]).sum(1))[planar]


def test_labels_are_where_the_picture_shows_the_objects(drive: Drive, frame: TownFrame) -> None:
    camera = kitti_camera(621)
    checked = []
    for one in (frame, drive.frame(25), drive.frame(30), drive.frame(35)):
        shown = _pictured(drive, one, camera)
        for thing in one.objects:
            for label in labels_of([thing], camera):
                if thing.id in shown and label.type != "DontCare" and label.truncation < 0.02:
                    checked.append(_covered(shown[thing.id], label, whole=thing.visible > 0.95))
    assert len(checked) >= 8


def _covered(shown: tuple[float, ...], label: kitti.Label, *, whole: bool) -> float:
    """The share of a label's rectangle that the object's pixels span; they must not leave it."""
    left, top, right, bottom = shown
    a, b, c, d = label.box2d
    assert left >= a - 2
    assert right <= c + 2
    assert top >= b - 2
    assert bottom <= d + 2
    share = (right - left + 1) * (bottom - top + 1) / ((c - a) * (d - b))
    assert share > 0.45 or not whole
    return share


def _pictured(drive: Drive, frame: TownFrame, camera: Camera) -> dict[int, tuple[float, ...]]:
    """Instance -> left, top, right, bottom of its pixels."""
    instance = photograph(drive, frame, camera).instance
    found = {}
    for number in np.unique(instance[instance > 0]):
        rows, columns = np.nonzero(instance == number)
        found[int(number)] = (columns.min(), rows.min(), columns.max(), rows.max())
    return found


def test_frames_do_not_depend_on_the_order_of_calls(drive: Drive, frame: TownFrame) -> None:
    drive.frame(21)
    again = drive.frame(20)
    assert (again.points == frame.points).all()
    assert (again.label == frame.label).all()


def test_the_scan_is_like_a_real_one(frame: TownFrame) -> None:
    distance = np.linalg.norm(frame.points[:, :3], axis=1)
    semantic, counts = np.unique(frame.label & 0xFFFF, return_counts=True)
    share = dict(zip(semantic.tolist(), counts / len(frame.label)))
    assert 95_000 < len(frame.points) < 131_072
    assert 5 < np.median(distance) < 15
    assert 0.25 < share[40] < 0.5
    assert {10, 40, 48, 50, 70, 71, 72, 80} <= set(share)


def test_the_town_has_loops_and_a_highway_and_half_full_slots(drive: Drive) -> None:
    network = drive.world.network
    assert len(network.streets) > len(network.nodes)
    assert any(street.highway for street in network.streets)
    assert 0.4 <= len(drive.traffic.parked) / len(drive.world.slots.yaw) <= 0.6


def test_vehicles_do_not_drive_through_each_other(drive: Drive) -> None:
    vehicles = [mover for mover in drive.traffic.movers if mover.kind != "pedestrian"]
    places = np.stack([drive.traffic.ego, *(mover.track for mover in vehicles)])[..., :2]
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    apart[np.arange(len(places)), np.arange(len(places))] = np.inf
    assert len(vehicles) > 10
    assert apart.min() > 1.2  # a car beside a bicycle


def test_another_traversal_parks_others_and_keeps_some(drive: Drive) -> None:
    other = Drive(7, 2, LIDARS["small"], traversal=1)
    assert (other.world.mesh.triangles == drive.world.mesh.triangles).all()
    here, there = ({(p.id, *p.pose.tolist()) for p in d.traffic.parked} for d in (drive, other))
    assert 0.1 < len(here & there) / len(here) < 0.6


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_bodies_fill_their_size_and_walk(kind: str) -> None:
    body = make(kind, (1, 2))
    low, high = body.triangles.min((0, 1)), body.triangles.max((0, 1))
    assert len(body) > 60
    assert low[2] == pytest.approx(0, abs=1e-4)
    assert (low + high)[:2] == pytest.approx(0, abs=1e-3)
    assert (make(kind, (1, 2)).triangles == body.triangles).all()
    if kind == "pedestrian":
        assert not np.allclose(make(kind, (1, 2), 1.5).triangles, body.triangles, atol=0.05)


def test_statistics_of_two_folders_make_a_figure(
    written: Job, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    job = Job("semantic_kitti", str(tmp_path / "scans"), seed=7, frames=2, sensor="small", picture_width=0)
    generate(job, quiet=True)
    folders = [f"--{which}-{kind}" for which in ("town", "real") for kind in ("objects", "sequences")]
    values = [written.root, job.root] * 2
    arguments = [word for pair in zip(folders, values) for word in pair]
    assert statistics.main([*arguments, "--out", str(tmp_path / "figure.png")]) == 0
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 19
    assert all(ours == theirs.removesuffix(" |") for _, ours, theirs in rows)
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_the_picture_shows_the_town(tmp_path: Path) -> None:
    assert main(["--picture", "--out", str(tmp_path / "town.png"), "--sensor", "small"]) == 0
    with Image.open(tmp_path / "town.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] == 1600
    assert pixels.std() > 30
