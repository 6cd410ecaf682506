"""Every error that a user can cause, each with its cause and a fix. The command line prints only the message."""

from __future__ import annotations


class LidarfwError(Exception):
    """Base of all errors that a user can mend; the command line prints the message and exits with 2."""


class RegistryError(LidarfwError):
    """A component is not known, not installed, declared twice, or cannot be imported."""


class ConfigError(LidarfwError):
    """A config key or value is wrong."""


class GeometryError(LidarfwError, ValueError):
    """A grid, range view or camera cannot exist with these numbers."""


class AssemblyError(LidarfwError):
    """The chosen components do not fit together."""


class DataError(LidarfwError):
    """A data file is missing or broken: the message names file, key, expected and found."""


class CheckpointError(LidarfwError):
    """A checkpoint cannot be read or does not fit what is installed."""


class TrainingError(LidarfwError):
    """Training cannot go on, for example after a non-finite loss."""
