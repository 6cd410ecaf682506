"""Statistics of batch normalisation for evaluation, of the weights as they are at the end of a training."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from lidarfw.model import PerceptionModel
from lidarfw.types import Batch


@torch.no_grad()
def settle_norms(model: PerceptionModel, batches: Iterable[Batch]) -> None:
    """Set the running statistics of every batch normalisation to the mean over these batches.

    During training they average over past batches, and so over past weights, with dropout; in a short training with
    small batches the network then differs much in evaluation. Wu and Johnson, "Rethinking Batch in BatchNorm", 2021,
    section 3 (PreciseBN). Every batch counts the same; gradients and weights are left alone, and so is what is frozen.
    """
    found: dict[_BatchNorm, list[tuple[Tensor, Tensor]]] = {
        module: []
        for module in model.modules()
        if isinstance(module, _BatchNorm)
        and module.track_running_stats
        and all(weight.requires_grad for weight in module.parameters())
    }
    handles = [norm.register_forward_pre_hook(_recorder(rows)) for norm, rows in found.items()]
    kept = {norm: {name: value.clone() for name, value in norm.named_buffers()} for norm in found}
    training = {module: module.training for module in model.modules()}
    model.eval()
    for norm in found:
        norm.train()
    try:
        for batch in batches:
            model(batch)
    finally:
        for handle in handles:
            handle.remove()
        for module, mode in training.items():
            module.training = mode
        for norm, rows in found.items():
            _write(norm, rows, kept[norm])


def _recorder(rows: list[tuple[Tensor, Tensor]]) -> Callable[[nn.Module, tuple[Tensor, ...]], None]:
    def record(module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        values = inputs[0].detach().float()
        axes = [axis for axis in range(values.dim()) if axis != 1]
        if values.numel() > values.shape[1]:
            variance, mean = torch.var_mean(values, axes)
            rows.append((mean, variance))

    return record


def _write(norm: _BatchNorm, rows: list[tuple[Tensor, Tensor]], kept: dict[str, Tensor]) -> None:
    for name, value in norm.named_buffers():
        value.copy_(kept[name])
    if rows and norm.running_mean is not None and norm.running_var is not None:
        norm.running_mean.copy_(torch.stack([mean for mean, _ in rows]).mean(0))
        norm.running_var.copy_(torch.stack([variance for _, variance in rows]).mean(0))
