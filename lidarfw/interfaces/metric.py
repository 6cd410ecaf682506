"""The interface of metrics, apart from the others because torchmetrics takes as long to import as torch itself."""

from __future__ import annotations

from typing import Any, ClassVar

import torchmetrics


class Metric(torchmetrics.Metric):
    """Streaming figures: `update` takes predictions, targets and meta by the wiring rules; `compute` a dict of floats.

    `monitor` names the entry of `compute` that stands for the metric as a whole; higher is better.
    """

    monitor: ClassVar[str]
    example: ClassVar[dict[str, Any]] = {}  # options for the conformance kit
