"""Pictures of scans, boxes and training curves: arrays (H, W, 3) uint8 RGB, drawn without a display.

Colours are those of Okabe and Ito, "Color Universal Design" (2008), told apart with any colour vision.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from lidarfw.errors import DataError
from lidarfw.files import atomic_path
from lidarfw.ops import box_corners
from lidarfw.types import Boxes, Camera, PointLabels, Points, Poses, RangeImage, Tracks

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Picture = npt.NDArray[np.uint8]
Extent = tuple[float, float, float, float]  # x from, x to, y from, y to, metres

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#8C6D1F", "#5B5B5B")
_BY_NAME = {"static": "#A9A9A9", "moving": "#D41F1F"}
_TRUTH = "#111111"
_NEAR = 0.1  # metres in front of the camera, or from it, at which boxes are cut
_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_FRONT = (0, 3, 7, 4)
_DPI = 110
_LARGE = 80  # pixels from which on a box gets thick lines


def colour_of(label: int, classes: Sequence[str] = ()) -> str:
    """The colour of a class, as #rrggbb; of static and moving grey and red."""
    name = classes[label] if 0 <= label < len(classes) else ""
    return _BY_NAME.get(name, COLOURS[label % len(COLOURS)])


def write_png(path: str | Path, picture: Picture) -> None:
    """Write a picture, atomically."""
    data = png_bytes(picture)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def png_bytes(picture: Picture) -> bytes:
    """A picture as the content of a PNG file."""
    import cv2

    return bytes(cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1])


# Bird's-eye view


def birds_eye(
    points: Points | None,
    found: Boxes | Tracks | None = None,
    truth: Boxes | None = None,
    classes: Sequence[str] = (),
    *,
    labels: PointLabels | None = None,
    colour: str = "height",
    extent: Extent | None = None,
    title: str = "",
) -> Picture:
    """A frame from above, x up and y to the left, with axes in metres.

    Args:
        points: the scan; drawn by `colour`: "height" (z) or "intensity" (the first feature).
        found: predicted boxes, drawn in the colour of their class with heading and score, or tracks, drawn with
            their number.
        truth: boxes of the ground truth, dashed black.
        classes: names, by label.
        labels: a class for every point, drawn in its colour instead of `colour`; unlabelled points are grey.
        extent: what to show; by default everything but the farthest 1 % of the points.
        title: a line above.
    """
    figure, axes = _bev_axes(extent or _extent(points, [_boxes(found), truth]))
    if points is not None and len(points):
        if labels is not None:
            _scatter_classes(axes, points, labels, classes)
        else:
            _scatter(figure, axes, points, colour)
    if truth is not None:
        _outlines(axes, truth, [_TRUTH] * len(truth), linestyle=(0, (4, 2)), linewidth=1.0, zorder=4)
    boxes = _boxes(found)
    if boxes is not None:
        _outlines(axes, boxes, [colour_of(int(label)) for label in boxes.label], linewidth=1.5, zorder=5)
        _write_labels(axes, boxes, _captions(found))
    shown = boxes if boxes is not None else labels
    _legend(axes, None if shown is None else shown.label, truth, classes)
    axes.set_title(title, loc="left", fontsize=12)
    return _render(figure)


def plan_view(
    paths: Mapping[int, npt.NDArray[np.float64]], own: npt.NDArray[np.float64], colours: Mapping[int, str], title: str
) -> Picture:
    """Ways in the map from above: numbered lines (N, 2) in metres, and the way of the sensor (N, 2) in black."""
    places = np.concatenate([own, *paths.values()])
    low, high = places.min(0) - 5, places.max(0) + 5
    tall, wide = (high - low).tolist()
    scale = min(12 / wide, 10 / tall)
    figure = _figure(max(wide * scale, 4) + 1, max(tall * scale, 3) + 1, layout="constrained")
    axes = figure.add_subplot()
    for number, path in paths.items():
        axes.plot(path[:, 1], path[:, 0], color=colours[number], linewidth=1.2)
        if len(path) >= 10:
            axes.annotate(f"#{number}", (path[-1, 1], path[-1, 0]), fontsize=7, color=colours[number])
    axes.plot(own[:, 1], own[:, 0], color="#000000", linewidth=1.6)
    axes.set(xlim=(high[1], low[1]), ylim=(low[0], high[0]), aspect="equal", xlabel="y (m)", ylabel="x (m)")
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.set_title(title, loc="left", fontsize=12)
    return _render(figure)


def _boxes(found: Boxes | Tracks | None) -> Boxes | None:
    return found.boxes if isinstance(found, Tracks) else found


def _captions(found: Boxes | Tracks | None) -> list[str]:
    if isinstance(found, Tracks):
        return [f"#{number}" for number in found.id.tolist()]
    return [f"{score:.2f}" for score in found.score.tolist()] if found is not None else []


def _extent(points: Points | None, boxes: Sequence[Boxes | None]) -> Extent:
    """The middle 99 % of the points and all box centres, to the next 5 m."""
    parts = [np.zeros((1, 2))]
    if points is not None and len(points):
        parts.append(np.percentile(points.xyz[:, :2].detach().cpu().numpy(), [0.5, 99.5], axis=0))
    parts += [b.center[:, :2].detach().cpu().numpy() for b in boxes if b is not None and len(b)]
    places = np.concatenate(parts)
    low, high = np.floor((places.min(0) - 2) / 5) * 5, np.ceil((places.max(0) + 2) / 5) * 5
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _figure(width: float, height: float, **style: Any) -> Figure:
    """An empty figure of that size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=_DPI, facecolor="white", **style)
    FigureCanvasAgg(figure)
    return figure


def _render(figure: Figure) -> Picture:
    canvas: Any = figure.canvas
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def _bev_axes(extent: Extent) -> tuple[Figure, Axes]:
    """Axes to scale, with margins in inches: room at the right for legend and colour bar."""
    x0, x1, y0, y1 = extent
    scale = min(9 / (x1 - x0), 11 / (y1 - y0))
    width, height = (y1 - y0) * scale, (x1 - x0) * scale
    left, right, bottom, top = 0.7, 2.2, 0.6, 0.4
    whole = (left + width + right, bottom + height + top)
    figure = _figure(*whole)
    axes = figure.add_axes((left / whole[0], bottom / whole[1], width / whole[0], height / whole[1]))
    axes.set(xlim=(y1, y0), ylim=(x0, x1), facecolor="#FBFBFA")
    axes.set_xlabel("y (m)", fontsize=11)
    axes.set_ylabel("x (m)", fontsize=11)
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.tick_params(labelsize=10)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.plot(0, 0, marker=(3, 0, 0), markersize=9, color="#000000", zorder=6)
    return figure, axes


def _scatter(figure: Figure, axes: Axes, points: Points, colour: str) -> None:
    if colour not in ("height", "intensity"):
        raise ValueError(f"colour is height or intensity, got {colour!r}")
    xyz = points.xyz.detach().cpu().numpy()
    by_height = colour == "height" or points.features.shape[1] == 0
    values = xyz[:, 2] if by_height else points.features[:, 0].detach().cpu().numpy()
    low, high = np.percentile(values, [2, 98]) if by_height else (0.0, max(float(np.percentile(values, 99)), 1e-3))
    order = np.argsort(values)
    cloud = axes.scatter(
        xyz[order, 1], xyz[order, 0], c=values[order], s=_dot(len(xyz)), cmap="viridis", vmin=low, vmax=high,
        linewidths=0, alpha=0.8, zorder=2,
    )  # fmt: skip
    box = axes.get_position()
    inch = 1 / figure.get_figwidth()
    height = min(box.height * 0.45, 2.2 / figure.get_figheight())
    bar_axes = figure.add_axes((box.x1 + 0.2 * inch, box.y0, 0.1 * inch, height))
    figure.colorbar(cloud, cax=bar_axes).set_label("height (m)" if by_height else "intensity", fontsize=10)
    bar_axes.tick_params(labelsize=9)


def _scatter_classes(axes: Axes, points: Points, labels: PointLabels, classes: Sequence[str]) -> None:
    xyz, label = points.xyz.detach().cpu().numpy(), labels.label.cpu()
    for value in np.unique(label.numpy()).tolist():
        chosen = (label == value).numpy()
        colour, order = (colour_of(value, classes), 3) if value >= 0 else ("#BBBBBB", 2)
        axes.scatter(xyz[chosen, 1], xyz[chosen, 0], c=colour, s=_dot(len(xyz)), linewidths=0, zorder=order)


def _dot(count: int) -> float:
    """Area of a point in square points of print: smaller in dense scans."""
    return float(np.clip(5e4 / count, 0.5, 4))


def _outlines(axes: Axes, boxes: Boxes, colours: Sequence[str], zorder: float, **style: Any) -> None:
    """Rectangles with a line from the centre through the middle of the front."""
    from matplotlib.collections import LineCollection

    if not len(boxes):
        return
    corners = box_corners(boxes.tensor.detach().cpu())[:, :4, :2].numpy()[..., ::-1]
    closed = np.concatenate([corners, corners[:, :1]], 1)
    front = (corners[:, 0] + corners[:, 3]) / 2
    centre = corners.mean(1)
    heading = np.stack([centre, front + 0.35 * (front - centre)], 1)
    lines: Any = [*closed, *heading]
    axes.add_collection(LineCollection(lines, colors=[*colours, *colours], zorder=zorder, **style))


def _write_labels(axes: Axes, boxes: Boxes, captions: Sequence[str]) -> None:
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.2, foreground="white")]
    reach = boxes.size[:, :2].norm(dim=1).detach().cpu() / 2
    for (x, y, _), radius, label, caption in zip(
        boxes.center.tolist(), reach.tolist(), boxes.label.tolist(), captions, strict=True
    ):
        axes.text(
            y, x + radius, caption, fontsize=9, color=colour_of(label), ha="center", va="bottom", path_effects=halo,
            zorder=7, clip_on=True,
        )  # fmt: skip


def _legend(axes: Axes, labels: Tensor | None, truth: Boxes | None, classes: Sequence[str]) -> None:
    """Colour and count of every class among the labels (N,), and of the truth."""
    from matplotlib.lines import Line2D

    handles = []
    counts = labels[labels >= 0].bincount(minlength=len(classes)).tolist() if labels is not None else []
    for label, count in enumerate(counts):
        name = classes[label] if label < len(classes) else f"class {label}"
        colour = colour_of(label, classes)
        handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{name} ({count})"))
    if truth is not None:
        dashes = (0, (4, 2))
        handles.append(Line2D([], [], color=_TRUTH, linestyle=dashes, label=f"ground truth ({len(truth)})"))
    if handles:
        place: Any = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0}
        axes.legend(handles=handles, fontsize=11, frameon=False, **place)


# Trajectories


def trajectory(found: Poses, truth: Tensor | None = None, background: Tensor | None = None, title: str = "") -> Picture:
    """Estimated poses on the map, x to the right and y up, in metres; the true path as a line.

    Each pose is a dot in the colour of its distance to the true one (the scale ends at the 95th percentile), with a
    thin line to where it should be; poses that are not ok are grey crosses.

    Args:
        found: of all frames, in order.
        truth: (N, 4, 4) true poses of the same frames; without them the dots have one colour.
        background: (P, 3) points of the map.
        title: a line above.
    """
    places, ok = found.matrix[:, :2, 3].detach().cpu().numpy(), found.ok.cpu().numpy()
    true = None if truth is None else truth[:, :2, 3].detach().cpu().numpy()
    shown = [places[ok] if ok.any() else places, *([] if true is None else [true])]
    figure, axes = _map_axes(np.concatenate(shown))
    if background is not None:
        xy = background[:, :2].detach().cpu().numpy()
        axes.scatter(xy[:, 0], xy[:, 1], s=_dot(len(xy)), c="#C8C8C8", linewidths=0, zorder=1, rasterized=True)
    if true is None or truth is None:
        axes.scatter(places[ok, 0], places[ok, 1], s=14, c=COLOURS[0], linewidths=0, zorder=4, label="estimated")
    else:
        _beside_truth(figure, axes, found, truth)
    failed = places[~ok]
    if len(failed):
        axes.scatter(failed[:, 0], failed[:, 1], marker="x", s=24, c="#777777", zorder=3, label="no pose found")
    axes.legend(fontsize=10, frameon=False, loc="upper left", bbox_to_anchor=(1.01, 1), borderaxespad=0)
    axes.set_title(title, loc="left", fontsize=12)
    return _render(figure)


def _map_axes(places: npt.NDArray[np.float64]) -> tuple[Figure, Axes]:
    """Axes to scale around places (N, 2) of the map."""
    low, high = places.min(0) - 15, places.max(0) + 15
    size = high - low
    scale = min(10 / size[0], 9 / size[1])
    margin, right = 0.7, 2.4
    width, height = float(size[0] * scale), float(size[1] * scale)
    whole = (margin + width + right, 2 * margin + height)
    figure = _figure(*whole)
    axes = figure.add_axes((margin / whole[0], margin / whole[1], width / whole[0], height / whole[1]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor="#FBFBFA")
    axes.set_xlabel("x (m)", fontsize=11)
    axes.set_ylabel("y (m)", fontsize=11)
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _beside_truth(figure: Figure, axes: Axes, found: Poses, truth: Tensor) -> None:
    """The true path, the estimates that are ok by their error, and a colour bar."""
    from matplotlib.collections import LineCollection

    ok = found.ok.cpu().numpy()
    places, true = found.matrix[:, :3, 3].detach().cpu().numpy()[ok], truth[:, :3, 3].detach().cpu().numpy()
    apart = np.linalg.norm(places - true[ok], axis=1)
    axes.plot(true[:, 0], true[:, 1], ".", markersize=3, color=_TRUTH, zorder=2, label="true")
    links: Any = np.stack([places[:, :2], true[ok, :2]], 1)
    axes.add_collection(LineCollection(links, colors="#D55E00", linewidths=0.8, zorder=3))
    farthest = max(float(np.percentile(apart, 95)), 0.1) if len(apart) else 1.0
    dots = axes.scatter(
        places[:, 0], places[:, 1], s=18, c=apart, cmap="viridis_r", vmin=0, vmax=farthest, linewidths=0, zorder=4,
        label="estimated",
    )  # fmt: skip
    box = axes.get_position()
    bar = figure.add_axes(
        (box.x1 + 0.25 / figure.get_figwidth(), box.y0, 0.12 / figure.get_figwidth(), box.height * 0.5)
    )
    figure.colorbar(dots, cax=bar, extend="max").set_label("position error (m)", fontsize=10)


# Camera view


def camera_view(
    image: Picture,
    camera: Camera,
    found: Boxes | Tracks | None,
    truth: Boxes | None = None,
    classes: Sequence[str] = (),
) -> Picture:
    """The boxes on the picture (H, W, 3) RGB of the camera: class colour, filled front, class and score or track.

    Truth is thin white. Lines are cut where they pass the camera, and curved where the lens curves them.
    """
    view = image.copy()
    if truth is not None and len(truth):
        for lines, _ in _projected(truth, camera):
            _draw_lines(view, lines, (255, 255, 255), 1)
    boxes = _boxes(found)
    if boxes is None or not len(boxes):
        return view
    shapes, captions = _projected(boxes, camera), _captions(found)
    distance = camera.to_camera(boxes.center.detach().cpu()).norm(dim=1)
    for number in distance.argsort(descending=True).tolist():
        label = int(boxes.label[number])
        name = classes[label] if label < len(classes) else f"class {label}"
        lines, front = shapes[number]
        _draw_box(view, lines, front, _rgb(colour_of(label)), f"{name} {captions[number]}")
    return view


def _rgb(colour: str) -> tuple[int, int, int]:
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _projected(boxes: Boxes, camera: Camera) -> list[tuple[list[np.ndarray], np.ndarray | None]]:
    """For each box the visible pieces of its edges, polylines (K, 2) in pixels, and its front face if all in view."""
    straight = camera.model == "pinhole" and not any(camera.distortion)
    steps = torch.linspace(0, 1, 2 if straight else 24, dtype=torch.float64)[:, None]
    corners = box_corners(boxes.tensor.detach().cpu().double())
    start, end = corners[:, [a for a, _ in _EDGES]], corners[:, [b for _, b in _EDGES]]
    if camera.model == "pinhole":
        start, end = _cut_near(start, end, camera)
    along = start[..., None, :] + steps * (end - start)[..., None, :]  # (M, 12, K, 3)
    uv, depth, _ = camera.project(along.reshape(-1, 3))
    uv[depth < _NEAR * 0.99] = torch.nan
    lines = uv.reshape(*along.shape[:3], 2).numpy()
    fronts, depth, _ = camera.project(corners[:, list(_FRONT)].reshape(-1, 3))
    fronts[depth < _NEAR] = torch.nan
    faces = fronts.reshape(-1, 4, 2).numpy()
    seen = [_in_picture(edges, camera) for edges in lines]
    return [
        (_pieces(edges) if ok else [], face if ok and np.isfinite(face).all() else None)
        for edges, face, ok in zip(lines, faces, seen, strict=True)
    ]


def _cut_near(start: Tensor, end: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Edges (M, 12, 3) cut at the near plane; those wholly behind stay behind."""
    shape = start.shape
    z0, z1 = (camera.to_camera(p.reshape(-1, 3))[:, 2].reshape(*shape[:2], 1) for p in (start, end))
    rise = torch.where(z0 == z1, 1.0, z1 - z0)
    cut = start + (_NEAR - z0) / rise * (end - start)
    return torch.where((z0 < _NEAR) & (z1 > _NEAR), cut, start), torch.where((z1 < _NEAR) & (z0 > _NEAR), cut, end)


def _in_picture(edges: np.ndarray, camera: Camera) -> bool:
    """Whether the rectangle around the visible part of the box meets the picture."""
    seen = edges[np.isfinite(edges).all(-1)]
    size = (camera.width, camera.height)
    return len(seen) > 0 and bool((seen.max(0) > 0).all() and (seen.min(0) < size).all())


def _pieces(edges: np.ndarray) -> list[np.ndarray]:
    """The runs of finite points of each edge (E, K, 2)."""
    pieces = []
    for edge in edges:
        finite = np.isfinite(edge).all(1)
        breaks = np.flatnonzero(np.diff(finite)) + 1
        pieces += [run for run, ok in zip(np.split(edge, breaks), finite[[0, *breaks]], strict=True) if ok]
    return [piece for piece in pieces if len(piece) > 1]


def _fixed(points: np.ndarray) -> np.ndarray:
    """Pixels in OpenCV's fixed-point form with 4 fractional bits, kept within what it can draw."""
    return (points.clip(-1e5, 1e5) * 16).round().astype(np.int32)


def _draw_lines(view: Picture, lines: list[np.ndarray], colour: tuple[int, int, int], width: int) -> None:
    import cv2

    cv2.polylines(view, [_fixed(line) for line in lines], False, colour, width, cv2.LINE_AA, 4)


def _draw_box(
    view: Picture, lines: list[np.ndarray], front: np.ndarray | None, colour: tuple[int, int, int], caption: str
) -> None:
    import cv2

    if not lines:
        return
    if front is not None:
        filled = view.copy()
        cv2.fillPoly(filled, [_fixed(front)], colour, cv2.LINE_AA, 4)
        view[:] = cv2.addWeighted(filled, 0.35, view, 0.65, 0)
    ends = np.concatenate(lines)
    large = float(np.ptp(ends, axis=0).max()) > _LARGE
    _draw_lines(view, lines, (255, 255, 255), 3 if large else 2)
    _draw_lines(view, lines, colour, 2 if large else 1)
    corner = ends.min(0)
    _write(view, caption, corner, colour)


def _write(view: Picture, text: str, corner: np.ndarray, colour: tuple[int, int, int]) -> None:
    """White text on a filled rectangle whose lower left is at `corner`, moved into the picture."""
    import cv2

    scale = max(0.4, view.shape[1] / 3000)
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    x = int(np.clip(corner[0], 0, max(view.shape[1] - width - 4, 0)))
    y = int(np.clip(corner[1], height + below + 2, max(view.shape[0] - 2, height + below + 2)))
    cv2.rectangle(view, (x, y - height - below - 1), (x + width + 3, y), colour, -1)
    cv2.putText(view, text, (x + 2, y - below + 1), cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 1, cv2.LINE_AA)


# Range images


def range_picture(image: RangeImage, sample: int = 0, scale: int = 4) -> Picture:
    """Range (above) and the first feature (below) of one sample, rows `scale` times; grey has no point."""
    from matplotlib import colormaps

    mask = image.mask[sample].cpu().numpy()
    distance = image.xyz[sample].norm(dim=0).cpu().numpy()
    feature = image.features[sample, 0].detach().cpu().numpy()
    rows = []
    for values in (np.log1p(distance), feature):
        low, high = np.percentile(values[mask], [1, 99]) if mask.any() else (0.0, 1.0)
        colours = colormaps["viridis"](((values - low) / max(high - low, 1e-6)).clip(0, 1))[..., :3]
        rows.append((np.where(mask[..., None], colours, 0.35) * 255).astype(np.uint8))
    rows.insert(1, np.full((2, mask.shape[1], 3), 255, np.uint8))
    stacked = np.concatenate(rows)
    return stacked.repeat(scale, 0)


def range_labels(
    image: RangeImage, points: Points, labels: PointLabels, classes: Sequence[str] = (), scale: int = 4
) -> Picture:
    """Labels of the points of one scan in their range image, in the colours of the classes, rows `scale` times.

    `points` are those that the image was made of; the nearest one of a pixel counts. Brightness is nearness; black
    has no point, grey one that is static or has no class.
    """
    height, width = image.mask.shape[1:]
    distance = points.xyz.norm(dim=1).cpu().numpy()
    order = np.argsort(-distance, kind="stable")  # of several points in a pixel the nearest is written last
    pixel = image.pixel.cpu().numpy()[order]
    label, near = np.full(height * width, -1), np.zeros(height * width)
    label[pixel[pixel >= 0]] = labels.label.cpu().numpy()[order][pixel >= 0]
    near[pixel[pixel >= 0]] = 1 / (1 + distance[order][pixel >= 0] / 20)
    names = [colour_of(number, classes) for number in range(int(label.max(initial=0)) + 1)]
    colours = np.array([_rgb(colour) for colour in [*names, _BY_NAME["static"]]])[label]
    grey = (label < 0) | np.isin(label, [n for n, name in enumerate(classes) if name == "static"])
    shade = np.where(grey, near, 0.4 + 0.6 * near) * (near > 0)
    picture: Picture = (colours * shade[:, None]).astype(np.uint8).reshape(height, width, 3).repeat(scale, 0)
    return picture


def side_by_side(pictures: Sequence[Picture], columns: int, width: int) -> Picture:
    """Pictures in rows of `columns`, each scaled to `width` pixels, with white between them."""
    import cv2

    sizes = [(width, round(p.shape[0] * width / p.shape[1])) for p in pictures]
    scaled: list[Any] = [cv2.resize(p, size, interpolation=cv2.INTER_AREA) for p, size in zip(pictures, sizes)]
    rows = [scaled[first : first + columns] for first in range(0, len(scaled), columns)]
    return np.concatenate([_row_of(row, columns, width) for row in rows])


def _row_of(pictures: Sequence[Picture], columns: int, width: int, gap: int = 6) -> Picture:
    height = max(picture.shape[0] for picture in pictures)
    row = np.full((height + gap, columns * (width + gap), 3), 255, np.uint8)
    for number, picture in enumerate(pictures):
        left = number * (width + gap)
        row[: picture.shape[0], left : left + width] = picture
    return row


# Curves


def read_metrics(path: str | Path) -> dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]:
    """The curves of a metrics.csv with a column `step`: name -> (steps, values), empty cells left out."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not rows or "step" not in rows[0]:
        raise DataError(
            f"{path}: expected a table with a column `step`, found {', '.join(rows[0]) if rows else 'none'}"
        )
    curves = {}
    for name in rows[0]:
        cells = [(float(row["step"]), float(row[name])) for row in rows if name not in ("step", "epoch") and row[name]]
        if cells:
            curves[name] = (np.array([step for step, _ in cells]), np.array([value for _, value in cells]))
    return curves


def curves(metrics: dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]) -> Picture:
    """One panel for each group of curves: the total loss, its terms, the figures of validation, learning rates."""
    groups = {title: names for title, names in _groups(list(metrics)).items() if names}
    columns = min(max(len(groups), 1), 2)
    rows = max(-(-len(groups) // columns), 1)
    figure = _figure(5.6 * columns, 3.3 * rows, layout="constrained")
    for axes, (title, names) in zip(figure.subplots(rows, columns, squeeze=False).flat, groups.items(), strict=False):
        _curve_panel(axes, title, {name: metrics[name] for name in names})
    for axes in list(figure.axes)[len(groups) :]:
        axes.set_axis_off()
    return _render(figure)


def _groups(names: list[str]) -> dict[str, list[str]]:
    rates = [name for name in names if name.startswith(("lr", "learning_rate"))]
    losses = [name for name in names if "loss" in name.split("/")[0] or "/loss" in name]
    figures = [name for name in names if name not in losses and name.split("/")[0] in ("val", "test")]
    totals = [name for name in losses if name.endswith("total")]
    terms = [name for name in losses if name not in totals]
    return {"Loss": totals, "Terms of the loss": terms, "Validation": figures, "Learning rate": rates}


def _curve_panel(
    axes: Axes, title: str, curves: dict[str, tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]]
) -> None:
    styles = ("-", "--", ":")
    for number, (name, (steps, values)) in enumerate(sorted(curves.items())):
        colour, style = colour_of(number), styles[number // len(COLOURS) % len(styles)]
        marker = "o" if len(steps) < 12 else None
        smooth = _smoothed(values) if title.startswith(("Loss", "Terms")) else values
        if smooth is not values:
            axes.plot(steps, values, color=colour, linewidth=0.6, alpha=0.3)
        axes.plot(steps, smooth, style, color=colour, linewidth=1.6, label=_short(name), marker=marker, markersize=4)
    axes.set_title(title, loc="left", fontsize=10)
    axes.set_xlabel("step", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    values = np.concatenate([values for _, values in curves.values()])
    if title == "Validation" and values.min() >= 0 and values.max() <= 1:
        axes.set_ylim(-0.03, 1.03)
    elif title.startswith(("Loss", "Terms")) and values.min() > 0 and values.max() > 20 * np.median(values):
        axes.set_yscale("log")
    if len(curves) > 1 or title != "Loss":
        axes.legend(fontsize=7, frameon=False, loc="best", ncols=1 if len(curves) <= 6 else 2)


def _short(name: str) -> str:
    return name.split("/", 1)[1] if name.split("/")[0] in ("val", "test", "loss", "train") else name


def _smoothed(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Running mean over a twentieth of the curve, unshifted; short curves stay as they are."""
    width = len(values) // 20
    if width < 2:
        return values
    total = np.convolve(values, np.ones(2 * width + 1), "same")
    return total / np.convolve(np.ones_like(values), np.ones(2 * width + 1), "same")
