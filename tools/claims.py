#!/usr/bin/env python3
"""Test the claims of a plugin: `python tools/claims.py taco` is `lidarfw claims taco`, see docs/claims.md."""

import sys

from lidarfw.cli import main

if __name__ == "__main__":
    sys.exit(main(["claims", *sys.argv[1:]]))
