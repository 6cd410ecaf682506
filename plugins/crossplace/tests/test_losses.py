"""Truncated smooth average precision against numbers worked out by hand, and what the losses do on odd batches."""

from __future__ import annotations

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Poses, Targets
from torch import Tensor

from lidarfw_crossplace.heads import PlaceOutput
from lidarfw_crossplace.losses import InfoNCELoss, TripletLoss, TSAPLoss, neighbours, smooth_average_precision

LOSSES = (TSAPLoss(), TripletLoss(), InfoNCELoss())


def at(*places: float) -> Targets:
    matrix = torch.eye(4).repeat(len(places), 1, 1)
    matrix[:, 0, 3] = torch.tensor(places)
    return Targets(poses=Poses(matrix, torch.ones(len(places), dtype=torch.bool), torch.ones(len(places))))


def output(vector: Tensor) -> PlaceOutput:
    return PlaceOutput(vector, ("lidar",) * len(vector))


def value(loss: torch.nn.Module, vector: Tensor, targets: Targets) -> Tensor:
    (term,) = loss(output(vector), targets).values()
    return term  # type: ignore[no-any-return]


def one_query(positives: list[float], negatives: list[float], **options: object) -> float:
    distance = torch.tensor([[*positives, *negatives]], dtype=torch.float64)
    positive = torch.arange(distance.shape[1])[None] < len(positives)
    precision, _ = smooth_average_precision(distance, positive, ~positive, **options)  # type: ignore[arg-type]
    return float(1 - precision)


@pytest.mark.parametrize(("tau", "expected"), [(0.01, 0.1666843), (0.1, 0.2400002)])
def test_one_query_with_two_positives_and_two_negatives(tau: float, expected: float) -> None:
    assert one_query([0.30, 0.50], [0.40, 0.90], tau=tau) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("numerator", "expected"), [("topk", 0.2864475), ("all", 0.2235691)])
def test_numerator_counts_the_chosen_or_all_positives(numerator: str, expected: float) -> None:
    found = one_query([0.30, 0.50, 0.60], [0.40, 0.90], tau=0.1, k=2, numerator=numerator)
    assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("tau", "expected"),
    [(0.01, (1, 0.5016788, 0.5000001, 1)), (0.1, (0.9486597, 0.6095905, 0.5163216, 0.9386040))],
)
def test_matrix_of_four(tau: float, expected: tuple[float, ...]) -> None:
    rows = [[0, 0.2, 0.5, 0.7], [0.2, 0, 0.15, 0.6], [0.5, 0.15, 0, 0.3], [0.7, 0.6, 0.3, 0]]
    distance = torch.tensor(rows, dtype=torch.float64)
    positive = torch.zeros(4, 4, dtype=torch.bool)
    positive[[0, 1, 2, 3], [1, 0, 3, 2]] = True
    negative = ~positive & ~torch.eye(4, dtype=torch.bool)
    precision, asked = smooth_average_precision(distance, positive, negative, tau=tau)
    assert precision.tolist() == pytest.approx(expected, abs=1e-6)
    assert asked.all()


def test_what_is_neither_positive_nor_negative_does_not_count() -> None:
    vector = torch.nn.functional.normalize(torch.tensor([[1.0, 0], [1, 0.4], [1, 0.1]]), dim=1)
    near, between = at(0, 5, 30), at(0, 5, 100)
    assert float(value(TSAPLoss(), vector, near)) < 1e-6
    assert float(value(TSAPLoss(), vector, between)) > 0.4  # the third, now a negative, is nearer than the positive


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
@pytest.mark.parametrize(
    ("vector", "places"),
    [
        (torch.eye(3), (0, 100, 200)),  # no positives
        (torch.eye(3)[:1], (0,)),  # one sample
        (torch.eye(3)[:1].repeat(4, 1), (0, 5, 100, 105)),  # all alike
        (torch.eye(3)[:2], (0, 5)),  # no negatives
        (torch.zeros(4, 3), (0, 5, 100, 105)),
    ],
    ids=["no positives", "one sample", "identical", "no negatives", "zero"],
)
def test_odd_batches_are_finite(loss: torch.nn.Module, vector: Tensor, places: tuple[float, ...]) -> None:
    vector = vector.clone().requires_grad_()
    term = value(loss, vector, at(*places))
    term.backward()
    assert torch.isfinite(term)
    assert vector.grad is not None
    assert torch.isfinite(vector.grad).all()
    if len(set(places)) in (1, 3):
        assert float(term.detach()) == 0


@pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: type(loss).__name__)
def test_descriptors_learn_places(loss: torch.nn.Module) -> None:
    torch.manual_seed(0)
    targets = at(*(100.0 * (i // 4) + i % 4 for i in range(16)))
    free = torch.randn(16, 8, requires_grad=True)
    optimizer = torch.optim.Adam([free], lr=0.05)
    for _ in range(150):
        optimizer.zero_grad()
        value(loss, torch.nn.functional.normalize(free, dim=1), targets).backward()
        optimizer.step()
    vector = torch.nn.functional.normalize(free.detach(), dim=1)
    nearest = (torch.cdist(vector, vector) + 9 * torch.eye(16)).argmin(1)
    assert (nearest // 4 == torch.arange(16) // 4).all()


def test_large_batches_measure_distances_as_small_ones_do() -> None:
    torch.manual_seed(0)
    vector = torch.nn.functional.normalize(torch.randn(65, 8, dtype=torch.float64), dim=1)
    targets = at(*(60.0 * (i // 3) for i in range(65)))
    masks = neighbours(output(vector), targets, 10, 50)
    whole = smooth_average_precision(torch.cdist(vector, vector), *masks)[0].mean()
    assert float(1 - whole) == pytest.approx(float(value(TSAPLoss(), vector, targets)), abs=1e-5)


def test_wrong_options_are_named() -> None:
    with pytest.raises(ConfigError, match="positive 20"):
        TSAPLoss(positive=20, negative=10)
    with pytest.raises(ConfigError, match="topk or all"):
        TSAPLoss(numerator="some")
