"""A simulated town: ray-cast LiDAR scans and pictures with exact ground truth."""
