"""Pictures of the town agree with its scans, with lidarfw's cameras, and with the weather."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lidarfw.types import Camera

from lidarfw_town import light, render, speed
from lidarfw_town.beams import Body
from lidarfw_town.camera import fisheye_cameras, kitti_camera, kitti_projection, perspective_cameras, rays_of
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.light import WEATHER, light_of
from lidarfw_town.mesh import Mesh, Surface, ball, box, join
from lidarfw_town.render import Rendering, photograph
from lidarfw_town.sensors import LIDARS, Hits, Lidar, Scene, first_hits, receive
from lidarfw_town.traffic import Mover

STEP = 110
CAMERAS = {
    "kitti": kitti_camera(621),
    "perspective": perspective_cameras(704)["image_00"],
    **fisheye_cameras(420),
}
MOVABLE = {252: 10, 253: 31, 254: 30, 255: 32, 256: 16, 257: 13, 258: 18}


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive(1, STEP + 10, LIDARS["hdl64"], compensated=True)


@pytest.fixture(scope="module")
def frame(drive: Drive) -> TownFrame:
    return drive.frame(STEP)


@pytest.fixture(scope="module", params=list(CAMERAS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def shots(drive: Drive, frame: TownFrame) -> dict[str, Rendering]:
    return {name: photograph(drive, frame, camera) for name, camera in CAMERAS.items()}


def projected(frame: TownFrame, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and depth of the points, -1 outside the picture."""
    uv, depth, valid = camera.project(torch.from_numpy(frame.points[:, :3]).double())
    columns, rows = np.round(torch.nan_to_num(uv).numpy()).astype(int).T
    inside = (
        valid.numpy()
        & (depth.numpy() > 0)
        & seen_by(camera)[rows.clip(0, camera.height - 1), columns.clip(0, camera.width - 1)]
    )
    return np.where(inside, rows, -1), np.where(inside, columns, -1), depth.numpy()


def seen_by(camera: Camera) -> np.ndarray:
    """Pixels (H, W) with a ray."""
    return np.asarray(rays_of(camera)[1].any(1).reshape(camera.height, camera.width))


@pytest.mark.parametrize("camera", [*CAMERAS.values()], ids=[*CAMERAS])
def test_a_beacon_is_where_the_camera_projects_its_points(camera: Camera) -> None:
    place, rays, _ = rays_of(camera)
    middle = rays.reshape(camera.height, camera.width, 3)[camera.height // 3, int(camera.width * 0.6)]
    beacon = ball((0, 0, 0), (0.25, 0.25, 0.25), Surface(81, 0.5, (1.0, 0.9, 0.1)))
    scene = Scene(Body(7, beacon, tuple((place + 12 * middle).tolist()), 0.0).placed)
    shot = render.render([scene], camera, np.eye(4), light_of(1, 0), np.random.default_rng(0))
    beams = np.random.default_rng(1).normal(middle, 0.02, (20000, 3)).astype(np.float32)
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    hits = first_hits([scene], np.tile(place.astype(np.float32), (len(beams), 1)), beams)
    points = (place + beams * hits.distance[:, None])[hits.semantic == 81]
    uv, depth, valid = camera.project(torch.from_numpy(points).double())
    rows, columns = np.nonzero(shot.instance == 7)
    assert valid.all()
    assert len(rows) > 10
    edges = np.stack([uv.min(0).values, uv.max(0).values]).ravel()
    assert np.array([columns.min(), rows.min(), columns.max(), rows.max()]) == pytest.approx(edges, abs=1)
    assert float(depth.min()) == pytest.approx(shot.depth[rows, columns].min(), abs=0.02)
    assert (shot.semantic[rows, columns] == 81).all()


def test_the_depth_is_that_of_the_scan(frame: TownFrame, shots: dict[str, Rendering], name: str) -> None:
    rows, columns, depth = projected(frame, CAMERAS[name])
    flat = np.isin(frame.label & 0xFFFF, (40, 48, 50, 10)) & (rows >= 0)
    difference = np.abs(shots[name].depth[rows[flat], columns[flat]] - depth[flat])
    assert flat.sum() > 1000
    # a point and its pixel's centre are half a pixel apart, and the sensors stand at different places
    assert (difference < 0.05 + 0.03 * depth[flat]).mean() > 0.93


def test_classes_are_those_of_the_scan(frame: TownFrame, shots: dict[str, Rendering], name: str) -> None:
    rows, columns, _ = projected(frame, CAMERAS[name])
    label = frame.label & 0xFFFF
    for moving, standing in MOVABLE.items():
        label = np.where(label == moving, standing, label)
    chosen = (rows >= 0) & (label != 1) & ~np.isin(label, (70, 71))  # beams pass between leaves
    found = shots[name].semantic[rows[chosen], columns[chosen]]
    assert chosen.sum() > 2000
    assert (found == label[chosen]).mean() > 0.93


def test_instances_are_those_of_the_scan(frame: TownFrame, shots: dict[str, Rendering]) -> None:
    agree = []
    for name, camera in CAMERAS.items():
        rows, columns, _ = projected(frame, camera)
        chosen = (rows >= 0) & (frame.label >> 16 > 0)
        agree += [shots[name].instance[rows[chosen], columns[chosen]] == frame.label[chosen] >> 16]
    assert sum(map(len, agree)) > 100
    assert np.concatenate(agree).mean() > 0.8


def test_lenses() -> None:
    left, right = fisheye_cameras(700).values()
    points = torch.tensor([[0.0, 30, 0], [0, -30, 0], [30, 0, 0]])
    (seen_left, _, in_left), (seen_right, _, in_right) = left.project(points), right.project(points)
    assert in_left.tolist() == [True, False, True]
    assert in_right.tolist() == [False, True, True]
    assert seen_left[0].tolist() == pytest.approx([358, 353], abs=8)  # straight to the left: near the middle
    assert seen_left[2, 0] > 600  # ahead is at the right of the left picture
    assert seen_right[2, 0] < 100  # and at the left of the right one
    black = ~seen_by(left)
    assert black[0, 0]
    assert not black[350, 350]
    matrix = np.linalg.inv(np.array(kitti_camera().from_sensor))
    assert matrix[:3, 3].tolist() == pytest.approx([0.27, 0.06, -0.08])
    assert kitti_projection(kitti_camera())[0, 3] == pytest.approx(721.5377 * 0.06)


def test_pinholes_do_not_see_the_own_vehicle_and_fisheyes_do(shots: dict[str, Rendering]) -> None:
    own = {name: ((shot.semantic == 0) & (shot.depth > 0)).mean() for name, shot in shots.items()}
    assert own["kitti"] == 0
    assert own["perspective"] == 0
    assert 0.02 < own["image_02"] < 0.15
    assert own["image_03"] == pytest.approx(own["image_02"], abs=0.03)


def test_the_same_picture_twice_and_another_in_the_next_frame(drive: Drive, frame: TownFrame) -> None:
    camera = fisheye_cameras(160)["image_02"]
    first, second = photograph(drive, frame, camera), photograph(drive, drive.frame(STEP), camera)
    assert (first.image == second.image).all()
    assert (first.depth == second.depth).all()
    assert (first.image != photograph(drive, drive.frame(STEP + 5), camera).image).any()


@pytest.fixture(scope="module")
def by_weather(drive: Drive, frame: TownFrame) -> dict[str, Rendering]:
    camera, pictures = kitti_camera(310), {}
    for weather in WEATHER:
        drive.weather = weather
        pictures[weather] = photograph(drive, frame, camera)
    drive.weather = "clear"
    return pictures


def test_night_is_dark_and_fog_is_pale(by_weather: dict[str, Rendering]) -> None:
    brightness = {weather: shot.image.mean() for weather, shot in by_weather.items()}
    assert brightness["night"] < 0.6 * brightness["clear"]
    assert np.median(by_weather["night"].image) < 60
    assert by_weather["night"].image.max() > 150  # lamps
    far = {weather: shot.image[shot.depth > 60].std() for weather, shot in by_weather.items()}
    assert far["fog"] < 0.6 * far["rain"] < 0.5 * far["clear"]


def test_traversals_have_another_light() -> None:
    lights = [light_of(3, traversal) for traversal in range(20)]
    assert len({one.sun for one in lights}) == 20
    assert np.ptp([one.exposure for one in lights]) > 0.2
    assert np.ptp([one.direct for one in lights]) > 0.3
    assert light_of(3, 4) == lights[4]


def test_lamps_light_what_is_below_them_and_cast_shadows() -> None:
    ground = box((0, 0, -0.1), (40, 40, 0.2), Surface(40, 0.3, (0.5, 0.5, 0.5)))
    table = box((2.0, 0, 3.0), (1.0, 1.0, 0.1), Surface(99, 0.3, (0.5, 0.5, 0.5)))
    lamp = box((0, 0, 6), (0.6, 0.3, 0.1), Surface(80, 0.3, (1, 1, 1), glow=5.0))
    scene = Scene(join([ground, table, lamp]))
    above = np.eye(4)
    above[:3, 3] = 0, 0, 1.7
    lamps = light.lamps_of(scene, [], above, 1.7)
    street = light.Lamps(*(getattr(lamps, field)[:1] for field in ("place", "axis", "power", "narrow", "near")))
    assert lamps.place[0] == pytest.approx([0, 0, 5.9])
    assert len(lamps.place) == 3  # and the own headlights
    down = Camera("pinhole", 81, 81, (40.0, 40.0, 40.0, 40.0)).transformed(looking_down(height=9.0))
    night = light_of(1, 0, "night")
    shot = render.render([scene], down, np.eye(4), night, np.random.default_rng(0), street)
    level = shot.image.astype(float).mean(2)
    lit, shadow, opposite, away = level[40, 46], level[40, 60], level[40, 20], level[2, 2]
    assert shot.semantic[40, 46] == shot.semantic[40, 60] == 40
    assert lit > 1.5 * away > 0
    assert shadow < 0.6 * opposite


def looking_down(height: float) -> np.ndarray:
    """A camera above the origin: its right is x, its top y."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.diag([1.0, -1.0, -1.0]), (0, 0, height)
    return pose


def test_both_halves_of_a_window_are_lit_together(drive: Drive) -> None:
    panes = drive.world.mesh.panes
    _, counts = np.unique(panes[panes >= 0], return_counts=True)
    assert len(counts) > 500
    assert (counts == 2).all()


@pytest.mark.parametrize("step", [5, 40, 90])
def test_bodies_met_by_their_beams_alone_are_those_of_all_beams(drive: Drive, step: int) -> None:
    pose = drive.poses(np.array([float(step)]))[0]
    origins, directions = drive._rays(step)
    bodies = drive._bodies(step, pose)
    hits, beams = drive._hits(bodies, origins, directions)
    moving = Scene(join([body.placed for thing, body, _, _ in bodies if isinstance(thing, Mover)]))
    wanted = first_hits([drive.still, moving], origins, directions)
    assert len(beams) > 3
    assert (hits.instance == wanted.instance).all()
    assert (hits.semantic == wanted.semantic).all()
    assert np.minimum(hits.distance, 500) == pytest.approx(np.minimum(wanted.distance, 500), abs=2e-3)
    assert hits.normal == pytest.approx(wanted.normal, abs=2e-2)
    for _, body, _, _ in bodies:
        if body.id in beams:
            assert beams[body.id] == (Scene(body.placed).cast(origins, directions)[1] >= 0).sum()


def wall(lidar: Lidar, distance: float) -> tuple[Hits, np.ndarray]:
    """A matt sphere around the sensor, and its beams."""
    directions = lidar.rays()[0].reshape(-1, 3)
    count = len(directions)
    full = np.full(count, 50, np.uint16), np.zeros(count, np.int32), np.full(count, 0.4, np.float32)
    return Hits(np.full(count, distance, np.float32), *full, -directions), directions


@pytest.mark.parametrize("distance", [10.0, 60.0])
def test_rain_and_fog_lose_far_points_and_add_drops_close_by(distance: float) -> None:
    lidar = LIDARS["hdl64"]
    hits, directions = wall(lidar, distance)
    scans = {
        name: receive(lidar, hits, directions, np.random.default_rng(0), weather) for name, weather in WEATHER.items()
    }
    assert (scans["night"].range == scans["clear"].range).all()
    kept = {name: (np.abs(scan.range - distance) < 0.2).mean() for name, scan in scans.items()}
    drops = {
        name: ((scan.range > 0) & (scan.range < distance - 0.5) & (scan.semantic == 1)).mean()
        for name, scan in scans.items()
    }
    assert kept["clear"] > kept["rain"] > kept["fog"]
    assert drops["clear"] == 0
    assert 0 < drops["rain"] < 0.03
    assert 0.03 < drops["fog"] < 0.2
    assert (kept["fog"] > 0.8) == (distance < 20)


def test_mixed_points_lie_between_two_surfaces() -> None:
    lidar = LIDARS["hdl64"]
    hits, directions = wall(lidar, 10.0)
    behind = (np.arange(len(directions)) // 16) % 2 == 1
    hits.distance[behind] = 13.0
    hits.instance[~behind] = 5
    scan = receive(lidar, hits, directions, np.random.default_rng(0), WEATHER["clear"])
    mixed = scan.semantic == 1
    assert 0.003 < mixed.mean() < 0.02
    assert (scan.instance[mixed] == 0).all()
    between = scan.range[mixed]
    assert ((between > 10.2) & (between < 13.0)).mean() > 0.95


def test_the_own_roof_hides_the_ground_close_by() -> None:
    lidar = LIDARS["hdl64"]
    hits, directions = wall(lidar, 30.0)
    scan = receive(lidar, hits, directions, np.random.default_rng(0), WEATHER["clear"])
    hidden = (scan.range == 0).reshape(len(lidar.elevations), -1)
    assert not hidden[:32].mean() > 0.2
    assert hidden[-1, 1024] or hidden[-1, 0]  # ahead or behind, steeply down


def test_an_empty_scene_is_all_sky() -> None:
    nothing = Scene(join([]))
    shot = render.render([nothing], kitti_camera(124), np.eye(4), light_of(1, 0), np.random.default_rng(0))
    assert not shot.semantic.any()
    assert not shot.depth.any()
    assert shot.image.mean() > 100


def test_meshes_keep_their_glow() -> None:
    lamp = box((0, 0, 0), (1, 1, 1), Surface(80, 0.3, (1, 1, 1), glow=2.0))
    both: Mesh = join([lamp, box((3, 0, 0), (1, 1, 1), Surface(80, 0.3, (1, 1, 1)))]).placed(1, 2, 3, 0.5)
    assert both.glow.tolist() == [2.0] * 12 + [0.0] * 12
    assert not both.without_glow().glow.any()


def test_the_parts_of_a_frame_are_timed(drive: Drive, capsys: pytest.CaptureFixture[str]) -> None:
    speed._frames(drive, 2)
    whole, *parts = (row.split("|")[2] for row in capsys.readouterr().out.splitlines())
    assert 0 < float(whole) < 30
    assert 50 < sum(int(part.strip().rstrip("%")) for part in parts) <= 103
