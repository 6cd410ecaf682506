"""One picture of a town: the map with the route, what the camera sees, and the scan from above and as a range image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from lidarfw.files import atomic_path

from lidarfw_town.bodies import KINDS
from lidarfw_town.camera import kitti_camera
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.mesh import Array
from lidarfw_town.render import photograph
from lidarfw_town.sensors import Lidar

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
_STEP = 160  # of the drive that is drawn
_REACH = 42.0  # metres around the vehicle in the view from above


def write_picture(path: str | Path, seed: int, lidar: Lidar, traversal: int = 0) -> None:
    """Draw the town of a seed, and a moment of a drive through it, into a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drive = Drive(seed, 300, lidar, traversal=traversal)
    frame = drive.frame(_STEP)
    figure = Figure((16, 13.4), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, height_ratios=(6.6, 4.2, 1.6))
    _draw_map(figure.add_subplot(grid[0, 0]), drive)
    _draw_scan(figure.add_subplot(grid[0, 1]), frame)
    _draw_camera(figure.add_subplot(grid[1, :]), drive, frame)
    _draw_ranges(figure.add_subplot(grid[2, :]), frame)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def colours_of(semantic: npt.NDArray[np.integer]) -> Array:
    """A colour (N, 3) for every class id (N,)."""
    table = np.tile(np.array(_COLOURS["nothing"]), (260, 1))
    for name, ids in _GROUPS.items():
        table[list(ids)] = _COLOURS[name]
    return np.asarray(table[np.minimum(semantic, 259)])


def _draw_map(axes: Axes, drive: Drive) -> None:
    """The surfaces of the town from above, highest last, the route, and where everybody is."""
    from matplotlib.collections import PolyCollection

    mesh = drive.still.mesh
    order = np.argsort(mesh.triangles[..., 2].mean(1))
    axes.add_collection(
        PolyCollection(
            list(mesh.triangles[order][..., :2]),
            facecolors=colours_of(mesh.semantic[order]),
            antialiased=False,
            linewidths=0,
        )
    )
    axes.plot(*drive.traffic.ego[:, :2].T, color="#C2185B", linewidth=2, label="route of half a minute")
    axes.plot(*drive.traffic.ego[_STEP, :2], "o", color="#C2185B", markersize=7)
    movers = np.array([(*mover.at(_STEP)[:2], mover.kind == "pedestrian") for mover in drive.traffic.movers])
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
    west, south, east, north = drive.world.land.bounds
    axes.set(xlim=(west, east), ylim=(south, north), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.legend(loc="lower right", framealpha=0.9)
    axes.set_title(f"town of seed {drive.seed}", loc="left")


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


def _draw_camera(axes: Axes, drive: Drive, frame: TownFrame) -> None:
    axes.imshow(photograph(drive, frame, kitti_camera()).image)
    axes.set_axis_off()
    axes.set_title("camera", loc="left")


def _draw_ranges(axes: Axes, frame: TownFrame) -> None:
    """Ranges by beam and column; white where nothing came back."""
    image = np.where(frame.grid > 0, np.log(np.maximum(frame.grid, 1)), np.nan)
    axes.imshow(image, aspect="auto", cmap="turbo_r", vmin=np.log(3), vmax=np.log(80), interpolation="nearest")
    axes.set_axis_off()
    axes.set_title("range image: near red, far blue; left and right edge look backward", loc="left")
