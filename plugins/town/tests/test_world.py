"""What the world promises: people cross and vehicles let them, shapes vary, remissions are like real ones."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from lidarfw_town.bodies import make
from lidarfw_town.sensors import LIDARS, Hits, Weather, receive
from lidarfw_town.streets import LANE
from lidarfw_town.traffic import PERIOD, Traffic, Walkers
from lidarfw_town.world import World

STEPS = 250


@pytest.fixture(scope="module")
def world() -> World:
    return World(3)


@pytest.fixture(scope="module")
def traffic(world: World) -> Traffic:
    return Traffic(world, 0, STEPS)


def on_road(world: World, track: np.ndarray) -> np.ndarray:
    return np.asarray(shapely.contains_xy(world.road, track[:, 0], track[:, 1]))


def people(traffic: Traffic) -> list[np.ndarray]:
    return [mover.track for mover in traffic.movers if mover.kind == "pedestrian"]


def test_streets_are_built_up_in_several_ways(world: World) -> None:
    settings = {street.setting for street in world.network.streets}
    assert settings == {"terrace", "suburb", "open"}
    assert all(street.setting == "open" for street in world.network.streets if street.highway)


def test_people_cross_streets_in_a_straight_line(world: World, traffic: Traffic) -> None:
    crossings = 0
    for track in people(traffic):
        on = on_road(world, track)
        for begin, end in zip(
            np.flatnonzero(np.diff(on.astype(int)) == 1), np.flatnonzero(np.diff(on.astype(int)) == -1)
        ):
            if end > begin:
                crossings += 1
                way = np.linalg.norm(np.diff(track[begin : end + 1, :2], axis=0), axis=1).sum()
                assert way == pytest.approx(np.linalg.norm(track[end, :2] - track[begin, :2]), rel=0.01)
                assert 1.5 * LANE < way < 4 * LANE
    assert crossings >= 3


def test_nobody_is_run_over_and_some_vehicle_stops(traffic: Traffic) -> None:
    vehicles = [traffic.ego, *(mover.track for mover in traffic.movers if mover.kind != "pedestrian")]
    moving = np.stack(vehicles)
    for walker in people(traffic):
        apart = np.linalg.norm(moving[..., :2] - walker[:, :2], axis=-1)
        assert apart[moving[..., 3] > 0.5].min() > 1.2
    assert ((moving[:, 1:, 3] < 0.3) & (moving[:, :-1, 3] >= 0.3)).any()


def test_tracks_are_smooth(traffic: Traffic) -> None:
    for mover in traffic.movers:
        step = np.linalg.norm(np.diff(mover.track[:, :2], axis=0), axis=1)
        assert np.abs(step - mover.track[1:, 3] * PERIOD).max() < 0.15, mover.kind
        assert np.abs(np.diff(mover.track[:, 2])).max() < 0.8, mover.kind


def test_the_same_seed_gives_the_same_traffic(world: World, traffic: Traffic) -> None:
    again = Traffic(World(3), 0, STEPS)
    assert (again.ego == traffic.ego).all()
    for one, other in zip(traffic.movers, again.movers, strict=True):
        assert (one.track == other.track).all()
    assert (again._world.mesh.triangles == world.mesh.triangles).all()


def test_the_vehicle_with_the_sensor_gets_round_its_circuit() -> None:
    # a bus and another car stood in this one's way for ever, when the traffic was drawn for the first time
    ego = Traffic(World(1), 0, 300, circuit=True).ego
    assert np.linalg.norm(np.diff(ego[:, :2], axis=0), axis=1).sum() > 100


def test_a_walker_waits_while_told_to_and_then_crosses() -> None:
    corners = np.array([[0.0, -5], [30, -5], [30, 5], [0, 5], [0, -5]])
    at = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    path = np.stack([np.interp(np.arange(0, at[-1], Walkers.STEP), at, corners[:, axis]) for axis in (0, 1)], 1)
    gates = np.array([[[31.0, 39.0], [71.0, 79.0]]])
    walkers = Walkers([path], gates, np.array([1.0]), np.array([30.95 / at[-1]]))
    ((number, way, crossing),) = walkers.crossing()
    assert (number, crossing) == (0, False)
    assert way[-1] == pytest.approx([30, 4], abs=0.5)
    for _ in range(20):
        walkers.advance({0}, record=True)
    for _ in range(50):
        walkers.advance(set(), record=True)
    (track,) = walkers.tracks()
    assert np.ptp(track[:20, :2], axis=0).max() == 0
    assert track[-1, :2] == pytest.approx([30, 0.95], abs=0.1)
    assert walkers.crossing()[0][2]


def test_cars_have_sizes_like_kittis() -> None:
    sizes = []
    for number in range(150):
        triangles = make("car", (9, number)).triangles
        sizes.append(triangles.max((0, 1)) - triangles.min((0, 1)))
    mean, spread = np.mean(sizes, 0), np.std(sizes, 0)
    assert mean == pytest.approx([3.9, 1.63, 1.53], abs=0.08)
    assert 0.25 < spread[0] < 0.55


def test_parked_vehicles_stand_on_the_ground(world: World, traffic: Traffic) -> None:
    lifts = {round(world.lift(thing.pose, 1.5), 3) for thing in traffic.parked}
    assert lifts == {0.0, 0.12}  # in bays, and on driveways behind the kerb


def hits(reflectance: float, distance: float, cosine: float, semantic: int) -> tuple[Hits, np.ndarray]:
    lidar = LIDARS["small"]
    directions = lidar.rays()[0].reshape(-1, 3)
    count = len(directions)
    across = np.cross(directions, [0, 0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normal = cosine * directions + np.sqrt(1 - cosine**2) * across
    whole = np.ones(count, np.float32)
    fields = {"distance": whole * distance, "semantic": np.full(count, semantic, np.uint16)}
    fields |= {"instance": np.zeros(count, np.int32), "reflectance": whole * reflectance, "normal": normal.astype("f4")}
    return Hits(**fields), directions


@pytest.mark.parametrize(
    ("reflectance", "distance", "cosine", "semantic", "low", "high"),
    [
        (0.30, 7.0, 0.25, 40, 0.24, 0.32),  # road near by
        (0.45, 12.0, 0.9, 50, 0.39, 0.5),  # a wall
        (0.45, 52.0, 0.9, 50, 0.13, 0.23),  # the same far away
        (0.06, 15.0, 0.8, 10, 0.0, 0.0),  # dark paint
        (0.30, 50.0, 0.034, 40, 0.0, 0.0),  # road far away
        (0.36, 15.0, 0.1, 72, 0.3, 0.42),  # grass does not mind the incidence
    ],
)
def test_remission_is_like_kittis(
    reflectance: float, distance: float, cosine: float, semantic: int, low: float, high: float
) -> None:
    found, directions = hits(reflectance, distance, cosine, semantic)
    scan = receive(LIDARS["small"], found, directions, np.random.default_rng(0), Weather())
    assert low <= float(np.median(scan.remission[scan.range > 0])) <= high
