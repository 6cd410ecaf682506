"""Errors of estimated poses, and how often they are small enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from lidarfw.errors import ConfigError
from lidarfw.interfaces import Metric
from lidarfw.types import Poses, Spec, Targets


def pose_errors(estimate: Tensor, truth: Tensor) -> Tensor:
    """(B, 2) distance in metres and angle in degrees 0..180 between poses (B, 4, 4); float64.

    The angle of a rotation A^T B is 2 asin(|A - B| / sqrt 8) with the Frobenius norm, which stays exact near 0,
    where the arc cosine of the trace loses half of the digits.
    """
    estimate, truth = estimate.double(), truth.double()
    distance = (estimate[:, :3, 3] - truth[:, :3, 3]).norm(dim=1)
    chord = (estimate[:, :3, :3] - truth[:, :3, :3]).flatten(1).norm(dim=1)
    angle = 2 * torch.asin((chord / math.sqrt(8)).clamp(max=1))
    return torch.stack([distance, angle.rad2deg()], 1)


class PoseError(Metric):
    """Position error in metres and orientation error in degrees: mean and median, success rates, failures.

    A frame counts where its true pose is ok. Frames for which no pose was estimated (`Poses.ok` False, or numbers
    that are not finite) are failures: they are in no mean and median, but count as misses in every success rate.
    `thresholds` are pairs of metres and degrees; the usual ones are those of Sattler et al., "Benchmarking 6DOF
    outdoor visual localization in changing conditions", CVPR 2018.

    `compute` gives `position_mean`, `position_median` (m), `orientation_mean`, `orientation_median` (degrees),
    `success_{m}m_{degrees}deg` 0..1 of each pair, at or below both, `success`, the mean of those, `failures` 0..1 and
    `frames`, how many were counted. All are 0 without frames. Two numbers per frame are kept. Raises ConfigError for
    thresholds that are no pairs of positive numbers.
    """

    monitor: ClassVar[str] = "success"
    higher_is_better = True
    full_state_update = False
    errors: list[Tensor]  # (F, 2) metres, degrees; inf for failures

    def __init__(
        self, poses: Spec, *, thresholds: Sequence[Sequence[float]] = ((0.25, 2.0), (0.5, 5.0), (5.0, 10.0))
    ) -> None:
        super().__init__()
        if not thresholds or any(len(pair) != 2 or min(pair) <= 0 for pair in thresholds):
            raise ConfigError(
                f"metric.pose_error.thresholds must be pairs of metres and degrees above 0, got {thresholds}.\n"
                f"  fix: thresholds=[[0.25,2],[0.5,5]]"
            )
        self.thresholds = [(float(metres), float(degrees)) for metres, degrees in thresholds]
        self.add_state("errors", default=[], dist_reduce_fx="cat")
        self._start()

    def _start(self) -> None:
        # never an empty list: processes that saw no frame must take part in the exchange of the others
        self.errors.append(torch.zeros(0, 2, dtype=torch.float64, device=self.device))

    def reset(self) -> None:
        """Forget all frames."""
        super().reset()
        self._start()

    def update(self, poses: Poses, targets: Targets) -> None:
        """Count the poses of one frame, or of a batch of frames, in."""
        if targets.poses is None:
            return
        errors = pose_errors(poses.matrix, targets.poses.matrix)
        found = poses.ok & errors.isfinite().all(1)
        errors = torch.where(found[:, None], errors, torch.inf)
        self.errors.append(errors[targets.poses.ok].to(self.device))

    def compute(self) -> dict[str, Any]:
        """The figures, as floats."""
        # after an exchange between processes the state is one tensor instead of a list
        errors = torch.cat(self.errors) if isinstance(self.errors, list) else self.errors
        found = errors[errors.isfinite().all(1)]
        count = max(len(errors), 1)
        rates = {
            f"success_{metres:g}m_{degrees:g}deg": float((errors <= errors.new_tensor([metres, degrees])).all(1).sum())
            / count
            for metres, degrees in self.thresholds
        }
        return {
            **_middle("position", found[:, 0]),
            **_middle("orientation", found[:, 1]),
            **rates,
            "success": sum(rates.values()) / len(rates),
            "failures": (len(errors) - len(found)) / count,
            "frames": float(len(errors)),
        }


def _middle(name: str, errors: Tensor) -> dict[str, float]:
    if len(errors) == 0:
        return {f"{name}_mean": 0.0, f"{name}_median": 0.0}
    ordered = errors.sort().values
    median = (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
    return {f"{name}_mean": float(errors.mean()), f"{name}_median": float(median)}
