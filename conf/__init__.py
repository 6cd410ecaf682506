"""The configs of lidarfw, for Hydra."""
