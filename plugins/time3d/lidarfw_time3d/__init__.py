"""Trackers with a learned confidence, and the network of Time3D, as a plugin of lidarfw."""
