"""Say that a pose cannot be trusted."""

from __future__ import annotations

from typing import Any

from lidarfw.interfaces import Filter
from lidarfw.types import FrameResult, Poses, Spec


class InlierGate(Filter):
    """Mark poses whose confidence (the share of inliers) is below `confidence` as not ok."""

    def __init__(self, poses: Spec, *, confidence: float = 0.1) -> None:
        super().__init__()
        self.confidence = confidence
        self.provides = poses

    def step(self, state: Any, frame: FrameResult, poses: Poses) -> list[FrameResult]:
        """The frame, its pose marked."""
        ok = poses.ok & (poses.confidence >= self.confidence)
        return [frame.with_prediction(poses, poses.replace(ok=ok))]
