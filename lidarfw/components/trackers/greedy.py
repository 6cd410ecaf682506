"""Tracking by nearest centres: no training, any detector."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lidarfw.components.matching import greedy_match
from lidarfw.components.per_class import per_class
from lidarfw.interfaces import Tracker
from lidarfw.types import Boxes, FrameResult, Poses, Spec, Tracks


@dataclass
class GreedyState:
    """The T tracks alive, in the tracking frame: the map where poses are given, else the sensor."""

    center: Tensor  # (T, 2) float64 x, y in metres, where last seen
    velocity: Tensor  # (T, 2) float64 m/s
    unseen: Tensor  # (T,) float64 seconds since last seen
    missed: Tensor  # (T,) int64 frames since last seen
    label: Tensor  # (T,) int64
    id: Tensor  # (T,) int64
    pose: Tensor  # (4, 4) float64 sensor to tracking frame, of the last frame that had one
    time: float | None = None  # seconds, of the last frame
    next_id: int = 1


class GreedyTracker(Tracker):
    """Give each detection the identity of the nearest track (CenterPoint, Yin et al., CVPR 2021, section 4).

    Tracks are moved on to the time of the frame, with the velocity of their last detection where the detector gives
    one, else with their last displacement. Detections choose by falling score, each the nearest free track of its
    class within `max_distance` metres (by class name; `default_distance` for the others). A detection without a
    track starts one; a track unseen for more than `max_age` frames ends. Ids start at 1.

    With a `pose` input the tracker works in the map frame, so that the motion of the sensor does not matter; a frame
    whose pose is not ok uses the last one. Time comes from `FrameMeta.time`; where it does not grow, `frame_time`
    seconds have passed. Raises ConfigError for a class that the data does not have.
    """

    def __init__(
        self,
        boxes: Spec,
        *,
        max_distance: dict[str, float] | None = None,
        default_distance: float = 2.0,
        max_age: int = 3,
        frame_time: float = 0.1,
    ) -> None:
        super().__init__()
        values = per_class(boxes.classes, max_distance, default_distance, "max_distance")
        self.register_buffer("max_distance", torch.tensor(values), persistent=False)
        self.max_age, self.frame_time = max_age, frame_time
        self.provides = Spec(Tracks, classes=boxes.classes)

    max_distance: Tensor

    def start(self) -> GreedyState:
        """No tracks."""
        device = self.max_distance.device
        place, number = (torch.zeros(0, dtype=kind, device=device) for kind in (torch.float64, torch.long))
        pose = torch.eye(4, dtype=torch.float64, device=device)
        return GreedyState(place.view(0, 2), place.view(0, 2), place, number, number, number, pose)

    def step(
        self, state: GreedyState, frame: FrameResult, boxes: Boxes, pose: Poses | None = None
    ) -> list[FrameResult]:
        """The frame with its tracks: every detection, in the order given, and its id."""
        passed = 0.0 if state.time is None else frame.meta.time - state.time
        state.time = frame.meta.time
        state.unseen = state.unseen + (passed if passed > 0 else self.frame_time)
        if pose is not None and bool(pose.ok[0]):
            state.pose = pose.matrix[0].to(state.pose)
        center = (boxes.center.to(state.pose) @ state.pose[:3, :3].T + state.pose[:3, 3])[:, :2]
        track = self._match(state, boxes, center)
        ids = self._update(state, boxes, center, track)
        return [replace(frame, tracks=Tracks(boxes, ids))]

    def _match(self, state: GreedyState, boxes: Boxes, center: Tensor) -> Tensor:
        """Track of each detection, -1 for none."""
        order = boxes.score.argsort(descending=True, stable=True)
        distance = torch.cdist(center, state.center + state.velocity * state.unseen[:, None])
        allowed = (boxes.label[:, None] == state.label) & (distance <= self.max_distance[boxes.label, None])
        chosen = greedy_match(torch.where(allowed, -distance, -torch.inf)[order])
        return torch.empty_like(chosen).index_copy_(0, order, chosen)

    def _update(self, state: GreedyState, boxes: Boxes, center: Tensor, track: Tensor) -> Tensor:
        """Move, start and end tracks; the id of each detection."""
        new, known = track < 0, track[track >= 0]
        velocity, ids = torch.zeros_like(center), torch.empty_like(track)
        velocity[~new] = (center[~new] - state.center[known]) / state.unseen[known, None]
        if boxes.velocity is not None:
            velocity = boxes.velocity.nan_to_num().to(state.pose) @ state.pose[:2, :2].T
        ids[~new] = state.id[known]
        ids[new] = torch.arange(int(new.sum()), device=ids.device) + state.next_id
        lost = state.missed < self.max_age
        lost[known] = False
        state.next_id += int(new.sum())
        state.center = torch.cat([state.center[lost], center])
        state.velocity = torch.cat([state.velocity[lost], velocity])
        state.unseen = torch.cat([state.unseen[lost], torch.zeros_like(center[:, 0])])
        state.missed = torch.cat([state.missed[lost] + 1, torch.zeros_like(ids)])
        state.label = torch.cat([state.label[lost], boxes.label])
        state.id = torch.cat([state.id[lost], ids])
        return ids
