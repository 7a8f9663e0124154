"""Who collides, and how they met: the recipe on tiny scenes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from dpa.realism import RealismConfig
from envs.sources.synthetic import straight_road
from recipes.common.rolled import Rolled
from recipes.encounters import ALL, CLASSES, MET, look, tables


def test_shares_of_a_class_add_up_and_a_class_that_is_not_there_has_none() -> None:
    on_one_spot = Rolled.of(0, straight_road(2), torch.zeros(4, 2, 80, 4))
    found = look(on_one_spot, RealismConfig.load("2024"))
    vehicles = found.pop("vehicles")
    assert vehicles.pop(ALL) == 1.0 == sum(vehicles.values()) and vehicles["beside"] == 1.0
    assert all(value is None for shares in found.values() for value in shares.values())


def test_a_further_policy_is_told_minus_the_first_scene_by_scene() -> None:
    """By hand, and classes that no scene has are left out."""
    nothing = {how: [None, None] for how in (ALL, *MET.values())}
    one = {kind: dict(nothing) for kind in CLASSES.values()} | {"cyclists": nothing | {ALL: [0.5, 0.0]}}
    two = one | {"cyclists": nothing | {ALL: [0.25, 0.25]}}
    for figures in (one, two):
        for how in MET.values():
            figures["cyclists"][how] = [0.0, 0.0]
    shares, less = tables({"log": one, "one": one, "two": two}, ["one", "two"])
    assert shares.rows["one"][0].mean == 0.25 and shares.title == "2 scenes with cyclists"
    assert list(less.rows) == ["two"] and less.rows["two"][0].mean == 0.0
    assert len(list(tables({"log": one, "one": one}, ["one"]))) == 1, "one policy has nothing to be set against"


@pytest.mark.usefixtures("stores")
def test_the_recipe_tells_classes_with_intervals_and_reads_policies_back(
    run: Callable, options: Callable, tmp_path: Path
) -> None:
    out = tmp_path / "encounters.json"
    small = ("split=eval", "num_rollouts=3", f"output={tmp_path / 'out'}", f"json={out}")
    command = options("encounters", "policies=[zoo:motionlm-nano-sumo]", *small)
    outcome = run("encounters", *command)
    assert outcome.status == 0, outcome.err
    assert "vehicles collide" in outcome.out and "oncoming" in outcome.out
    rows = json.loads(out.read_text())["rows"]
    assert list(rows) == ["log", "motionlm-nano-sumo"]
    for shares in rows["motionlm-nano-sumo"].values():
        for every, *parts in zip(*shares.values(), strict=True):
            assert (every is None) == (None in parts) and (every is None or every == pytest.approx(sum(parts)))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("[lm]*.json")}
    assert run("encounters", *command).status == 0
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("[lm]*.json")}


if __name__ == "__main__":
    pytest.main([__file__])
