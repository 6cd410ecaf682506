"""CrossPlace: place recognition between fisheye cameras and LiDAR."""
