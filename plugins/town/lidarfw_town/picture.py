"""One picture of a town: the map with the route, and what every sensor sees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from lidarfw.files import atomic_path

from lidarfw_town.bodies import KINDS
from lidarfw_town.camera import fisheye_cameras, kitti_camera
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.mesh import Array
from lidarfw_town.render import photograph
from lidarfw_town.sensors import Lidar, first_hits

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLOURS = {
    "nothing": (0.55, 0.55, 0.55), "road": (0.47, 0.45, 0.50), "pavement": (0.68, 0.63, 0.58),
    "building": (0.86, 0.62, 0.30),
    "vegetation": (0.25, 0.55, 0.25), "terrain": (0.66, 0.78, 0.48), "pole or sign": (0.35, 0.30, 0.55),
    "vehicle": (0.10, 0.35, 0.75), "person": (0.85, 0.15, 0.25),
}  # fmt: skip
_GROUPS = {
    "road": (40, 44, 60), "pavement": (48,), "building": (50, 51, 52), "vegetation": (70, 71), "terrain": (72,),
    "pole or sign": (80, 81, 99), "vehicle": (10, 13, 18, 252, 257, 258), "person": (30, 31, 32, 253, 254, 255),
}  # fmt: skip
_STEPS = 300  # of the drive
_REACH = 42.0  # metres around the vehicle in the view from above
_PIXEL = 0.5  # metres, of the map
_FARTHEST = 80.0  # metres, of the colours of ranges


def write_picture(path: str | Path, seed: int, lidar: Lidar, traversal: int = 0, weather: str = "clear") -> None:
    """Draw the town of a seed, and what every sensor sees at the busiest moment of a drive through it, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drive = Drive(seed, _STEPS, lidar, traversal=traversal, weather=weather)
    frame = drive.frame(_busiest(drive))
    figure = Figure((16, 21.5), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(5, 4, height_ratios=(7.6, 4.8, 2.5, 4.1, 2.0))
    _draw_map(figure.add_subplot(grid[0, :2]), drive, frame)
    _draw_scan(figure.add_subplot(grid[0, 2:]), frame)
    shot = photograph(drive, frame, kitti_camera())
    _show(figure.add_subplot(grid[1, :]), shot.image, f"camera ahead, {weather}")
    _show(figure.add_subplot(grid[2, :2]), _shaded(shot.depth), "its depth")
    _show(figure.add_subplot(grid[2, 2:]), colours_of(shot.semantic), "its classes")
    left, right = (photograph(drive, frame, camera) for camera in fisheye_cameras(600).values())
    _show(figure.add_subplot(grid[3, 0]), left.image, "fisheye to the left")
    _show(figure.add_subplot(grid[3, 1]), right.image, "fisheye to the right")
    _show(figure.add_subplot(grid[3, 2]), _shaded(left.depth), "depth to the left")
    _show(figure.add_subplot(grid[3, 3]), colours_of(right.semantic), "classes to the right")
    _show(figure.add_subplot(grid[4, :]), _shaded(frame.grid), "range image: left and right edge look backward", "auto")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _busiest(drive: Drive) -> int:
    """The step with the most objects near by."""
    steps = np.arange(10, _STEPS - 10, 5)
    parked = np.array([thing.pose[:2] for thing in drive.traffic.parked])
    counts = []
    for step, (x, y) in zip(steps, drive.traffic.ego[steps, :2]):
        there = np.concatenate([parked, [mover.at(float(step))[:2] for mover in drive.traffic.movers]])
        counts.append((np.hypot(*(there - (x, y)).T) < 30).sum())
    return int(steps[np.argmax(counts)])


def colours_of(semantic: npt.NDArray[np.integer]) -> Array:
    """A colour (N, 3) for every class id (N,)."""
    table = np.tile(np.array(_COLOURS["nothing"]), (260, 1))
    for name, ids in _GROUPS.items():
        table[list(ids)] = _COLOURS[name]
    return np.asarray(table[np.minimum(semantic, 259)])


def _draw_map(axes: Axes, drive: Drive, frame: TownFrame) -> None:
    """The surfaces of the town from above, the route, and where everybody is."""
    west, south, east, north = drive.world.land.bounds
    axes.imshow(_from_above(drive), extent=(west, east, south, north))
    axes.plot(*drive.traffic.ego[:, :2].T, color="#C2185B", linewidth=2, label="route of half a minute")
    axes.plot(*drive.traffic.ego[frame.number, :2], "o", color="#C2185B", markersize=7)
    movers = np.array([(*mover.at(frame.number)[:2], mover.kind == "pedestrian") for mover in drive.traffic.movers])
    for chosen, colour, name in ((movers[:, 2] == 0, "#0B3D91", "vehicles"), (movers[:, 2] == 1, "#D32F2F", "people")):
        axes.plot(
            *movers[chosen, :2].T,
            "o",
            color=colour,
            markersize=3.5,
            markeredgecolor="white",
            markeredgewidth=0.4,
            label=name,
        )
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.legend(loc="lower right", framealpha=0.9)
    axes.set_title(f"town of seed {drive.seed}", loc="left")


def _from_above(drive: Drive) -> Array:
    """Colours (H, W, 3) of the classes, north up, as light falls on them from the north-west."""
    west, south, east, north = drive.world.land.bounds
    x, y = np.meshgrid(np.arange(west, east, _PIXEL), np.arange(north, south, -_PIXEL))
    origins = np.stack([x, y, np.full_like(x, 150.0)], -1).reshape(-1, 3).astype(np.float32)
    down = np.tile(np.array([0, 0, -1], np.float32), (len(origins), 1))
    hits = first_hits([drive.still], origins, down)
    upward = hits.normal * np.sign(hits.normal[:, 2:])
    light = 0.55 + 0.45 * np.clip(upward @ np.array([-0.45, 0.45, 0.77]), 0, 1) / 0.77
    return np.asarray((colours_of(hits.semantic) * light[:, None]).clip(0, 1).reshape(*x.shape, 3))


def _draw_scan(axes: Axes, frame: TownFrame) -> None:
    """The scan from above by class, with the boxes of the truth."""
    from matplotlib.patches import Patch

    points = frame.points
    axes.scatter(points[:, 0], points[:, 1], c=colours_of(frame.label & 0xFFFF), s=0.6, linewidths=0, rasterized=True)
    for thing in frame.objects:
        if max(abs(thing.box[0]), abs(thing.box[1])) < _REACH - 1:
            colour = "#B71C1C" if thing.moving else "#111111"
            axes.plot(*_outline(thing.box).T, color=colour, linewidth=1.2)
            if KINDS[thing.kind].name != "Pedestrian":
                axes.annotate(
                    str(thing.id), (thing.box[0], thing.box[1]), fontsize=6, color=colour, ha="center", va="center"
                )
    names = [name for name in _COLOURS if name != "nothing"]
    handles = [Patch(color=_COLOURS[name], label=name) for name in names]
    axes.legend(handles=handles, loc="lower right", fontsize=8, framealpha=0.9)
    axes.set(xlim=(-_REACH, _REACH), ylim=(-_REACH, _REACH), aspect="equal", xlabel="x ahead (m)", ylabel="y left (m)")
    axes.set_title(f"scan: {len(points):,} points, boxes of moving objects red", loc="left")


def _outline(box: tuple[float, ...]) -> Array:
    """The rectangle of a box from above, closed, with a line from its middle to its front."""
    x, y, _, length, width, _, yaw = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1], [1, 0], [0, 0]]) * (length / 2, width / 2)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.asarray(corners @ turn + (x, y))


def _show(axes: Axes, picture: npt.NDArray[Any], title: str, aspect: Literal["equal", "auto"] = "equal") -> None:
    axes.imshow(picture, aspect=aspect, interpolation="antialiased")
    axes.set_axis_off()
    axes.set_title(title, loc="left")


def _shaded(distance: npt.NDArray[np.float32]) -> Array:
    """Colours (H, W, 3) of metres (H, W), near red and far blue; white where there are none."""
    from matplotlib import colormaps

    low, high = np.log(3), np.log(_FARTHEST)
    share = (np.log(np.maximum(distance, 0.1)) - low) / (high - low)
    return np.where(distance[..., None] > 0, colormaps["turbo_r"](share.clip(0, 1))[..., :3], 1.0)
