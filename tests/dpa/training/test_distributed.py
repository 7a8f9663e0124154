"""Ranks: several processes give the gradient and the figures of one, whatever each has to pass."""

from __future__ import annotations

import functools
import tempfile
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import distributed, multiprocessing, nn
from torchrl.objectives import LossModule

from dpa.losses import ContrastivePreferenceLoss, NextTokenLoss, token_network
from dpa.models import make_context
from dpa.models.motionlm import MotionLM, featurize
from dpa.tokens import VerletTokenizer
from dpa.training.batches import Item, collate_items
from dpa.training.distributed import ALONE, VARIABLES, Ranks, join_ranks, started_ranks
from dpa.training.logs import log_item
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer
from envs import keys
from envs.seeding import make_generator
from envs.sources.synthetic import straight_road

STEPS = 10
SECONDS = 120
"""Longer than any of these takes; a rank that hangs ends in an error."""
PARTS = [[[3, 1], [2], [4]], [[5]]]
"""Agents of the scenes of each part of each rank: the second rank has fewer parts."""
IDLE = [[[3, 1], [2]], [[0]]]
"""The second rank has nothing to predict; 0 stands for a road on which nobody is valid."""


def start_ranks(world_size: int, function: Callable[..., None], *arguments: object) -> None:
    """Run ``function(ranks, *arguments)`` in processes that can reach each other; none is left behind."""
    with tempfile.TemporaryDirectory() as folder:
        meet = f"file://{folder}/ranks"
        context = multiprocessing.start_processes(
            enter, (world_size, meet, function, *arguments), nprocs=world_size, join=False, start_method="spawn"
        )
        deadline = time.monotonic() + SECONDS
        try:
            while not context.join(timeout=1):  # raises what a rank raised
                assert time.monotonic() < deadline, "the ranks wait for each other"
        finally:
            for process in context.processes:
                process.kill()
                process.join()


def enter(rank: int, world_size: int, meet: str, function: Callable[..., None], *arguments: object) -> None:
    torch.set_num_threads(1)
    distributed.init_process_group("gloo", meet, timedelta(seconds=SECONDS), rank=rank, world_size=world_size)
    function(Ranks(rank, world_size, rank), *arguments)
    distributed.destroy_process_group()


# --- the gradient ---------------------------------------------------------------------------------------------------
@functools.cache
def item_of(agents: int) -> Item:
    """The log of a road, and the same for nobody."""
    item = log_item(make_context(straight_road(max(agents, 1), seed=agents), featurize), VerletTokenizer())
    return item if agents else item._replace(token_valid=torch.zeros_like(item.token_valid))


def other_tokens(item: Item) -> torch.Tensor:
    draw = make_generator(0, "unpreferred", item.tokens.shape[1])
    return torch.randint(60, 110, item.tokens.shape, generator=draw)


def batch_of(agents: list[int], contrastive: bool) -> TensorDict:
    items = [item_of(count) for count in agents]
    batch = collate_items(items)
    if contrastive:
        batch.rename_key_(keys.TOKENS, keys.PREFERRED)
        batch[keys.UNPREFERRED] = collate_items([item._replace(tokens=other_tokens(item)) for item in items])[
            keys.TOKENS
        ]
    return batch


def make_loss(contrastive: bool) -> tuple[MotionLM, LossModule]:
    torch.manual_seed(0)
    model = MotionLM("nano", VerletTokenizer())
    network = token_network(model)
    loss = ContrastivePreferenceLoss(network, cloning=0.5) if contrastive else NextTokenLoss(network)
    with torch.no_grad():  # away from the reference, where every pair has a gradient of its own
        for parameter in model.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return model, loss


def gradient_of(parts: list[list[int]], weigh: Callable, contrastive: bool, ranks: Ranks) -> dict[str, torch.Tensor]:
    """Figures of a step and its gradient."""
    model, loss = make_loss(contrastive)
    passed = [(batch_of(part, contrastive), weigh(part)) for part in parts]
    figures = accumulate_gradients(ranks.wrap(loss), passed, ranks)
    return {**figures, "gradient": torch.cat([p.grad.flatten() for p in model.parameters()])}


def weigher(parts: list[list[list[int]]], contrastive: bool) -> Callable[[list[int]], float]:
    """Each part's share of the batch of all ranks: of the scenes, or of the tokens."""

    def weight(part: list[int]) -> float:
        return float(len(part)) if contrastive else sum(int(item_of(count).token_valid.sum()) for count in part)

    total = sum(weight(part) for rank in parts for part in rank)
    return lambda part: weight(part) / total


def train(contrastive: bool, ranks: Ranks) -> tuple[torch.Tensor, torch.Tensor]:
    """The loss of each of some steps ``[STEPS]``, whose parts change places, and the weights at the end."""
    model, loss = make_loss(contrastive)
    optimizer, shared = make_optimizer(model, 1e-3, 0.1), ranks.wrap(loss)
    losses = []
    for step in range(STEPS):
        parts = PARTS[:: (-1) ** step]
        mine = parts[ranks.rank] if not ranks.alone else [[count for rank in parts for part in rank for count in part]]
        weigh = weigher(parts, contrastive)
        figures = accumulate_gradients(shared, [(batch_of(part, contrastive), weigh(part)) for part in mine], ranks)
        clip_and_step(optimizer, 1.0)
        losses.append(sum(value for key, value in figures.items() if key.startswith("loss_")))
    return torch.stack(losses), torch.cat([p.detach().flatten() for p in model.parameters()])


def work(ranks: Ranks, folder: Path) -> None:
    """What each rank does."""
    for contrastive in (False, True):
        torch.save(train(contrastive, ranks), folder / f"train_{contrastive}_{ranks.rank}.pt")
    for name, parts, contrastive in CASES:
        found = gradient_of(parts[ranks.rank], weigher(parts, contrastive), contrastive, ranks)
        torch.save(found, folder / f"{name}_{ranks.rank}.pt")
    try:
        accumulate_gradients(ranks.wrap(nn.Linear(1, 1)), [], ranks)
    except ValueError as error:
        (folder / f"error_{ranks.rank}").write_text(str(error))
    try:
        ranks.agree(5 * ranks.rank, "a checkpoint of step", "runs/here")
    except ValueError as error:
        (folder / f"agree_{ranks.rank}").write_text(str(error))


CASES = [("next_token", PARTS, False), ("contrastive", PARTS, True), ("idle", IDLE, False)]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what two ranks found."""
    folder = tmp_path_factory.mktemp("ranks")
    start_ranks(2, work, folder)
    return folder


@pytest.mark.parametrize(("name", "parts", "contrastive"), CASES)
def test_ranks_with_different_numbers_of_parts_give_the_gradient_of_one_process(
    found: Path, name: str, parts: list, contrastive: bool
) -> None:
    mine = [torch.load(found / f"{name}_{rank}.pt", weights_only=True) for rank in (0, 1)]
    whole = [count for rank in parts for part in rank for count in part]  # one part
    expected = gradient_of([whole], weigher([[whole]], contrastive), contrastive, ALONE)
    assert expected["gradient"].norm() > 1e-3
    assert "logit_std" in expected or not contrastive
    for figures in mine:
        assert figures.keys() == expected.keys()
        for key, value in expected.items():
            torch.testing.assert_close(
                figures[key], value, atol=2e-5, rtol=1e-3, msg=lambda text, key=key: f"{key}: {text}"
            )
    assert torch.equal(mine[0]["gradient"], mine[1]["gradient"])


@pytest.mark.parametrize("contrastive", [False, True])
def test_the_losses_of_some_steps_are_those_of_one_process(found: Path, contrastive: bool) -> None:
    mine = [torch.load(found / f"train_{contrastive}_{rank}.pt", weights_only=True) for rank in (0, 1)]
    losses, weights = train(contrastive, ALONE)
    assert losses[-1] < losses[0] - 0.1, "they learn"
    for theirs in mine:
        assert (theirs[0] - losses).abs().max() < 1e-4
        torch.testing.assert_close(theirs[1], weights, atol=1e-4, rtol=1e-3)


def test_a_rank_without_a_part_is_refused_before_the_others_wait(found: Path) -> None:
    for rank in (0, 1):
        assert (found / f"error_{rank}").read_text().startswith(f"rank {rank} has no part of the batch")


def test_ranks_that_do_not_see_the_same_folder_are_told(found: Path) -> None:
    assert not (found / "agree_0").exists()
    assert (found / "agree_1").read_text() == (
        "rank 1 finds a checkpoint of step 5 in runs/here and rank 0 finds 0; give a folder that all machines share."
    )


# --- one process ----------------------------------------------------------------------------------------------------
def test_a_process_alone_keeps_everything_as_it_is() -> None:
    loss, values = nn.Linear(1, 1), torch.ones(2)
    assert ALONE.wrap(loss) is loss and ALONE.sum(values) is values and ALONE.main
    assert ALONE.sum_figures({"loss": values}) == {"loss": values}
    assert ALONE.place("cuda:3") == "cuda:3" and ALONE.share_of(7, "batch_size") == 7
    assert ALONE.agree(3, "step", "here") == 3
    ALONE.wait()
    before = torch.get_rng_state()
    ALONE.seed_dropout(0, step=1)
    assert torch.equal(torch.get_rng_state(), before)


def test_what_torchrun_says_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    assert started_ranks() == ALONE
    with join_ranks("cpu") as ranks:
        assert ranks == ALONE and not distributed.is_initialized()
    for name, value in zip(VARIABLES, (5, 8, 1), strict=True):
        monkeypatch.setenv(name, str(value))
    assert started_ranks() == Ranks(rank=5, world_size=8, local_rank=1)
    monkeypatch.delenv("LOCAL_RANK")
    with pytest.raises(ValueError, match="WORLD_SIZE=8 but LOCAL_RANK is not set; start the processes with torchrun"):
        started_ranks()


def test_dropout_depends_on_seed_step_and_rank() -> None:
    def draws(rank: int, seed: int, step: int) -> tuple[float, ...]:
        Ranks(rank, 2).seed_dropout(seed, step)
        return tuple(torch.rand(3).tolist())

    cases = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    assert len({draws(*case) for case in cases}) == len(cases)
    assert draws(1, 0, 1) == draws(1, 0, 1)


def test_a_batch_is_split_into_equal_parts_that_hold_everything_once() -> None:
    ranks = [Ranks(rank, 4) for rank in range(4)]
    assert sorted(item for each in ranks for item in each.mine(range(10))) == list(range(10))
    assert {each.share_of(12, "batch_size") for each in ranks} == {3}
    with pytest.raises(ValueError, match=r"pretraining.batch_size=6 is the batch of all 4 ranks.*batch_size=8, or"):
        ranks[0].share_of(6, "pretraining.batch_size")


def test_a_gpu_for_each_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert Ranks(3, 4, local_rank=1).place("cuda") == "cuda:1"
    assert Ranks(3, 4, local_rank=1).place("cpu") == "cpu"
    with pytest.raises(ValueError, match="device=cuda:0 is one GPU and 4 ranks need one each; say device=cuda"):
        Ranks(3, 4, local_rank=1).place("cuda:0")
    with pytest.raises(ValueError, match="process 3 of its machine, which has 2 GPUs.*--nproc-per-node 2"):
        Ranks(2, 4, local_rank=2).place("cuda")


if __name__ == "__main__":
    pytest.main([__file__])
