"""Models for inference: blocks that were spread out for training become the single layers that they amount to."""

from __future__ import annotations

from copy import deepcopy
from typing import Protocol, TypeVar, runtime_checkable

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lidarfw.ops import fuse

M = TypeVar("M", bound=nn.Module)


@runtime_checkable
class Mergeable(Protocol):
    """A block that equals a simpler one in evaluation (structural reparametrisation: branches that add up, say)."""

    def merged(self) -> nn.Module:
        """The simpler module, with weights of its own, in eval mode."""
        ...


def merge(model: M) -> M:
    """A copy for inference with fewer and larger operations and the same results up to rounding.

    Every block with a method `merged` is replaced by what that gives; within each `nn.Sequential` a batch
    normalisation directly after a convolution becomes part of it, sparse convolutions included (`lidarfw.ops.fuse`).
    The copy is in eval mode and must stay in it. A checkpoint is of the model as it was trained: merge after loading.
    Weights are multiplied out in float64 and rounded once.
    """
    kind = next((weight.dtype for weight in model.parameters()), torch.float32)
    precise = fuse(deepcopy(model).double())
    precise = precise.merged() if isinstance(precise, Mergeable) else precise
    _replace_blocks(precise)
    for sequence in [module for module in precise.modules() if isinstance(module, nn.Sequential)]:
        _fold_norms(sequence)
    return precise.to(kind)  # type: ignore[return-value]


def _replace_blocks(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, Mergeable):
            setattr(module, name, child.merged())
        else:
            _replace_blocks(child)


def _fold_norms(sequence: nn.Sequential) -> None:
    conv: tuple[str, nn.Conv2d] | None = None
    for name, layer in list(sequence.named_children()):
        if conv is not None and isinstance(layer, nn.BatchNorm2d) and layer.running_mean is not None:
            setattr(sequence, conv[0], fuse_conv_bn_eval(conv[1], layer))
            delattr(sequence, name)
        conv = (name, layer) if isinstance(layer, nn.Conv2d) else None
