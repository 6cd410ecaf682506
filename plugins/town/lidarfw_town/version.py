"""The version of the town: another one makes other frames from the same seed, so caches are told apart by it."""

VERSION = 6
