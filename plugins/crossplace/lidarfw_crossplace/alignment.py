"""Two fisheyes aligned by what both of them see (paper 3.1, after Flores et al. 2024): ORB matches and a polynomial.

Each camera alone gives a panorama by its calibration. Where both see, points of one are found again in the other; a
polynomial says where the second shows what the first has at a place. It is fitted once for a rig.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lidarfw.errors import DataError
from lidarfw.files import write_text
from lidarfw.types import Camera, RangeView
from torch import Tensor

Array = npt.NDArray[np.float64]

DEGREE = 2
_POINTS, _RATIO = 2000, 0.8  # of a picture; distance of a match to that of the second best
_REACH = math.radians(10)  # from where the calibration has it: what is farther off is no match
_CLOSE = math.radians(0.7)  # from the polynomial: an inlier; two pixels of a panorama of 1024
_TRIES = 2000  # of RANSAC
_MATCHES = 3  # for every coefficient
_FADE = 0.1  # of half the panorama: so far outside the matches the correction ends


@dataclass(frozen=True)
class Alignment:
    """Where a camera shows what the panorama has at a place, by its azimuth from the camera's axis and its elevation.

    Both are shares of pi, so that the whole circle goes from -1 to 1. Without coefficients, the calibration stands.
    """

    coefficients: tuple[tuple[float, float], ...] = ()  # of each term, for azimuth and elevation
    hull: tuple[tuple[float, float], ...] = ()  # corners of the convex hull of the matches, in order

    def moved(self, place: Tensor) -> Tensor:
        """Places (N, 2) where the camera shows them; outside the matches the correction of the nearest place fades."""
        if not self.coefficients:
            return place
        nearest = self._nearest(place.double())
        terms = torch.from_numpy(polynomial_terms(nearest.numpy(), DEGREE))
        correction = terms @ torch.tensor(self.coefficients, dtype=torch.double) - nearest
        share = (1 - (nearest - place).norm(dim=1, keepdim=True) / _FADE).clamp(min=0)
        moved: Tensor = (place + share * correction).to(place)
        return moved

    def _nearest(self, place: Tensor) -> Tensor:
        """The nearest places (N, 2) of the hull; places within stay."""
        start = torch.tensor(self.hull, dtype=place.dtype)
        edge = start.roll(-1, 0) - start
        off = place[:, None] - start  # (N, corners, 2)
        outside = (off[..., 0] * edge[:, 1] - off[..., 1] * edge[:, 0]).amax(1) > 0  # corners run against the clock
        share = ((off * edge).sum(2) / edge.square().sum(1)).clamp(0, 1)
        on_edge = start + share[..., None] * edge
        best = (on_edge - place[:, None]).norm(dim=2).argmin(1)
        return torch.where(outside[:, None], on_edge[torch.arange(len(place)), best], place)

    def save(self, path: str | Path) -> None:
        """Write a JSON file."""
        write_text(path, json.dumps(asdict(self), indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Alignment:
        """Read what `save` wrote; DataError where the file holds none."""
        try:
            content: dict[str, Any] = json.loads(Path(path).read_text(encoding="utf-8"))
            parts = {name: tuple((float(a), float(b)) for a, b in content[name]) for name in ("coefficients", "hull")}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{path} holds no alignment of cameras: {error}\n  fix: remove it, it is made again"
            ) from error
        return cls(**parts)


def azimuth_of(camera: Camera) -> float:
    """Azimuth of a camera's axis, radians to the left of ahead."""
    x, y = camera.from_sensor[2][:2] if camera.from_sensor else (0.0, 0.0)
    return math.atan2(y, x)


def place_of(rays: Tensor, axis: float) -> Tensor:
    """Directions (N, 3) as azimuth to the right of the axis and elevation, both as shares of pi (N, 2)."""
    azimuth = torch.remainder(axis - torch.atan2(rays[:, 1], rays[:, 0]) + math.pi, 2 * math.pi) - math.pi
    elevation = torch.atan2(rays[:, 2], rays[:, :2].norm(dim=1))
    return torch.stack([azimuth, elevation], 1) / math.pi


def rays_of(place: Tensor, axis: float) -> Tensor:
    """Unit directions (N, 3) of places: the inverse of `place_of`."""
    azimuth, elevation = axis - place[:, 0] * math.pi, place[:, 1] * math.pi
    level = elevation.cos()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), elevation.sin()], 1)


def matches(first: Tensor, second: Tensor, both: Tensor, view: RangeView, axis: float) -> tuple[Array, Array]:
    """Places (N, 2) of what both cameras see: in the panorama (H, W) 0..1 of the first, and in that of the second.

    Args:
        both: (H, W) bool, pixels that both see.
    """
    import cv2

    orb = cv2.ORB.create(nfeatures=_POINTS)
    mask = both.numpy().astype(np.uint8) * 255
    (points, one), (others, other) = (
        orb.detectAndCompute((grey.clamp(0, 1) * 255).byte().numpy(), mask) for grey in (first, second)
    )
    pixels = torch.tensor([(points[a].pt, others[b].pt) for a, b in _mutual(one, other)]).view(-1, 2, 2)  # column, row
    place, target = (place_of(view.direction(*pixels[:, side].double().T.flip(0)), axis).numpy() for side in (0, 1))
    near = np.abs(place - target).max(1) < _REACH / math.pi
    return place[near], target[near]


def _mutual(one: npt.NDArray[Any] | None, other: npt.NDArray[Any] | None) -> list[tuple[int, int]]:
    """Rows of descriptors that are each other's best and clearly better than the second best."""
    import cv2

    if one is None or other is None or min(len(one), len(other)) < 2:
        return []
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    there, back = (_best(matcher.knnMatch(a, b, k=2)) for a, b in ((one, other), (other, one)))
    return [(row, match) for row, match in there.items() if back.get(match) == row]


def _best(neighbors: Sequence[Any]) -> dict[int, int]:
    """The nearest by row, where the second nearest is clearly farther."""
    return {first.queryIdx: first.trainIdx for first, second in neighbors if first.distance < _RATIO * second.distance}


def fit_alignment(place: Array, target: Array) -> Alignment:
    """The polynomial of degree 2 that takes places (N, 2) to targets (N, 2), by RANSAC and least squares.

    DataError where fewer than three matches for every coefficient agree.
    """
    import cv2

    terms = polynomial_terms(place, DEGREE)
    inlier = _ransac(terms, place, target)
    needed = _MATCHES * terms.shape[1]
    if inlier.sum() < needed:
        raise DataError(f"{inlier.sum()} of {len(place)} matches of both cameras agree, needed are {needed}")
    coefficients = fit_polynomial(place[inlier], target[inlier], DEGREE)
    hull = cv2.convexHull(place[inlier].astype(np.float32), clockwise=False)[:, 0].astype(np.float64)
    return Alignment(_pairs(coefficients), _pairs(hull))


def _ransac(terms: Array, place: Array, target: Array) -> npt.NDArray[np.bool_]:
    """(N,) which matches agree with the polynomial that most agree with."""
    none = np.zeros(len(terms), dtype=bool)
    if len(terms) < terms.shape[1]:
        return none
    rng, best = np.random.default_rng(0), none
    for _ in range(_TRIES):
        chosen = rng.choice(len(terms), terms.shape[1], replace=False)
        if np.linalg.cond(terms[chosen]) > 1e6:
            continue
        guess = np.linalg.solve(terms[chosen], target[chosen])
        inlier = np.linalg.norm(terms @ guess - target, axis=1) < _CLOSE / math.pi
        best = inlier if inlier.sum() > best.sum() else best
    return best


def _pairs(values: Array) -> tuple[tuple[float, float], ...]:
    return tuple((float(a), float(b)) for a, b in values)


def polynomial_terms(place: Array, degree: int) -> Array:
    """(N, T) products u^i v^j with i + j <= degree, in the order 1, u, v, u^2, u v, v^2, ... of places (N, 2)."""
    u, v = place.T
    return np.stack([u ** (total - j) * v**j for total in range(degree + 1) for j in range(total + 1)], 1)


def fit_polynomial(place: Array, target: Array, degree: int) -> Array:
    """Coefficients (T,) or (T, D) of the polynomial that takes places (N, 2) to targets (N,) or (N, D), least squares.

    DataError where the places do not determine them.
    """
    terms = polynomial_terms(place, degree)
    if np.linalg.matrix_rank(terms) < terms.shape[1]:
        raise DataError(f"{len(place)} matches do not determine the {terms.shape[1]} coefficients of degree {degree}")
    return np.linalg.lstsq(terms, target, rcond=None)[0].astype(np.float64)


def pooled(found: Sequence[tuple[Array, Array]]) -> Alignment:
    """The alignment by the matches of several frames, each as `matches` gives them."""
    place, target = (np.concatenate([pair[side] for pair in found] or [np.zeros((0, 2))]) for side in (0, 1))
    return fit_alignment(place, target)
