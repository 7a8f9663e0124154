"""Policies, losses and decoding stay on their device: the cases of ``device_cases.py``, in a process of their own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CASES = Path(__file__).with_name("device_cases.py")


def test_policies_losses_and_decisions_stay_on_their_device() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", str(CASES)]
    outcome = subprocess.run(command, cwd=CASES.parents[3], capture_output=True, text=True, timeout=300)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    assert " passed" in outcome.stdout


if __name__ == "__main__":
    pytest.main([__file__])
