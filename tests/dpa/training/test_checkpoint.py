"""Checkpoints: exact resume, crashes at any moment, damaged files, and models of another size."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dpa.training.checkpoint import (
    Checkpointer,
    CheckpointError,
    capture,
    load_policy,
    load_weights,
    restore,
    save_policy,
)
from dpa.training.optim import clip_and_step, make_optimizer, make_schedule
from dpa.training.seeding import seed_everything
from envs.files import PARTIAL_PREFIX

CONFIG = {"width": 8, "layers": [8, 8]}


class Run:
    """A small training run that draws from every kind of generator."""

    def __init__(self, steps: int) -> None:
        seed_everything(0)
        self.model = nn.Sequential(nn.Linear(4, 8), nn.LayerNorm(8), nn.Dropout(0.5), nn.Linear(8, 1))
        self.optimizer = make_optimizer(self.model, lr=1e-2, weight_decay=0.1)
        self.schedule = make_schedule(self.optimizer, steps, warmup_steps=2)
        self.parts = {"model": self.model, "optimizer": self.optimizer, "schedule": self.schedule}

    def train(self, steps: int) -> None:
        for _ in range(steps):
            inputs = torch.randn(16, 4) * random.random() + np.random.rand()
            self.model(inputs).square().mean().backward()
            clip_and_step(self.optimizer, max_norm=1.0, schedule=self.schedule)


def test_a_resumed_run_ends_with_the_same_bits_as_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = Run(steps=10)
    whole.train(10)

    first = Run(steps=10)
    first.train(5)
    Checkpointer(tmp_path, config=CONFIG).save(5, capture(first.parts, {"epoch": 1}))
    second = Run(steps=10)
    second.train(3)  # whatever happened before must not matter
    saved = Checkpointer(tmp_path, config=CONFIG).latest()
    restore(saved, second.parts)
    second.train(10 - saved["step"])

    assert saved["progress"] == {"epoch": 1}
    for name, value in whole.model.state_dict().items():
        assert torch.equal(second.model.state_dict()[name], value), name
    assert second.schedule.get_last_lr() == whole.schedule.get_last_lr()


def test_only_the_last_checkpoints_are_kept_and_the_newest_is_read(tmp_path: Path) -> None:
    checkpoints = Checkpointer(tmp_path)
    assert checkpoints.latest() is None
    for step in (1, 2, 3, 11):
        checkpoints.save(step, {"x": torch.tensor(step)})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step_0000000003.pt", "step_0000000011.pt"]
    assert checkpoints.latest()["x"] == 11


def test_saving_an_earlier_step_removes_the_abandoned_future(tmp_path: Path) -> None:
    checkpoints = Checkpointer(tmp_path)
    for step in (10, 20, 15):
        checkpoints.save(step, {})
    assert checkpoints.latest()["step"] == 15
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("damage", ["truncated", "empty", "flipped_bit", "text"])
def test_a_damaged_checkpoint_is_passed_over_with_a_warning(tmp_path: Path, damage: str) -> None:
    checkpoints = Checkpointer(tmp_path)
    checkpoints.save(1, {"x": torch.arange(1000)})
    path = checkpoints.save(2, {"x": torch.arange(1000)})
    content = bytearray(path.read_bytes())
    if damage == "flipped_bit":
        content[content.index(torch.arange(1000).numpy().tobytes()) + 4000] ^= 1
    path.write_bytes({"truncated": content[: len(content) // 2], "empty": b"", "text": b"hello"}.get(damage, content))
    with pytest.warns(UserWarning, match=r"step_0000000002\.pt.*Going on with the checkpoint before it"):
        assert checkpoints.latest()["step"] == 1


def test_when_all_checkpoints_are_damaged_the_error_names_the_folder_and_the_fix(tmp_path: Path) -> None:
    checkpoints = Checkpointer(tmp_path)
    for step in (1, 2):
        checkpoints.save(step, {}).write_bytes(b"broken")
    message = f"none of the 2 .*{tmp_path}.*remove the folder"
    with pytest.warns(UserWarning, match="no whole checkpoint"), pytest.raises(CheckpointError, match=message):
        checkpoints.latest()


SAVE_FOREVER = """
import sys, torch
from dpa.training.checkpoint import Checkpointer
checkpoints, step = Checkpointer(sys.argv[1]), 0
while True:
    step += 1
    checkpoints.save(step, {"x": torch.full((2_000_000,), float(step))})
    print(step, flush=True)
"""


def test_a_kill_during_a_save_leaves_a_whole_checkpoint(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", SAVE_FOREVER, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    with process:
        for _ in range(3):
            process.stdout.readline()
        while not list(tmp_path.glob(f"{PARTIAL_PREFIX}*")):  # a save has begun and has not ended
            time.sleep(0.0005)
        process.send_signal(signal.SIGKILL)
    saved = Checkpointer(tmp_path).latest()
    assert saved["step"] >= 3
    assert (saved["x"] == saved["step"]).all()
    Checkpointer(tmp_path).save(saved["step"] + 1, {})
    assert not list(tmp_path.glob(".*")), "what the killed save left is swept up"


def test_a_save_that_fails_leaves_the_folder_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkpoints = Checkpointer(tmp_path)
    checkpoints.save(1, {"x": 1})

    def disk_full(payload: object, file: object) -> None:
        file.write(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", disk_full)
    with pytest.raises(OSError, match="No space"):
        checkpoints.save(2, {"x": 2})
    assert [p.name for p in tmp_path.iterdir()] == ["step_0000000001.pt"]


def test_a_state_that_could_not_be_read_back_is_refused_when_it_is_saved(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\['a'\]\[1\] is a float64; .*Convert it"):
        Checkpointer(tmp_path).save(1, {"a": [1, np.float64(2)]})
    with pytest.raises(ValueError, match=r"\['step'\].*rename"):
        Checkpointer(tmp_path).save(1, {"step": 3})
    assert not list(tmp_path.iterdir())


def test_a_checkpoint_of_another_configuration_is_refused_naming_both(tmp_path: Path) -> None:
    Checkpointer(tmp_path, config={"width": 8, "layers": (8, 8)}).save(1, {})
    assert Checkpointer(tmp_path, config=CONFIG).latest() is not None, "a tuple is no other configuration than a list"
    with pytest.raises(ValueError, match=r"'width': 8 there, 16 here.*Build the model"):
        Checkpointer(tmp_path, config=CONFIG | {"width": 16}).latest()


def test_resuming_with_other_parts_is_refused(tmp_path: Path) -> None:
    run = Run(steps=4)
    Checkpointer(tmp_path).save(1, capture(run.parts))
    with pytest.raises(ValueError, match=r"parts \['model', 'optimizer', 'schedule'\], the run \['model'\]"):
        restore(Checkpointer(tmp_path).latest(), {"model": run.model})


def test_a_policy_comes_back_with_its_configuration_and_origin(tmp_path: Path) -> None:
    net = nn.Linear(3, 2)
    path = save_policy(tmp_path / "new" / "policy.pt", net.state_dict(), CONFIG, {"seed": 7})
    weights, config, metadata = load_policy(path)
    other = nn.Linear(3, 2)
    load_weights(other, weights, config, CONFIG)
    assert torch.equal(other.weight, net.weight)
    assert (config, metadata["seed"]) == (CONFIG, 7)
    assert metadata["versions"]["torch"].startswith(torch.__version__.split("+")[0])


def test_a_policy_of_another_size_is_refused_naming_both_configurations_and_changes_nothing(tmp_path: Path) -> None:
    small, large = nn.Linear(3, 2), nn.Linear(3, 5)
    before = large.weight.clone()
    weights, config, _ = load_policy(save_policy(tmp_path / "p.pt", small.state_dict(), {"out": 2}))
    with pytest.raises(ValueError, match=r"'out': 2 there, 5 here.*Build the model"):
        load_weights(large, weights, config, {"out": 5})
    with pytest.raises(ValueError, match=r"weight is \(2, 3\) there and \(5, 3\) here.*{'out': 2}.*Build the model"):
        load_weights(large, weights, config)
    assert torch.equal(large.weight, before)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    checkpoint = Checkpointer(tmp_path).save(1, {})
    with pytest.raises(CheckpointError, match="is a 'training' file; a policy file is needed"):
        load_policy(checkpoint)
    torch.save({"weights": torch.zeros(1)}, tmp_path / "foreign.pt")
    with pytest.raises(CheckpointError, match="was not written by this version"):
        load_policy(tmp_path / "foreign.pt")
    with pytest.raises(FileNotFoundError, match=r"missing\.pt does not exist"):
        load_policy(tmp_path / "missing.pt")


class Evil:
    def __reduce__(self) -> tuple:
        return (Path.touch, (Path("evil_was_here"),))


def test_code_in_a_file_is_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"format": "dpa-omf/1", "payload": Evil()}, tmp_path / "evil.pt")
    with pytest.raises(CheckpointError, match="no whole checkpoint"):
        load_policy(tmp_path / "evil.pt")
    assert not (tmp_path / "evil_was_here").exists()


if __name__ == "__main__":
    pytest.main([__file__])
