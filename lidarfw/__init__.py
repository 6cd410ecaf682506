"""lidarfw: a plugin-based framework for LiDAR and camera perception."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarfw._lazy import lazy_attributes

if TYPE_CHECKING:
    from lidarfw.checkpoint import load
    from lidarfw.merging import merge
    from lidarfw.streaming import Stream

__version__ = "0.1.0"
__getattr__ = lazy_attributes(
    __name__, {"load": "lidarfw.checkpoint", "merge": "lidarfw.merging", "Stream": "lidarfw.streaming"}
)
__all__ = ["Stream", "__version__", "load", "merge"]
