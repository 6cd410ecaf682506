"""Motion consistency: the probability that a point moves, fused over a window of frames.

Source: Tang, Zhu and Sun, Remote Sensing 2025, 17(2), 195, section 3.4 (equations 5-9); the recursion and its prior
are those of Mersch et al., "Receding Moving Object Segmentation in 3D LiDAR Data Using Sparse 4D Convolutions"
(4DMOS), RA-L 2022.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field

import torch
from lidarfw.components.per_class import check_names
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Filter
from lidarfw.ops import points_in_boxes, range_match, range_project
from lidarfw.types import Boxes, DataSpec, FrameResult, PointLabels, Points, Poses, RangeImage, RangeView, Spec
from torch import Tensor

TRANSPORTS = ("warp", "voxel", "point")
_CERTAIN = 1e-6  # probabilities are kept so far from 0 and 1
_HDL64 = RangeView(64, 2048, math.radians(3), math.radians(-25), clip=True)  # where the data has no range image
_SHIFT = 2**20  # makes cell numbers positive


@dataclass
class Observation:
    """What one frame of the window says of its points, in its sensor frame."""

    xyz: Tensor  # (M, 3) metres, the current scan
    evidence: Tensor  # (M,) log-odds beyond the prior: logit(xi) - l_0; 0 where the network says nothing
    prior: Tensor  # (M,) l_0
    velocity: Tensor  # (M, 2) m/s over ground along the sensor's axes; (0, 2) without motion compensation
    pose: Tensor  # (4, 4) float64, sensor to map
    time: float  # seconds
    result: FrameResult | None  # the frame, until it is given out
    labels: PointLabels | None  # its prediction before the filter, likewise
    current: Tensor  # (N,) bool, rows of the prediction that belong to the current scan


@dataclass
class BayesState:
    """The last frames of a sequence, oldest first."""

    window: list[Observation] = field(default_factory=list)
    unknown: int = 0  # points whose probability was not a number, so far


class BayesFilter(Filter):
    """Log-odds that a point moves, summed over the last `window` frames (section 3.4, equation 8).

    l = l_0 + sum over the frames of the window of (logit xi - l_0), with l_0 = logit(prior): the recursion of the
    paper with the oldest frame dropped. p = 1 / (1 + exp(-l)) is the probability of the class `moving`; the others
    share the rest as before. A point that no frame knows gets the prior. Note what a prior below 0.5 does: every
    further frame adds -l_0, so that at prior 0.25 two frames of xi = 0.366 make "moving" (0.5 for one frame).

    How evidence comes from one scan to another (`transport`), since no point is met twice:

    * warp: the points of the other scan, moved into this one by the poses, are projected into the range view; within
      `search` pixels of each point, the nearest in range counts if it is within the gate, max(`gate`, `max_speed` *
      time between) metres.
    * voxel: points in the same cell of the map, of side `cell` metres, share the mean of their evidence.
    * point: the network itself predicts the points of past scans too (rows with a negative time); these are the same
      points, so nothing is searched (4DMOS). Needs a head that labels all scans of a frame.

    With warp and voxel, evidence stays where it was in the world, so an object that has moved on loses it or leaves it
    behind; `motion_compensation` moves the points in predicted boxes with their velocity.

    `delay` frames are held back, so that later frames of the window speak too (4DMOS). `tempering` scales the sum,
    `forgetting` the evidence of a frame per frame of its age. `adaptive` = (a, b, c) makes the prior depend on the
    point: l_0 = a + b ln(range) + c z; `lidarfw_dpdc_mos.study.fit_prior` gives it. After more than `max_gap`
    seconds the window starts anew. Without poses the sensor counts as standing still, with a warning.
    """

    example = {"moving": "Car", "window": 3}

    def __init__(
        self,
        labels: Spec,
        points: Spec,
        pose: Spec | None,
        boxes: Spec | None,
        data: DataSpec,
        *,
        window: int = 2,
        prior: float = 0.25,
        transport: str = "warp",
        delay: int = 0,
        gate: float = 0.5,
        max_speed: float = 15.0,
        search: int = 2,
        cell: float = 0.25,
        tempering: float = 1.0,
        forgetting: float = 1.0,
        adaptive: tuple[float, ...] = (),
        motion_compensation: bool = False,
        max_gap: float = 0.5,
        moving: str = "moving",
    ) -> None:
        super().__init__()
        _check(window, prior, transport, delay, adaptive)
        check_names(labels.classes, [moving], "filter.bayes.moving")
        self.window, self.delay, self.transport = window, delay, transport
        self.gate, self.max_speed, self.search, self.cell = gate, max_speed, search, cell
        self.tempering, self.forgetting, self.max_gap = tempering, forgetting, max_gap
        self.coefficients = adaptive or (math.log(prior / (1 - prior)), 0.0, 0.0)
        self.motion_compensation = motion_compensation
        self.moving = labels.classes.index(moving)
        self.view = range_view(data)
        if pose is None and transport != "point":
            warnings.warn(
                "filter.bayes has no poses and takes the sensor as standing still.\n"
                "  fix: a dataset with the input `pose` (dataset.NAME.pose=true), or filter.bayes.transport=point",
                stacklevel=2,
            )
        self.provides = labels

    def start(self) -> BayesState:
        """No frames."""
        return BayesState()

    def step(
        self,
        state: BayesState,
        frame: FrameResult,
        labels: PointLabels,
        points: Points,
        pose: Poses | None = None,
        boxes: Boxes | None = None,
    ) -> list[FrameResult]:
        """The frame `delay` frames ago, or none yet; after a gap all that were held back first."""
        if len(labels) != len(points):
            raise DataError(f"filter 'bayes': {len(labels)} points are labelled, the scan has {len(points)}")
        last = state.window[-1] if state.window else None
        finished: list[FrameResult] = []
        if last is not None and abs(frame.meta.time - last.time) > self.max_gap:
            finished = self.flush(state)
        matrix = _pose_matrix(pose, last)
        if self.transport == "point":
            self._add_past(state, frame.meta.time, labels, points)
        state.window = [*state.window, self._observe(state, frame, labels, points, matrix, boxes)][-self.window :]
        ready = state.window[: max(len(state.window) - self.delay, 0)]
        return finished + [self._emit(state, seen) for seen in ready if seen.result is not None]

    def flush(self, state: BayesState) -> list[FrameResult]:
        """The frames held back, and a window without frames."""
        finished = [self._emit(state, seen) for seen in state.window if seen.result is not None]
        state.window = []
        return finished

    def prior_log_odds(self, xyz: Tensor) -> Tensor:
        """l_0 (M,) of points (M, 3) in the sensor frame."""
        bias, distance, height = self.coefficients
        logits: Tensor = bias + distance * xyz.norm(dim=1).clamp(min=1e-3).log() + height * xyz[:, 2]
        return logits

    def _observe(
        self,
        state: BayesState,
        frame: FrameResult,
        labels: PointLabels,
        points: Points,
        pose: Tensor,
        boxes: Boxes | None,
    ) -> Observation:
        current = torch.ones_like(points.batch, dtype=torch.bool) if points.time is None else points.time >= 0
        xyz = points.xyz[current]
        prior = self.prior_log_odds(xyz)
        evidence = self._evidence(state, labels.probability[current], prior)
        velocity = _point_velocity(xyz, boxes) if self.motion_compensation else xyz.new_zeros(0, 2)
        return Observation(xyz, evidence, prior, velocity, pose, frame.meta.time, frame, labels, current)

    def _evidence(self, state: BayesState, probability: Tensor, prior: Tensor) -> Tensor:
        """logit(xi) - l_0 (M,); 0 for points without a prediction (all 0) or one that is not a number."""
        broken = probability.isnan().any(1)
        state.unknown += int(broken.sum())
        told = ~broken & (probability.sum(1) > 0)
        xi = probability[:, self.moving].clamp(_CERTAIN, 1 - _CERTAIN)
        return torch.where(told, torch.logit(xi) - prior, 0)

    def _add_past(self, state: BayesState, now: float, labels: PointLabels, points: Points) -> None:
        """What the network says now of the points of past scans, added to what it said of them before."""
        if points.time is None:
            return
        for time in torch.unique(points.time[points.time < 0]).tolist():
            rows = points.time == time
            for seen in state.window:
                if abs(seen.time - (now + time)) < 1e-3 and len(seen.xyz) == int(rows.sum()):
                    seen.evidence = seen.evidence + self._evidence(state, labels.probability[rows], seen.prior)

    def _emit(self, state: BayesState, seen: Observation) -> FrameResult:
        """The frame with fused probabilities; its prediction and input are let go."""
        result, labels = seen.result, seen.labels
        if result is None or labels is None:
            raise RuntimeError("a frame was given out twice")
        place = next(number for number, other in enumerate(state.window) if other is seen)
        total = seen.evidence
        for number, other in enumerate(state.window):
            if other is not seen and self.transport != "point":
                total = total + self.forgetting ** abs(place - number) * self._carry(other, seen)
        fused = torch.sigmoid(seen.prior + self.tempering * total)
        seen.result = seen.labels = None
        return result.with_prediction(labels, self._write(labels, seen.current, fused))

    def _write(self, labels: PointLabels, rows: Tensor, moving: Tensor) -> PointLabels:
        """The prediction with that probability of moving in some rows, the other classes sharing the rest."""
        old = labels.probability[rows].nan_to_num()
        others = old.clone()
        others[:, self.moving] = 0
        total = others.sum(1, keepdim=True)
        even = torch.ones_like(others)
        even[:, self.moving] = 0
        others = torch.where(total > 0, others / total.clamp(min=1e-12), even / max(old.shape[1] - 1, 1))
        new = others * (1 - moving[:, None])
        new[:, self.moving] = moving
        probability = labels.probability.clone()
        probability[rows] = new.to(probability)
        return labels.replace(probability=probability)

    def _carry(self, other: Observation, seen: Observation) -> Tensor:
        """Evidence (M,) of another frame at the points of this one, 0 where it has none."""
        xyz = other.xyz
        if len(other.velocity):
            xyz = xyz.clone()
            xyz[:, :2] += other.velocity * (seen.time - other.time)
        return self._warp(other, seen, xyz) if self.transport == "warp" else self._share_cells(other, seen, xyz)

    def _warp(self, other: Observation, seen: Observation, xyz: Tensor) -> Tensor:
        change = torch.linalg.inv(seen.pose) @ other.pose
        moved = (xyz.double() @ change[:3, :3].T + change[:3, 3]).to(xyz)
        image = range_project(Points.from_scan(moved, other.evidence[:, None]), self.view)
        reach = max(self.gate, self.max_speed * abs(seen.time - other.time))
        pixel = range_match(image, seen.xyz, reach, window=2 * self.search + 1)
        evidence = image.features[0, 1].flatten()
        return torch.where(pixel >= 0, evidence[pixel.clamp(min=0)], 0)

    def _share_cells(self, other: Observation, seen: Observation, xyz: Tensor) -> Tensor:
        cells, owner = torch.unique(self._cells(xyz, other.pose), return_inverse=True)
        if not len(cells):
            return torch.zeros_like(seen.evidence)
        total = torch.zeros(len(cells), device=xyz.device).index_add_(0, owner, other.evidence)
        mean = total / torch.bincount(owner, minlength=len(cells))
        wanted = self._cells(seen.xyz, seen.pose)
        place = torch.searchsorted(cells, wanted).clamp(max=len(cells) - 1)
        return torch.where(cells[place] == wanted, mean[place], 0)

    def _cells(self, xyz: Tensor, pose: Tensor) -> Tensor:
        """(M,) int64 number of the cell of the map that each point lies in."""
        cell = ((xyz.double() @ pose[:3, :3].T + pose[:3, 3]) / self.cell).floor().long() + _SHIFT
        return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]


def range_view(data: DataSpec) -> RangeView:
    """The view of the data's range image, that of an HDL-64 (64 x 2048 pixels, +3 to -25 degrees) where it has none."""
    views = [spec.geometry for spec in data.inputs.values() if spec.kind is RangeImage]
    return next((view for view in views if isinstance(view, RangeView)), _HDL64)


def _pose_matrix(pose: Poses | None, last: Observation | None) -> Tensor:
    """(4, 4) float64: the pose of the frame, the last one where it is not ok, the identity at the start."""
    if pose is not None and bool(pose.ok[0]):
        return pose.matrix[0].double()
    if last is not None:
        return last.pose
    return torch.eye(4, dtype=torch.float64) if pose is None else torch.eye(4).to(pose.matrix).double()


def _point_velocity(xyz: Tensor, boxes: Boxes | None) -> Tensor:
    """(M, 2) velocity of the box that each point lies in, 0 for none."""
    still = xyz.new_zeros(len(xyz), 2)
    if boxes is None or boxes.velocity is None or not len(boxes):
        return still
    owner = points_in_boxes(xyz, boxes.tensor)
    return torch.where((owner >= 0)[:, None], boxes.velocity[owner.clamp(min=0)].to(xyz), still)


def _check(window: int, prior: float, transport: str, delay: int, adaptive: tuple[float, ...]) -> None:
    if transport not in TRANSPORTS:
        raise ConfigError(f"filter.bayes.transport is {transport!r}.\n  there are: {', '.join(TRANSPORTS)}")
    if window < 1 or not 0 <= delay < window:
        raise ConfigError(
            f"filter.bayes: expected window >= 1 and 0 <= delay < window, found window {window}, delay {delay}"
        )
    if not 0 < prior < 1:
        raise ConfigError(f"filter.bayes.prior lies between 0 and 1, found {prior}")
    if len(adaptive) not in (0, 3):
        raise ConfigError(
            f"filter.bayes.adaptive takes three numbers (l_0 = a + b ln(range) + c z) or none, found {list(adaptive)}"
        )
