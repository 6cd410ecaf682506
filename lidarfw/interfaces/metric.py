"""The interface of metrics, apart from the others because torchmetrics takes as long to import as torch itself."""

from __future__ import annotations

from typing import Any, ClassVar

import torchmetrics

from lidarfw.types import FrameMeta


class Metric(torchmetrics.Metric):
    """Streaming figures: `update` takes predictions, targets and meta by the wiring rules; `compute` a dict of floats.

    `monitor` names the entry of `compute` that stands for the metric as a whole; higher is better. States are sums or
    lists of rows (`dist_reduce_fx` "sum" or "cat"), so that those of several processes, or of some frames only
    (`lidarfw eval --frames`), can be put together.
    """

    full_state_update = False
    monitor: ClassVar[str]
    example: ClassVar[dict[str, Any]] = {}  # options for the conformance kit

    def is_reference(self, frame: FrameMeta) -> bool:
        """Whether other frames are compared with this one, as queries with a map. Every bootstrap sample holds it."""
        return False
