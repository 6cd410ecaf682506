"""Look at what a model finds again: python -m lidarfw_crossplace.pictures CKPT --split test -o pictures.

Writes map.png, the drive with queries that were answered rightly and wrongly; precision_recall.png; and matches.png, in
rows: a query, the place that was found, and the nearest true one, wrong answers first; sensors.png, where frames are
there by camera and LiDAR, both panoramas of the same moment one above the other.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lidarfw.cli import answered
from lidarfw.components.metrics.recall_at import precision_recall
from lidarfw.draw import COLOURS, Picture, write_png
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import BEV, Descriptors, FrameMeta, FrameResult, Image, Record
from torch import Tensor

from lidarfw_crossplace.metrics import DIRECTIONS

_BLOCK = 512
_RIGHT, _WRONG, _OTHER = COLOURS[2], COLOURS[1], "#C8C8C8"


@dataclass
class Answers:
    """The best match of every query that has a true place."""

    query: Tensor  # (Q,) number of the frame
    found: Tensor  # (Q,) number of the place found
    true: Tensor  # (Q,) number of the nearest place
    distance: Tensor  # (Q,) of descriptors, to the place found
    true_distance: Tensor  # (Q,) to the nearest place
    off: Tensor  # (Q,) metres from the query to the place found
    right: Tensor  # (Q,) bool


def answers(vectors: Tensor, places: Tensor, searched: Tensor, radius: float) -> Answers:
    """Search frames with descriptors (F, D) taken at places (F, 2), metres.

    `searched` (F, F) bool says which frames each one searches; frames without a place within `radius` ask nothing.
    """
    rows = []
    for start in range(0, len(vectors), _BLOCK):
        part, allowed = slice(start, start + _BLOCK), searched[start : start + _BLOCK]
        metres = torch.cdist(places[part].double(), places.double(), compute_mode="donot_use_mm_for_euclid_dist")
        metres = metres.masked_fill(~allowed, torch.inf)
        apart = torch.cdist(vectors[part].double(), vectors.double()).masked_fill(~allowed, torch.inf)
        best, found = apart.min(1)
        least, true = metres.min(1)
        off = metres.gather(1, found[:, None])[:, 0]
        number = torch.arange(start, start + len(best))
        asked, there = least <= radius, apart.gather(1, true[:, None])[:, 0]
        rows.append([column[asked] for column in (number, found, true, best, there, off, off <= radius)])
    return Answers(*(torch.cat(column) for column in zip(*rows, strict=True)))


def searched_by(metas: Sequence[FrameMeta], apart: float, maps: Sequence[str], direction: str) -> Tensor:
    """(F, F) bool: with `maps`, frames of other sequences search these; else frames `apart` seconds older of their own.

    `direction` as in `place_recall`, or empty.
    """
    names = sorted({meta.sequence for meta in metas})
    sequence = torch.tensor([names.index(meta.sequence) for meta in metas])
    time = torch.tensor([meta.time for meta in metas], dtype=torch.float64)
    if maps:
        kept = torch.tensor([meta.sequence in maps for meta in metas])
        found = ~kept[:, None] & kept
    else:
        found = (sequence[:, None] == sequence) & (time[:, None] - time >= apart)
    if direction:
        asking, asked = (torch.tensor([meta.modality == kind for meta in metas]) for kind in DIRECTIONS[direction])
        found &= asking[:, None] & asked
    return found


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure((width, height), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#DDDDDD", linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def _rendered(figure: Any) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def hits_on_map(found: Answers, places: Tensor) -> Picture:
    """All places (F, 2), the queries in the colour of their answer, and lines from wrong ones to what they found."""
    from matplotlib.collections import LineCollection

    figure, axes = _figure(9, 7)
    xy, right = places.numpy(), found.right.numpy()
    asked, got = xy[found.query.numpy()], xy[found.found.numpy()]
    axes.plot(*xy.T, ".", markersize=2, color=_OTHER, label=f"all {len(xy):,} frames", rasterized=True)
    axes.add_collection(LineCollection(np.stack([asked, got], 1)[~right], colors=_WRONG, linewidths=0.6, alpha=0.6))
    axes.plot(*asked[right].T, ".", markersize=5, color=_RIGHT, label=f"{right.sum():,} found")
    axes.plot(*asked[~right].T, "x", markersize=6, color=_WRONG, label=f"{(~right).sum():,} wrong, line to the answer")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.set_title(f"Recall@1 {100 * right.mean():.1f} % of {len(right):,} queries", loc="left")
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    return _rendered(figure)


def precision_recall_curve(found: Answers) -> Picture:
    """Precision over recall when matches up to a distance are taken as the same place."""
    precision, recall = precision_recall(found.distance, found.right, len(found.right))
    average = float((torch.diff(recall, prepend=recall.new_zeros(1)) * precision).sum())
    figure, axes = _figure(6, 5)
    axes.plot(recall, precision, color=COLOURS[0], linewidth=2)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.01), ylim=(0, 1.02))
    axes.set_title(f"Average precision {average:.3f}", loc="left")
    return _rendered(figure)


def picture_of(value: Record) -> Picture:
    """A panorama or bird's-eye view of one sample as a picture: three channels as colours, else the first as grey."""
    if not isinstance(value, Image | BEV):
        raise DataError(f"only panoramas and bird's-eye views can be shown, not {type(value).__name__}")
    shown = value.features[0, :3] if value.features.shape[1] == 3 else value.features[0, :1].expand(3, -1, -1)
    peak = 255 if isinstance(value, Image) else 510  # sparse views are dark
    picture: Picture = (shown * peak).clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return picture


def examples(found: Answers, inputs: Sequence[dict[str, Record]], metas: Sequence[FrameMeta], rows: int) -> Picture:
    """Query, found and true place beside each other, all inputs of a frame below each other; wrong answers first."""
    from matplotlib.figure import Figure

    wrong, right = (~found.right).nonzero()[:, 0], found.right.nonzero()[:, 0]
    half = max(rows // 2, rows - len(right))
    chosen = [*_spread(wrong, half), *_spread(right, rows - min(half, len(wrong)))]
    shape = np.concatenate([picture_of(value) for value in inputs[0].values()]).shape
    figure = Figure((11, len(chosen) * (11 / 3 * shape[0] / shape[1] + 0.4)), dpi=110, layout="constrained")
    for axes, row in zip(figure.subplots(len(chosen), 3, squeeze=False), chosen, strict=True):
        said = f"{found.distance[row]:.3f}, {found.off[row]:.0f} m off", f"{found.true_distance[row]:.3f}"
        titles = ("query", f"found: distance {said[0]}", f"true place: distance {said[1]}")
        for cell, title, numbers in zip(axes, titles, (found.query, found.found, found.true), strict=True):
            frame = int(numbers[row])
            cell.imshow(np.concatenate([picture_of(value) for value in inputs[frame].values()]))
            colour = (_RIGHT if found.right[row] else _WRONG) if title.startswith("found") else "black"
            cell.set_title(f"{title}\n{metas[frame].id}", fontsize=8, color=colour)
            cell.set_axis_off()
    return _rendered(figure)


def _spread(numbers: Tensor, count: int) -> list[int]:
    """At most `count` of the numbers, evenly from first to last."""
    places = torch.linspace(0, max(len(numbers) - 1, 0), min(count, len(numbers))).round().long()
    return [int(number) for number in numbers[places]]


def both_sensors(
    vectors: Tensor, inputs: Sequence[dict[str, Record]], metas: Sequence[FrameMeta], rows: int
) -> Picture | None:
    """Every map of the same moment by the cameras and, below it, by the LiDAR; None where no frame is there by both.

    The title says how far apart the two descriptors are, and the camera's from the nearest other frame by LiDAR.
    """
    from matplotlib.figure import Figure

    frames = {(meta.sequence, meta.index, meta.modality): number for number, meta in enumerate(metas)}
    lidar = torch.tensor([number for (_, _, kind), number in frames.items() if kind == "lidar"], dtype=torch.long)
    pairs = [(one, frames[s, i, "lidar"]) for (s, i, kind), one in frames.items()
             if kind == "camera" and (s, i, "lidar") in frames]  # fmt: skip
    if not pairs:
        return None
    names = list(inputs[0])
    shape = picture_of(inputs[0][names[0]]).shape
    figure = Figure((11, rows * (2 * len(names) * 10 * shape[0] / shape[1] + 0.5)), dpi=110, layout="constrained")
    for part, number in zip(figure.subfigures(rows, 1, squeeze=False)[:, 0], _spread(torch.arange(len(pairs)), rows)):
        camera, scan = pairs[number]
        apart = (vectors[lidar] - vectors[camera]).norm(dim=1)
        same, other = float(apart[lidar == scan]), float(apart[lidar != scan].min()) if len(lidar) > 1 else float("nan")
        part.suptitle(f"{metas[camera].id}: distance {same:.3f}, nearest other scan {other:.3f}", fontsize=9)
        cells = part.subplots(2 * len(names), 1, squeeze=False)[:, 0]
        order = [(name, frame) for name in names for frame in (camera, scan)]
        for cell, (name, frame) in zip(cells, order, strict=True):
            cell.imshow(picture_of(inputs[frame][name]))
            cell.set_ylabel(f"{name}\n{metas[frame].modality}", fontsize=7, rotation=0, ha="right", va="center")
            cell.set(xticks=[], yticks=[])
    return _rendered(figure)


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Describe a split and draw what is found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", metavar="CKPT", help="of a model that describes places")
    parser.add_argument("--split", default="test", help="of its dataset (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("pictures"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--radius", type=float, default=5.0, metavar="M", help="of a right place, metres (5)")
    parser.add_argument("--apart", type=float, default=15.05, metavar="S", help="older frames are searched (15.05 s)")
    parser.add_argument("--map", nargs="*", default=[], metavar="SEQ", help="sequences to search, instead of the own")
    parser.add_argument("--direction", choices=list(DIRECTIONS), default="", help="sensors of query and map")
    parser.add_argument("--head", default="", metavar="NAME", help="whose descriptors, of several: head.fused")
    parser.add_argument("--rows", type=int, default=6, help="of matches.png (%(default)s)")
    args = parser.parse_args(arguments)
    vectors, places, metas, inputs = _described(args.checkpoint, args.split, args.head)
    found = answers(vectors, places, searched_by(metas, args.apart, args.map, args.direction), args.radius)
    if not len(found.query):
        raise ConfigError(
            f"no frame of split {args.split!r} has a place within {args.radius} m to find: --apart, --map"
        )
    write_png(args.output / "map.png", hits_on_map(found, places))
    write_png(args.output / "precision_recall.png", precision_recall_curve(found))
    write_png(args.output / "matches.png", examples(found, inputs, metas, args.rows))
    both = both_sensors(vectors, inputs, metas, 2)
    if both is not None:
        write_png(args.output / "sensors.png", both)
    print(f"{args.output}: {int(found.right.sum())} of {len(found.right)} queries found")


def _described(
    checkpoint: str, split: str, head: str
) -> tuple[Tensor, Tensor, list[FrameMeta], list[dict[str, Record]]]:
    """Descriptors (F, D), places (F, 2), names and inputs of the frames of a split that have a pose."""
    import lidarfw
    from lidarfw import predict
    from rich.progress import track

    model = lidarfw.load(Path(checkpoint))
    frames = predict.SplitFrames(model, split)
    vectors, places, metas, inputs = [], [], [], []
    for result in predict.predict_frames(model, (frames[i] for i in track(range(len(frames)), "describe"))):
        if result.targets is None or result.targets.poses is None or not bool(result.targets.poses.ok[0]):
            continue
        vectors.append(_descriptors(result, head).vector)
        places.append(result.targets.poses.matrix[0, :2, 3])
        metas.append(result.meta)
        inputs.append(dict(result.inputs))
    if not vectors:
        raise DataError(f"split {split!r} has no frame with a pose")
    return torch.cat(vectors), torch.stack(places), metas, inputs


def _descriptors(result: FrameResult, head: str) -> Descriptors:
    """Those of a head, or the only ones."""
    there = {name: value for name, value in result.predictions.items() if isinstance(value, Descriptors)}
    if (head and head not in there) or (not head and len(there) != 1):
        raise ConfigError(f"the model gives descriptors by {', '.join(there) or 'no head'}: choose with --head NAME")
    return there[head] if head else next(iter(there.values()))


if __name__ == "__main__":
    sys.exit(main())
