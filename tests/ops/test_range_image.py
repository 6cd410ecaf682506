"""Range projection, residuals and the label vote against loops over points."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings

from lidarfw.ops import range_knn, range_knn_mean, range_match, range_project, residual_images
from lidarfw.types import Points, RangeView

VIEW = RangeView(8, 32, math.radians(20), math.radians(-25))


def cloud(count: int, batch_size: int, seed: int) -> Points:
    random = torch.Generator().manual_seed(seed)
    xyz = torch.randn(count, 3, generator=random) * torch.tensor([10.0, 10.0, 2.0])
    batch = torch.randint(batch_size, (count,), generator=random)
    return Points(xyz, torch.rand(count, 2, generator=random), batch, batch_size)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 300), st.integers(1, 3), st.integers(0, 10**6))
def test_projection_keeps_the_nearest_point(count: int, batch_size: int, seed: int) -> None:
    points = cloud(count, batch_size, seed)
    points = Points.cat([points, points]).replace(batch_size=batch_size)  # equally near points: the first wins
    image = range_project(points, VIEW)
    row, column, distance, inside = VIEW.project(points.xyz)
    best: dict[int, int] = {}
    for number in range(len(points)):
        pixel = int((points.batch[number] * VIEW.height + row[number]) * VIEW.width + column[number])
        assert image.pixel[number] == (pixel if inside[number] else -1)
        if inside[number] and (pixel not in best or distance[number] < distance[best[pixel]]):
            best[pixel] = number
    assert image.mask.sum() == len(best)
    features, xyz = image.features.permute(0, 2, 3, 1).reshape(-1, 3), image.xyz.permute(0, 2, 3, 1).reshape(-1, 3)
    for pixel, number in best.items():
        assert image.mask.flatten()[pixel]
        assert torch.equal(xyz[pixel], points.xyz[number])
        assert torch.equal(features[pixel, 1:], points.features[number])
        torch.testing.assert_close(features[pixel, 0], distance[number])
    assert features[~image.mask.flatten()].abs().sum() == 0


def test_projection_passes_gradients_to_features() -> None:
    points = cloud(60, 2, 0)
    features = points.features.double().requires_grad_()
    points = points.replace(xyz=points.xyz.double())
    assert torch.autograd.gradcheck(lambda f: range_project(points.replace(features=f), VIEW).features, features)


def test_residuals_compare_ranges_pixel_by_pixel() -> None:
    now = Points(torch.tensor([[10.0, 0.1, 0], [0.1, 20, 0]]), torch.zeros(2, 0), torch.zeros(2, dtype=torch.long))
    past = now.replace(xyz=torch.tensor([[8.0, 0.08, 0], [0.1, -20, 0]]))
    image = range_project(now, VIEW)
    residual = residual_images(image, [past, now])
    assert residual.shape == (1, 2, 8, 32)
    pixel = image.pixel[0]
    assert residual[0, 0].flatten()[pixel].item() == pytest.approx(0.2, abs=1e-5)
    residual[0, 0].view(-1)[pixel] = 0
    assert residual.abs().max() < 1e-6


def vote(image, labels, distance, window=5, neighbors=5, cutoff=1.0, sigma=1.0) -> list[int]:
    """The vote point by point, straight from the paper's description."""
    margin, (_, height, width) = window // 2, labels.shape
    offset = np.arange(window) - margin
    bell = np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * sigma**2))
    weight = 1 - bell / bell.sum()
    ranges, found = image.xyz.norm(dim=1), []
    for pixel, own in zip(image.pixel.tolist(), distance.tolist(), strict=True):
        if pixel < 0:
            found.append(-1)
            continue
        b, row, column = pixel // (height * width), pixel // width % height, pixel % width
        near = []
        for dy in range(-margin, margin + 1):
            for dx in range(-margin, margin + 1):
                y, x = row + dy, (column + dx) % width
                if 0 <= y < height and image.mask[b, y, x]:
                    apart = abs(float(ranges[b, y, x]) - own) * weight[dy + margin, dx + margin]
                    near.append((0.0 if dy == dx == 0 else apart, int(labels[b, y, x])))
        votes = [label for apart, label in sorted(near, key=lambda n: n[0])[:neighbors] if apart <= cutoff]
        found.append(min(set(votes), key=lambda label: (-votes.count(label), label)))
    return found


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 250), st.integers(1, 2), st.integers(0, 10**6), st.sampled_from([(3, 3), (5, 5), (5, 1), (7, 9)]))
def test_label_vote_equals_a_loop(count: int, batch_size: int, seed: int, window: tuple[int, int]) -> None:
    points = cloud(count, batch_size, seed)
    image = range_project(points, VIEW)
    labels = torch.randint(3, image.mask.shape, generator=torch.Generator().manual_seed(seed))
    distance = points.xyz.norm(dim=1)
    ours = range_knn(image, labels, distance, window=window[0], neighbors=window[1], cutoff=2.0)
    assert ours.tolist() == vote(image, labels, distance, window[0], window[1], 2.0)


def test_an_even_window_is_refused() -> None:
    image = range_project(cloud(10, 1, 0), VIEW)
    with pytest.raises(ValueError, match="window must be odd"):
        range_knn(image, torch.zeros(1, 8, 32, dtype=torch.long), torch.zeros(10), window=4)


@pytest.mark.parametrize("signed", [False, True])
def test_residuals_between_ranges_only(signed: bool) -> None:
    now = torch.tensor([[10.0, 0.1, 0], [0.1, 20, 0], [-3, 0.1, 0], [0.1, -60, 0]])
    image = range_project(Points.from_scan(now, now[:, :0]), VIEW)
    past = Points.from_scan(now * torch.tensor([[0.8], [1.1], [0.5], [0.9]]), now[:, :0])
    residual = residual_images(image, [past], nearest=2.0, farthest=50.0, signed=signed)[0, 0].flatten()
    sign = -1 if signed else 1
    assert residual[image.pixel].tolist() == pytest.approx([sign * 0.2, 0.1, 0, 0], abs=1e-4)


def test_residuals_against_the_nearest_range_around_a_pixel() -> None:
    rows, columns = torch.meshgrid(torch.arange(8), torch.arange(32), indexing="ij")
    ahead = VIEW.direction(rows.flatten(), columns.flatten())
    now, before = (torch.full((8, 32), 10.0) for _ in range(2))
    before[:, 1:4] = 20.0  # three columns wide: further than one pixel reaches in their middle only
    before[:, 31] = 10.5
    now[:, 0] = 10.5  # the column on the other side of the border
    scans = [Points.from_scan(ahead * r.flatten()[:, None], ahead[:, :0]) for r in (now, before)]
    image = range_project(scans[0], VIEW)
    plain, searched = (residual_images(image, [scans[1]], search=n)[0, 0] for n in (0, 1))
    assert plain[3, [0, 1, 2, 3, 4]].tolist() == pytest.approx([0.5 / 10.5, 1, 1, 1, 0], abs=1e-4)
    assert searched[3, [0, 1, 2, 3, 4]].tolist() == pytest.approx([0, 0, 1, 0, 0], abs=1e-4)


def test_a_clipping_view_keeps_what_lies_above_and_below() -> None:
    steep = torch.tensor([[1.0, 0, 5], [1, 0, -5], [5, 0, 0], [0, 0, 0]])
    for clip, rows in ((False, [-1, -1, 3, -1]), (True, [0, 7, 3, -1])):
        view = RangeView(8, 32, math.radians(20), math.radians(-25), clip)
        pixel = range_project(Points.from_scan(steep, steep[:, :0]), view).pixel
        assert torch.where(pixel < 0, -1, pixel // 32).tolist() == rows


@settings(max_examples=15, deadline=None)
@given(st.sampled_from([(3, 3), (5, 5), (5, 9)]), st.integers(0, 10**6))
def test_means_are_over_those_that_vote(window: tuple[int, int], seed: int) -> None:
    """A class voted for by all neighbours has mean 1 in its channel; the mean of one-hot labels counts the votes."""
    points = cloud(300, 2, seed)
    image = range_project(points, VIEW)
    labels = torch.randint(3, image.mask.shape, generator=torch.Generator().manual_seed(seed))
    distance = points.xyz.norm(dim=1)
    size = {"window": window[0], "neighbors": window[1], "cutoff": 2.0}
    values = torch.nn.functional.one_hot(labels, 3).permute(0, 3, 1, 2).float()
    means, votes = range_knn_mean(image, values, distance, **size), range_knn(image, labels, distance, **size)
    inside = image.pixel >= 0
    assert torch.allclose(means[inside].sum(1), torch.ones(int(inside.sum())))
    assert means[~inside].abs().sum() == 0
    assert torch.equal(means[inside].argmax(1), votes[inside])
    constant = range_knn_mean(image, torch.full((2, 1, 8, 32), 0.3), distance, **size)
    assert torch.allclose(constant[inside], torch.tensor(0.3))


def test_matching_by_range() -> None:
    """The nearest range in the window, the nearest pixel among equals, round the border, within reach."""
    columns, ranges = torch.tensor([0.0, 2, 4, 31]), torch.tensor([10.0, 12, 10, 20])
    there = VIEW.direction(torch.full((4,), 3.0), columns) * ranges[:, None]
    image = range_project(Points.from_scan(there, there[:, :0]), VIEW)
    asked = torch.tensor([[2.0, 11.8], [2.0, 10.9], [1.0, 10.0], [3.0, 10.4], [0.0, 19.0], [16.0, 10.0]])
    xyz = VIEW.direction(torch.full((6,), 3.0), asked[:, 0]) * asked[:, 1:]
    found = range_match(image, xyz, 1.0, window=5)
    place = torch.where(found < 0, -1, found % 32).tolist()
    assert place[1] in (0, 4)  # equally near in range and in the picture
    assert [place[i] for i in (0, 2, 3, 4, 5)] == [2, 0, 4, 31, -1]
    assert range_match(image, xyz, 0.5, window=5).ge(0).tolist() == [True, False, True, True, False, False]
    assert range_match(image, xyz[:0], 1.0).shape == (0,)
