"""The eight interfaces of the model side.

The parameters of `forward` (of `step` for Filter and Tracker, `update` for Metric) say what a component
needs; `__init__` gets their Specs under the same names, positionally, and its keyword-only arguments are the
config; `self.provides` says what comes out. Three parameter names are special: `targets: Targets` and
`meta: list[FrameMeta]` come from the batch, and a loss may ask for `progress: float`, the share of the training that
is done (0..1). `__init__` may also ask for `data: DataSpec`.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, TypeAlias

from torch import Tensor, nn

from lidarfw.types import Descriptors, FrameResult, Matches, Poses, Spec

Provides: TypeAlias = "Spec | list[Spec] | tuple[Spec | list[Spec], ...]"


class Component(nn.Module):
    """Base of all components that live in the model."""

    provides: Provides
    example: ClassVar[dict[str, Any]] = {}  # options for the conformance kit: required ones, sizes fit for a test


class Backbone(Component):
    """Sensor data -> features. Rasterises inside with `lidarfw.ops`, so it owns the Grid.

    `provides` mirrors what `forward` returns: a Spec, a list (several strides), or a tuple of those (several kinds).
    """


class Neck(Component):
    """Features -> features; any change of representation is a neck."""


class Head(Component):
    """Features -> raw output for the loss; `decode` -> prediction.

    `forward` returns an output dataclass of the head's own, `decode(output)` a prediction type. The annotation
    of `decode` tells the assembly what the head predicts. `provides` is the Spec of the prediction.
    A head whose raw output has an attribute `tap` (the feature map that its regressors read) says its Spec in
    `self.tap`, for losses that ask for `Tap(kind)`.
    """

    defaults: ClassVar[dict[str, list[str]]] = {}  # names of its usual loss / postprocessor / metric
    tap: Spec

    @abstractmethod
    def decode(self, output: Any) -> Any:
        """The prediction, from the raw output of `forward`."""


class Loss(Component):
    """Outputs (of one or more heads), features, targets -> named terms.

    Weight and ramp belong to every loss and are applied by the model. Terms are finite and attached to the graph
    also for samples without targets.
    """

    @abstractmethod
    def forward(self, *args: Any, **kwargs: Any) -> dict[str, Tensor]: ...


class PostProcessor(Component):
    """Prediction -> prediction: NMS, box voting, RANSAC pose, label clean-up."""


class Filter(Component):
    """Drops, weights or fuses results of a stream of frames; single-frame filters only write `step`.

    The state is explicit: a dataclass (or dict) of tensors and numbers that can be saved. One filter serves many
    streams. Further parameters of `step` after `frame` are wired like those of `forward`.
    """

    def start(self) -> Any:
        """The state at the begin of a sequence. Default: None."""
        return None

    @abstractmethod
    def step(self, state: Any, frame: FrameResult, *args: Any, **kwargs: Any) -> list[FrameResult]:
        """Take the next frame in, give the frames that are finished (none, one or several). May change `state`."""

    def flush(self, state: Any) -> list[FrameResult]:
        """The frames still held back, at the end of a sequence. Default: none."""
        return []


class Tracker(Filter):
    """A filter that sets `frame.tracks`. May also have a trainable `forward` with its own loss."""


class Retriever(Component):
    """Descriptors <-> index of a map."""

    @abstractmethod
    def build(self, descriptors: Descriptors, poses: Poses) -> Any:
        """The index of a map; an `lidarfw.retrieval.Index`, which saves and loads itself as .npz."""

    @abstractmethod
    def query(self, index: Any, descriptors: Descriptors, k: int) -> Matches:
        """The k nearest map entries of each descriptor."""
