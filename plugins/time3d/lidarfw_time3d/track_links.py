"""How well tracks hold on to objects, and how smoothly: figures that AMOTA hardly sees."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.components.matching import greedy_match
from lidarfw.components.metrics.sequence import sequence_number
from lidarfw.interfaces import Metric
from lidarfw.types import FrameMeta, Spec, Targets, Tracks, take
from torch import Tensor

Array = npt.NDArray[np.float64]

_NEAR, _RELATIVE = 2.0, 0.1  # metres on the ground, or this share of the distance: a box and its object
_LONGEST = 5  # frames for which an object may be out of sight and still be linked
_WIDTH = 13  # sequence, frame, seconds, object, track, place x y z, true place x y z, velocity x y


class TrackLinks(Metric):
    """Links between the boxes of an object, and the smoothness of what is told of it.

    In every frame boxes and labelled objects of the same class are paired by falling score, within 2 m or a tenth of
    their distance. `accuracy`: share of objects, seen again within five frames, whose box has the id that it had;
    `switches`: how many have not. `center_error` (m): of paired boxes; `jitter` (m): length of the second difference
    of that error over three consecutive frames of an object, in the map where poses are known; `velocity_error`
    (m/s): against the object's displacement since the frame before. `linkable` and `found` count objects.
    """

    monitor: ClassVar[str] = "accuracy"
    higher_is_better = True
    full_state_update = False
    rows: list[Tensor]  # (R, 13), one per object and frame where it was found

    def __init__(self, tracks: Spec) -> None:
        super().__init__()
        self.add_state("rows", default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.rows.append(torch.zeros(0, _WIDTH, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, tracks: Tracks, targets: Targets, meta: list[FrameMeta]) -> None:
        """Count the tracks of frames in."""
        if targets.tracks is None:
            return
        for number, frame in enumerate(meta):
            pose = torch.eye(4, dtype=torch.float64)
            if targets.poses is not None and bool(targets.poses.ok[number]):
                pose = targets.poses.matrix[number].double().cpu()
            self._add(take(tracks, number), take(targets.tracks, number), frame, pose)

    def _add(self, found: Tracks, known: Tracks, meta: FrameMeta, pose: Tensor) -> None:
        pair = _paired(found, known)
        kept = (pair >= 0).nonzero()[:, 0]
        objects = pair[kept]
        velocity = found.boxes.velocity
        flat = torch.zeros(len(kept), 2) if velocity is None else velocity[kept].cpu()
        parts = [
            torch.tensor([[sequence_number(meta.sequence), meta.index, meta.time]]).double().expand(len(kept), 3),
            known.id[objects][:, None], found.id[kept][:, None],
            _in_map(found.boxes.center[kept], pose), _in_map(known.boxes.center[objects], pose),
            flat.double() @ pose[:2, :2].T,
        ]  # fmt: skip
        self.rows.append(torch.cat([part.double().cpu() for part in parts], 1).to(self.device))

    def compute(self) -> dict[str, Any]:
        """The figures, as floats; 0 where there is nothing to count."""
        rows = self.rows if isinstance(self.rows, Tensor) else torch.cat(self.rows)
        table: Array = rows.cpu().numpy()
        table = table[np.lexsort((table[:, 1], table[:, 3], table[:, 0]))]
        before, after = table[:-1], table[1:]
        step = after[:, 1] - before[:, 1]
        same = (before[:, [0, 3]] == after[:, [0, 3]]).all(1) & (step <= _LONGEST)
        kept = before[same, 4] == after[same, 4]
        error = table[:, 5:8] - table[:, 8:11]
        next_one = same & (step == 1)
        three = next_one[:-1] & next_one[1:]
        second = (error[2:] - 2 * error[1:-1] + error[:-2])[three] if len(three) else np.zeros((0, 3))
        seconds = np.maximum(after[:, 2] - before[:, 2], 1e-6)[:, None]
        missed = after[:, 11:13] - (after[:, 8:10] - before[:, 8:10]) / seconds
        return {
            "accuracy": _mean(kept),
            "switches": float((~kept).sum()),
            "jitter": _mean(np.linalg.norm(second, axis=1)),
            "center_error": _mean(np.linalg.norm(error, axis=1)),
            "velocity_error": _mean(np.linalg.norm(missed[next_one], axis=1)),
            "linkable": float(len(kept)),
            "found": float(len(table)),
        }


def _paired(found: Tracks, known: Tracks) -> Tensor:
    """(M,) object of each track box, -1 for none."""
    apart = torch.cdist(found.boxes.center[:, :2].double(), known.boxes.center[:, :2].double())
    reach = (_RELATIVE * known.boxes.center[:, :2].double().norm(dim=1)).clamp(min=_NEAR)
    near = (apart <= reach) & (found.boxes.label[:, None] == known.boxes.label)
    order = found.boxes.score.argsort(descending=True, stable=True)
    chosen = greedy_match(torch.where(near, -apart, -torch.inf)[order])
    return torch.empty_like(chosen).index_copy_(0, order, chosen)


def _in_map(places: Tensor, pose: Tensor) -> Tensor:
    return places.double().cpu() @ pose[:3, :3].T + pose[:3, 3]


def _mean(values: npt.NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else 0.0
