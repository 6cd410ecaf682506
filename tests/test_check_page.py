"""docs/conformance.md lists the checks as they are."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_page_of_checks_is_up_to_date() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools/check_table.py", "--check"], check=False)
    assert done.returncode == 0, "run: python tools/check_table.py"
