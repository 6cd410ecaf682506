"""Options that hold one number per class."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

from lidarfw.errors import ConfigError


def per_class(classes: Sequence[str], values: Mapping[str, float] | None, default: float, option: str) -> list[float]:
    """The number of every class, in class order: `values[name]` where given, else `default`.

    `option` names the config key in the message of the ConfigError that an unknown class name raises.
    """
    values = values or {}
    unknown = [name for name in values if name not in classes]
    if unknown:
        near = difflib.get_close_matches(unknown[0], classes, 1, 0.4)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise ConfigError(
            f"{option} names the class '{unknown[0]}'.\n  classes of the data: {', '.join(classes)}.{hint}"
        )
    return [float(values.get(name, default)) for name in classes]
