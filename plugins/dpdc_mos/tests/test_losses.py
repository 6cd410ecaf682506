"""The edge-aware loss and its distance maps (golden values by NumPy)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import PointLabels, Spec
from torch import Tensor

from lidarfw_dpdc_mos.distance import distance_maps, signed_distance
from lidarfw_dpdc_mos.losses import (
    EdgeAwareLoss,
    edge_aware_terms,
    edge_integral,
    lovasz_softmax,
    weighted_cross_entropy,
)

CLASSES = Spec(PointLabels, classes=("static", "moving"))


def two(moving: list[float]) -> Tensor:
    s = torch.tensor(moving, dtype=torch.float64)
    return torch.stack([1 - s, s], 1)


def test_signed_distance_of_a_rectangle() -> None:
    mask = np.zeros((5, 7), bool)
    mask[1:4, 2:5] = True
    phi = signed_distance(mask)
    assert phi[0] == pytest.approx([5**0.5, 2**0.5, 1, 1, 1, 2**0.5, 5**0.5])
    assert phi[2] == pytest.approx([2, 1, 0, -1, 0, 1, 2])
    g = torch.from_numpy(mask).float()[None, None]
    distance, valid = torch.from_numpy(phi)[None, None], torch.ones(1, 5, 7, dtype=torch.bool)
    for s, expected in ((g, -0.0285714), (g * 0 + 1, 1.0743179), (g * 0, 0), (g * 0 + 0.5, 0.5371589)):
        assert float(edge_integral(s, distance, valid, limit=0)) == pytest.approx(expected, abs=1e-6)
    assert float(edge_integral(g.roll(1, -1), distance, valid, limit=0)) == pytest.approx(0.0571429, abs=1e-6)


def test_signed_distance_goes_round() -> None:
    mask = np.zeros((3, 8), bool)
    mask[1, 0] = True
    assert signed_distance(mask, wrap=True)[1].tolist() == [0, 1, 2, 3, 4, 3, 2, 1]
    assert signed_distance(mask)[1].tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert signed_distance(mask, (0.5, 0.25), wrap=True)[0].tolist() == pytest.approx(
        [0.5, 0.5590170, 0.7071068, 0.9013878, 1.1180340, 0.9013878, 0.7071068, 0.5590170]
    )


def test_masks_without_an_edge() -> None:
    for mask in (np.zeros((4, 6), bool), np.ones((4, 6), bool)):
        assert not signed_distance(mask, wrap=True).any()
    assert distance_maps(torch.full((2, 4, 6), -1), 2).abs().max() == 0
    assert distance_maps(torch.zeros(2, 4, 6, dtype=torch.long), 3).shape == (2, 3, 4, 6)


def test_the_whole_loss_on_one_row() -> None:
    s, g = [0.1, 0.8, 0.6, 0.4, 0.2], torch.tensor([0, 1, 1, 0, 0])
    p, weight = two(s), torch.tensor([1 / 0.6, 1 / 0.4], dtype=torch.float64)
    assert float(weighted_cross_entropy(p, g, weight)) == pytest.approx(0.3233806, abs=1e-6)
    assert float(lovasz_softmax(p, g)) == pytest.approx(0.3066667, abs=1e-6)
    distance = distance_maps(g.view(1, 1, 5), 2, wrap=False)
    assert distance.flatten().tolist() == [1, 0, 0, 1, 2]
    logits = p.log().T.reshape(1, 2, 1, 5)
    for alpha, raw, normalised in ((0.02, 0.6210463, 0.6176263), (0.515, 0.3982729, 0.3102079)):
        for limit, expected in ((0.0, raw), (20.0, normalised)):
            terms = edge_aware_terms(logits, g.view(1, 1, 5), distance, alpha, weight, limit)
            assert float(sum(terms.values())) == pytest.approx(expected, abs=1e-6)
            assert float(terms["edge"]) == pytest.approx(alpha * (0.18 if limit == 0 else 0.009), abs=1e-6)


def test_lovasz() -> None:
    p, y = two([0.9, 0.6, 0.4, 0.2, 0.1]), torch.tensor([1, 1, 1, 0, 0])
    assert float(lovasz_softmax(p, y)) == pytest.approx(0.358333, abs=1e-6)
    assert float(lovasz_softmax(p, y * 0)) == pytest.approx(0.44, abs=1e-6)
    assert float(lovasz_softmax(p[:1], y[:1])) == pytest.approx(0.1, abs=1e-6)
    assert float(lovasz_softmax(p[:0], y[:0])) == 0


def test_alpha_of_the_paper() -> None:
    loss = EdgeAwareLoss(CLASSES)
    for epoch, expected in ((0, 0.02), (10, 0.07), (50, 0.27), (96, 0.50), (99, 0.515)):
        for done in (1 / 200, 0.5, 1.0):  # first, a middle and the last step of the epoch
            assert loss.alpha_at((epoch + done) / 100) == pytest.approx(expected)
    even = EdgeAwareLoss(CLASSES, alpha_steps=0)
    assert [even.alpha_at(p) for p in (0.0, 0.5, 1.0)] == pytest.approx([0.02, 0.2675, 0.515])


def test_class_weights() -> None:
    loss = EdgeAwareLoss(CLASSES, frequency={"static": 0.97844, "moving": 0.0023734})
    assert loss.weight.tolist() == pytest.approx([1.0210, 296.437], rel=1e-4)
    assert EdgeAwareLoss(CLASSES, frequency={"moving": 0.0}).weight[1] == 0
    with pytest.raises(ConfigError, match="names the class 'move'"):
        EdgeAwareLoss(CLASSES, frequency={"move": 0.1})
    with pytest.raises(ConfigError, match="alpha"):
        EdgeAwareLoss(CLASSES, alpha_end=1.5)


def labels(kind: str) -> Tensor:
    label = torch.zeros(1, 4, 8, dtype=torch.long)
    if kind == "all moving":
        label += 1
    elif kind in ("empty", "one pixel"):
        label -= 1
        label[0, 1, 1] = 1 if kind == "one pixel" else -1
    return label


@pytest.mark.parametrize("scale", [1.0, 1e4])
@pytest.mark.parametrize("kind", ["empty", "all static", "all moving", "one pixel"])
def test_finite_on_almost_nothing(kind: str, scale: float) -> None:
    logits = (scale * torch.randn(1, 2, 4, 8, generator=torch.Generator().manual_seed(0))).requires_grad_()
    label = labels(kind)
    terms = edge_aware_terms(logits, label, distance_maps(label, 2), 0.3, torch.tensor([1.0, 300.0]))
    assert all(bool(term.isfinite()) for term in terms.values())
    sum(terms.values()).backward()  # type: ignore[union-attr]
    assert logits.grad is not None
    assert bool(logits.grad.isfinite().all())
    if kind == "empty":
        assert [float(term) for term in terms.values()] == [0, 0, 0]


def test_the_edge_term_pulls_a_mask_inwards_on_a_birds_eye_view() -> None:
    """Any mask will do: a square on a plain map, whose columns do not go round, learned by the edge term alone."""
    label = torch.zeros(1, 24, 24, dtype=torch.long)
    label[0, 8:16, 8:16] = 1
    distance = distance_maps(label, 2, wrap=False)
    logits = torch.zeros(1, 2, 24, 24, requires_grad=True)
    optimizer = torch.optim.Adam([logits], 0.5)
    for _ in range(60):
        optimizer.zero_grad()
        edge_aware_terms(logits, label, distance, 1.0)["edge"].backward()
        optimizer.step()
    found = logits.softmax(1)[0, 1] > 0.5
    inner, outer = label[0].clone(), label[0].clone()
    inner[8:16, [8, 15]] = inner[[8, 15], 8:16] = 0  # the edge itself, where phi = 0, may fall on either side
    assert bool(found[inner == 1].all())
    assert not bool(found[outer == 0].any())
