"""Look at what a model finds again: python -m lidarfw_crossplace.pictures CKPT --split test -o pictures.

Writes map.png, the drive with queries that were answered rightly and wrongly; precision_recall.png; and matches.png, in
rows: a query, the place that was found, and the nearest true one, wrong answers first.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lidarfw.components.metrics.recall_at import precision_recall
from lidarfw.draw import COLOURS, Picture, write_png
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import BEV, Descriptors, FrameMeta, Image, Record
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
    distance: Tensor  # (Q,) of descriptors
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
        hit = metres.gather(1, found[:, None])[:, 0] <= radius
        number = torch.arange(start, start + len(best))
        asked = least <= radius
        rows.append([column[asked] for column in (number, found, true, best, hit)])
    query, found, true, distance, right = (torch.cat(column) for column in zip(*rows, strict=True))
    return Answers(query, found, true, distance, right)


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
    order = torch.argsort(found.right.long(), stable=True)
    chosen = order[torch.linspace(0, len(order) - 1, min(rows, len(order))).round().long()]
    wrong = order[: int((~found.right).sum())][: max(rows // 2, 1)]
    chosen = torch.unique(torch.cat([wrong, chosen]), sorted=False)
    chosen = chosen[torch.argsort(found.right[chosen].long(), stable=True)][:rows]
    tall = next(iter(inputs[0].values()))
    height = 1.0 * len(inputs[0]) if isinstance(tall, Image) else 2.6
    from matplotlib.figure import Figure

    figure = Figure((11, height * len(chosen) + 0.4), dpi=110, layout="constrained")
    grid = figure.subplots(len(chosen), 3, squeeze=False)
    for axes, row in zip(grid, chosen.tolist(), strict=True):
        for place, (cell, numbers) in enumerate(zip(axes, (found.query, found.found, found.true), strict=True)):
            frame = int(numbers[row])
            cell.imshow(np.concatenate([picture_of(value) for value in inputs[frame].values()]))
            colour = _RIGHT if found.right[row] else _WRONG
            what = ("query", "found", "true place")[place]
            cell.set_title(f"{what}: {metas[frame].id}", fontsize=8, color=colour if place == 1 else "black")
            cell.set_axis_off()
    return _rendered(figure)


def main() -> None:
    """Describe a split and draw what is found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoint", metavar="CKPT", help="of a model that describes places")
    parser.add_argument("--split", default="test", help="of its dataset (%(default)s)")
    parser.add_argument("-o", "--output", type=Path, default=Path("pictures"), metavar="DIR", help="(%(default)s)")
    parser.add_argument("--radius", type=float, default=5.0, metavar="M", help="of a right place, metres (5)")
    parser.add_argument("--apart", type=float, default=15.05, metavar="S", help="older frames are searched (15.05 s)")
    parser.add_argument("--map", nargs="*", default=[], metavar="SEQ", help="sequences to search, instead of the own")
    parser.add_argument("--direction", choices=list(DIRECTIONS), default="", help="sensors of query and map")
    parser.add_argument("--rows", type=int, default=6, help="of matches.png (%(default)s)")
    args = parser.parse_args()
    vectors, places, metas, inputs = _described(args.checkpoint, args.split)
    found = answers(vectors, places, searched_by(metas, args.apart, args.map, args.direction), args.radius)
    if not len(found.query):
        raise ConfigError(
            f"no frame of split {args.split!r} has a place within {args.radius} m to find: --apart, --map"
        )
    write_png(args.output / "map.png", hits_on_map(found, places))
    write_png(args.output / "precision_recall.png", precision_recall_curve(found))
    write_png(args.output / "matches.png", examples(found, inputs, metas, args.rows))
    print(f"{args.output}: {int(found.right.sum())} of {len(found.right)} queries found")


def _described(checkpoint: str, split: str) -> tuple[Tensor, Tensor, list[FrameMeta], list[dict[str, Record]]]:
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
        vectors.append(result.of(Descriptors).vector)
        places.append(result.targets.poses.matrix[0, :2, 3])
        metas.append(result.meta)
        inputs.append(dict(result.inputs))
    if not vectors:
        raise DataError(f"split {split!r} has no frame with a pose")
    return torch.cat(vectors), torch.stack(places), metas, inputs


if __name__ == "__main__":
    main()
