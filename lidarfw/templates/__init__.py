"""Text templates of `lidarfw new`: one component of each slot, written as a plugin author would write it."""
