"""The learning rate of the paper's training."""

from __future__ import annotations

import math

from torch import Tensor
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler


class WarmupRestarts(LRScheduler):
    """Linear warm-up to the full rate, then cosines to 0 with warm restarts (Remote Sensing 2025, 17(2), 195, 4.1.1).

    Loshchilov and Hutter, "SGDR", ICLR 2017, equation 5. Epoch e of the warm-up has (e + 1) / warmup of the rate;
    after it, every `cycle` epochs begin anew at the full rate.
    """

    def __init__(self, optimizer: Optimizer, *, warmup: int = 10, cycle: int = 30, last_epoch: int = -1) -> None:
        if warmup < 0 or cycle < 1:
            raise ValueError(f"expected warmup >= 0 and cycle >= 1, found {warmup} and {cycle}")
        self.warmup, self.cycle = warmup, cycle
        super().__init__(optimizer, last_epoch)

    def factor(self, epoch: int) -> float:
        """Share of the full rate in an epoch, from 0."""
        if epoch < self.warmup:
            return (epoch + 1) / self.warmup
        return (1 + math.cos(math.pi * ((epoch - self.warmup) % self.cycle) / self.cycle)) / 2

    def get_lr(self) -> list[float | Tensor]:
        """Rates of the groups in the current epoch."""
        return [float(rate) * self.factor(self.last_epoch) for rate in self.base_lrs]
