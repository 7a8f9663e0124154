"""Everything from reset to ranking stays on its device: the cases of this folder, in a process of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CASES = sorted(HERE.glob("cases_*.py"))


def test_everything_stays_on_its_device_and_waits_for_it_where_it_is_said() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *map(str, CASES)]
    outcome = subprocess.run(command, cwd=HERE.parents[2], capture_output=True, text=True, timeout=500)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    assert " passed" in outcome.stdout


if __name__ == "__main__":
    pytest.main([__file__])
