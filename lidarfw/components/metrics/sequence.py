"""Sequences in the states of metrics, which are tensors."""

from __future__ import annotations

import hashlib


def sequence_number(name: str) -> float:
    """A number of 48 bits for the name of a sequence: the same in every process, and exact in float64."""
    return float(int.from_bytes(hashlib.blake2b(name.encode(), digest_size=6).digest(), "big"))
