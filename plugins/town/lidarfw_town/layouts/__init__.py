"""The official layouts of public datasets, written from drives through the town."""

from __future__ import annotations

from lidarfw_town.layouts.base import Layout, Place
from lidarfw_town.layouts.kitti import KittiLayout, KittiTrackingLayout, labels_of
from lidarfw_town.layouts.kitti_360 import Kitti360Layout
from lidarfw_town.layouts.nclt import NcltLayout
from lidarfw_town.layouts.nuscenes import NuScenesLayout
from lidarfw_town.layouts.oxford import OxfordLayout
from lidarfw_town.layouts.semantic_kitti import SemanticKittiLayout

LAYOUTS: dict[str, type[Layout]] = {
    "kitti": KittiLayout,
    "kitti_tracking": KittiTrackingLayout,
    "semantic_kitti": SemanticKittiLayout,
    "kitti_360": Kitti360Layout,
    "oxford": OxfordLayout,
    "nclt": NcltLayout,
    "nuscenes": NuScenesLayout,
}

__all__ = ["LAYOUTS", "Layout", "Place", "labels_of"]
