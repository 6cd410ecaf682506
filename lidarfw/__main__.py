"""`python -m lidarfw`."""

from lidarfw.cli import run

run()
