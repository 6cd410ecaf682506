"""docs/errors.md shows what the command line really answers."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_of_messages_is_up_to_date():
    done = subprocess.run([sys.executable, ROOT / "tools/error_table.py", "--check"], check=False)
    assert done.returncode == 0, "run: python tools/error_table.py"
