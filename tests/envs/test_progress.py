"""Bars in a log file: whole lines, with the names of the stages, the rate and the remaining time."""

from __future__ import annotations

import io

import pytest

from envs import progress as module
from envs.progress import progress, stage


def test_lines_in_a_log_have_no_control_characters_and_name_rate_and_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LOG_INTERVAL", 0.0)
    log = io.StringIO()
    with stage("align"):
        for _ in progress(range(3), "scenes", unit="scene", stream=log):
            for _ in progress(range(2), "pairs", stream=log):
                pass
    lines = log.getvalue().splitlines()
    assert not any(c in log.getvalue() for c in "\r\x1b")
    assert any(line.startswith("align > pairs: 100%") for line in lines)
    assert lines[-1].startswith("align > scenes: 100%")
    assert "scene/s" in lines[-1]
    assert "<" in lines[-1], "elapsed<remaining"


def test_a_log_gets_few_lines() -> None:
    log = io.StringIO()
    for _ in progress(range(10_000), "steps", stream=log):
        pass
    assert len(log.getvalue().splitlines()) <= 3


def test_a_resumed_bar_starts_where_the_run_stopped() -> None:
    log = io.StringIO()
    with progress(total=10, initial=4, description="steps", stream=log) as bar:
        bar.update(6)
    assert "10/10" in log.getvalue()


def test_a_stage_ends_even_after_an_error() -> None:
    with pytest.raises(RuntimeError), stage("broken"):
        raise RuntimeError
    assert progress(range(1), "next", stream=io.StringIO()).desc == "next"


if __name__ == "__main__":
    pytest.main([__file__])
