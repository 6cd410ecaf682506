"""The interfaces: eight of the model (Backbone ... Tracker), and Dataset, Transform, Metric."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarfw._lazy import lazy_attributes
from lidarfw.interfaces.data import Dataset, Transform

if TYPE_CHECKING:
    from lidarfw.interfaces.metric import Metric
    from lidarfw.interfaces.model import (
        Backbone,
        Component,
        Filter,
        Head,
        Loss,
        Neck,
        PostProcessor,
        Retriever,
        Tracker,
    )

_MODEL = ["Backbone", "Component", "Filter", "Head", "Loss", "Neck", "PostProcessor", "Retriever", "Tracker"]
__getattr__ = lazy_attributes(
    __name__, dict.fromkeys(_MODEL, "lidarfw.interfaces.model") | {"Metric": "lidarfw.interfaces.metric"}
)

SLOTS: dict[str, str] = {
    "dataset": "Dataset",
    "transform": "Transform",
    "backbone": "Backbone",
    "neck": "Neck",
    "head": "Head",
    "loss": "Loss",
    "postprocessor": "PostProcessor",
    "filter": "Filter",
    "tracker": "Tracker",
    "retriever": "Retriever",
    "metric": "Metric",
}  # slot -> interface, in the order in which the assembly visits them

__all__ = [
    "SLOTS", "Backbone", "Component", "Dataset", "Filter", "Head", "Loss", "Metric", "Neck", "PostProcessor",
    "Retriever", "Tracker", "Transform",
]  # fmt: skip
