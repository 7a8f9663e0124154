"""Everything from reset to ranking stays on its device: the cases of this folder, in processes of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
CASES = sorted(HERE.glob("cases_*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("cases", CASES, ids=lambda path: path.stem.removeprefix("cases_"))
def test_everything_stays_on_its_device_and_waits_for_it_where_it_is_said(cases: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", str(cases)]
    outcome = subprocess.run(command, cwd=HERE.parents[2], capture_output=True, text=True, timeout=500)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    assert " passed" in outcome.stdout


def test_there_are_cases_of_every_part() -> None:
    parts = {path.stem.removeprefix("cases_") for path in CASES}
    assert parts == {"count", "geometry", "metric", "policies", "ranking", "rollouts"}


if __name__ == "__main__":
    pytest.main([__file__])
