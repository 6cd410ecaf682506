"""The data types of lidarfw.

One convention everywhere: metres, radians and seconds; sensor frame x forward, y left, z up; yaw
counter-clockwise from x; a pose takes sensor coordinates to map coordinates; index order z, y, x.
None of these modules imports torch before a tensor is touched.
"""

from lidarfw.types.features import BEV, Image, Points, RangeImage, Voxels
from lidarfw.types.frame import Batch, Frame, FrameMeta, FrameResult, Targets, collate, take
from lidarfw.types.geometry import Camera, Grid, RangeView
from lidarfw.types.predictions import Boxes, Descriptors, Matches, PointLabels, Poses, SceneCoords, Tracks
from lidarfw.types.record import Record, Rows
from lidarfw.types.spec import FEATURES, PREDICTIONS, VOCABULARY, DataSpec, Spec, Stride, Sweeps, Tap

__all__ = [
    "BEV", "FEATURES", "PREDICTIONS", "VOCABULARY", "Batch", "Boxes", "Camera", "DataSpec", "Descriptors", "Frame",
    "FrameMeta", "FrameResult", "Grid", "Image", "Matches", "PointLabels", "Points", "Poses", "RangeImage",
    "RangeView", "Record", "Rows", "SceneCoords", "Spec", "Stride", "Sweeps", "Tap", "Targets", "Tracks", "Voxels",
    "collate", "take",
]  # fmt: skip
