"""Scan to map: a pose moved until the scan lies on a map of points."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_points

_FEWEST = 20  # points from which normals can be told
_SHARE = 0.3  # of the scan's points that must find the map

Array = npt.NDArray[np.float64]


def small_gicp() -> Any:
    """The package; ConfigError where it is not installed."""
    try:
        return importlib.import_module("small_gicp")
    except ImportError as error:
        raise ConfigError(
            "refining poses on a map needs the package small-gicp, which is not installed.\n"
            "  fix: pip install 'lidarfw-taco[refine]', or postprocessor.pose_ransac.map= for no refinement"
        ) from error


@dataclass(frozen=True)
class MapRefiner:
    """Generalised ICP (Segal et al., RSS 2009; package small-gicp) of scans against one map.

    path: a file of points in map coordinates, of any form that `lidarfw predict` reads; it is read at first use.
    cell: metres to which both are thinned. distance: metres within which a point finds the map.
    """

    path: str
    cell: float
    distance: float

    @cached_property
    def _target(self) -> tuple[Any, Any]:
        """The map's points and their tree."""
        xyz = read_points(Path(self.path)).xyz
        if len(xyz) < _FEWEST:
            raise DataError(f"{self.path}: a map of {len(xyz)} points; at least {_FEWEST} are needed")
        points, tree = small_gicp().preprocess_points(xyz.astype(np.float64), downsampling_resolution=self.cell)
        return points, tree

    def refine(self, matrix: Array, xyz: Array) -> Array:
        """The pose (4, 4) after registration of the scan (N, 3), as it was where that does not converge on the map."""
        gicp, (points, tree) = small_gicp(), self._target
        if len(xyz) < _FEWEST:
            return matrix
        scan, _ = gicp.preprocess_points(xyz, downsampling_resolution=self.cell)
        found = gicp.align(points, scan, tree, matrix, max_correspondence_distance=self.distance)
        good = found.converged and found.num_inliers >= _SHARE * scan.size()
        return np.asarray(found.T_target_source) if good else matrix
