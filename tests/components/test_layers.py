"""Batch normalisation that is ready for evaluation early."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from lidarfw.components.layers import BatchNorm1d, BatchNorm2d


def batches(number: int) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    return [3 + 0.01 * torch.randn(64, 4, generator=random) for _ in range(number)]


def test_running_statistics_fit_after_one_batch() -> None:
    norm = BatchNorm1d(4)
    (batch,) = batches(1)
    trained = norm(batch)
    torch.testing.assert_close(norm.eval()(batch), trained, atol=0.02, rtol=0)


def test_late_batches_weigh_a_hundredth() -> None:
    norm = BatchNorm1d(4)
    norm.num_batches_tracked.fill_(5000)
    norm.running_mean.fill_(1.0)
    norm(torch.full((8, 4), 3.0))
    torch.testing.assert_close(norm.running_mean, torch.full((4,), 1.02))


@pytest.mark.parametrize("kind", [BatchNorm1d, BatchNorm2d])
def test_a_loaded_norm_goes_on_where_the_other_stood(kind: type[nn.Module]) -> None:
    data = [batch if kind is BatchNorm1d else batch.view(4, 4, 4, 4) for batch in batches(30)]
    whole, first, second = kind(4), kind(4), kind(4)
    for number, batch in enumerate(data):
        whole(batch)
        if number < 20:
            first(batch)
            second(batch * 2)
    second.load_state_dict(first.state_dict())
    for batch in data[20:]:
        second(batch)
    assert all(a.equal(b) for a, b in zip(whole.state_dict().values(), second.state_dict().values()))
