"""Options that hold one number per class."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence

from lidarfw.errors import ConfigError


def check_names(classes: Sequence[str], named: Iterable[str], option: str) -> None:
    """ConfigError where the option named `option` names a class that the data does not have."""
    unknown = [name for name in named if name not in classes]
    if unknown:
        near = difflib.get_close_matches(unknown[0], classes, 1, 0.4)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise ConfigError(
            f"{option} names the class '{unknown[0]}'.\n  classes of the data: {', '.join(classes)}.{hint}"
        )


def per_class(classes: Sequence[str], values: Mapping[str, float] | None, default: float, option: str) -> list[float]:
    """The number of every class, in class order: `values[name]` where given, else `default`.

    Raises ConfigError, which names the option, for a class that the data does not have.
    """
    check_names(classes, values or {}, option)
    return [float((values or {}).get(name, default)) for name in classes]
