"""A policy that does not keep the contract of its family is told so in one sentence, before it is trained."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from dpa.losses import NextTokenLoss, token_network
from dpa.models import Decision, MotionModel, collate_contexts, make_context
from dpa.models.base import ContractError
from dpa.models.contract import check_contract
from dpa.models.motionlm import MotionLM
from dpa.models.registry import FAMILIES, Family, build_model, size_of
from dpa.tokens import PatchTokenizer, VerletTokenizer
from tests.dpa.families import families_and_tokens, smallest


class Odd(MotionLM):
    """Does what its policy does, until a test says otherwise."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        super().__init__("nano", VerletTokenizer())


def altered(**methods: Callable) -> MotionModel:
    return type("Odd", (Odd,), methods)()


def with_memory(change: Callable[[Decision], Any]) -> MotionModel:
    """A policy whose memory gives something else."""

    def remember(self: Odd, *, compile: bool = False) -> Any:
        memory = Odd.remember(self, compile=compile)
        return SimpleNamespace(begin=memory.begin, step=lambda seen, choose: change(memory.step(seen, choose)))

    return altered(remember=remember)


def with_logits(change: Callable[[Tensor], Any]) -> MotionModel:
    return altered(forward=lambda self, *given: change(Odd.forward(self, *given)))


def peeking(self: Odd, context: Any, tokens: Tensor, token_valid: Tensor) -> Tensor:
    """Logits of the decision after."""
    return Odd.forward(self, context, tokens, token_valid).roll(-1, 3)


SHAPE = r"Odd\.forward must give logits \[2, 2, 3, 5, 169\], got "
MEMORY = r"the memory of Odd must give a Decision of tokens \[4, 3\] and logits \[4, 3, 'P'\] at every step, got "
MISTAKES = {
    "agents and decisions swapped": (lambda: with_logits(lambda x: x.transpose(2, 3)), SHAPE + r"\[2, 2, 5, 3, 169\]"),
    "a logit too many": (lambda: with_logits(lambda x: torch.nn.functional.pad(x, (0, 1))), SHAPE + r".* 170\]"),
    "no logits": (lambda: with_logits(lambda x: None), SHAPE + "NoneType"),
    "logits of the next decision": (
        lambda: altered(forward=peeking),
        "says other log-probabilities of the same",
    ),
    "logits as a decision": (lambda: with_memory(lambda decision: decision.logits), MEMORY + "Tensor"),
    "a token of its own dimension": (
        lambda: with_memory(lambda it: Decision(it.token[..., None], it.logits)),
        MEMORY + r"tokens \[4, 3, 1\]",
    ),
    "logits of one agent": (
        lambda: with_memory(lambda it: Decision(it.token, it.logits[:, :1])),
        MEMORY + r".* logits \[4, 1, 169\]",
    ),
    "no logits of a decision": (
        lambda: with_memory(lambda it: Decision(it.token, None)),
        MEMORY + r".* logits \[\]",
    ),
    "a memory that cannot be asked to compile": (
        lambda: altered(remember=lambda self: None),
        r"Odd\.remember ends with TypeError: .*'compile'",
    ),
    "a memory without steps": (
        lambda: altered(remember=lambda self, *, compile=False: object()),
        r"begin of the memory of Odd ends with AttributeError: .*'begin'",
    ),
    "a dictionary of what is seen": (
        lambda: altered(featurize=property(lambda self: lambda scene, episode: {"episode": episode})),
        r"Odd\.featurize must give a TensorClass .* got dict",
    ),
    "an error in what is seen": (
        lambda: altered(featurize=property(lambda self: lambda scene, episode: 1 / 0)),
        r"Odd\.featurize ends with ZeroDivisionError: division by zero \(test_contract.py, line \d+\)",
    ),
    "no size of a row": (
        lambda: altered(bytes_per_row=lambda self: None),
        r"Odd\.bytes_per_row must give a number of bytes, 1 or more, got None",
    ),
}


@pytest.mark.parametrize(("make", "told"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_told_with_the_method_that_makes_it(make: Callable[[], MotionModel], told: str) -> None:
    with pytest.raises(ContractError, match=told):
        check_contract(make())


@families_and_tokens
def test_every_family_keeps_the_contract_and_is_left_as_it_was(family: str, make_tokenizer: Callable) -> None:
    model = smallest(family, make_tokenizer())
    before, drawn = [value.clone() for value in model.state_dict().values()], torch.get_rng_state()
    check_contract(model)
    assert model.training and torch.equal(torch.get_rng_state(), drawn)
    assert all(torch.equal(one, other) for one, other in zip(before, model.state_dict().values(), strict=True))


class Scaled(Odd):
    """Has a parameter that must stay positive, and agrees with itself."""

    def __init__(self) -> None:
        super().__init__()
        self.spread = torch.nn.Parameter(torch.tensor([0.03]))

    def forward(self, *given: Any) -> Tensor:
        return super().forward(*given) * self.spread.sqrt()

    def remember(self, *, compile: bool = False) -> Any:
        memory = super().remember(compile=compile)

        def step(seen: Any, choose: Callable) -> Decision:
            token, logits = memory.step(seen, lambda logits, agents=None: choose(logits * self.spread.sqrt(), agents))
            return Decision(token, logits * self.spread.sqrt())

        return SimpleNamespace(begin=memory.begin, step=step)


def test_a_parameter_that_must_be_positive_stays_so() -> None:
    check_contract(Scaled())


def test_logits_that_are_not_finite_are_told_as_such() -> None:
    model = Scaled()
    with torch.no_grad():
        model.spread.fill_(-1.0)
    with pytest.raises(ContractError, match="the memory of Scaled chooses by logits that are not finite"):
        check_contract(model)


def test_an_error_of_the_tokenizer_is_not_told_as_the_memorys() -> None:
    class Broken(VerletTokenizer):
        def decode(self, *given: Tensor) -> Tensor:
            raise RuntimeError("no motion")

    with pytest.raises(ContractError, match="driving by tokens of Broken ends with RuntimeError: no motion"):
        check_contract(MotionLM("nano", Broken()))


def test_a_policy_of_tokens_needs_a_vocabulary() -> None:
    model = Odd()
    model.tokenizer = PatchTokenizer()
    with pytest.raises(ContractError, match="Odd predicts tokens of a vocabulary, and PatchTokenizer has none"):
        check_contract(model)


def test_a_loss_refuses_logits_of_other_decisions(scene: Callable) -> None:
    """As many agents as decisions pass here, and not in the check above."""
    model = with_logits(lambda x: x.transpose(2, 3))
    context = collate_contexts([make_context(scene(3), model.featurize)])
    tokens, valid = torch.full((1, 2, 3, 16), 84), torch.ones(1, 1, 3, 16, dtype=torch.bool)
    loss = NextTokenLoss(token_network(model))
    with pytest.raises(ContractError, match=r"Odd\.forward must give logits \[1, 2, 3, 16, 'P'\], got \[1, 2, 16, 3"):
        loss(context=context, tokens=tokens, token_valid=valid)


# --- what a registry is asked for -----------------------------------------------------------------------------------
def test_a_size_without_a_horizon_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(FAMILIES, "odd", Family(MotionLM, {"nano": {"width": 8}}, dict))
    with pytest.raises(ValueError, match=r"size 'nano' of odd must be a dataclass with horizon and dropout, lacks"):
        size_of("odd", "nano")


def test_a_family_that_is_not_here_is_told_with_where_it_belongs() -> None:
    with pytest.raises(ValueError, match=r"must be one of \['behaviorgpt', .*got 'herd'; one of your own is a line in"):
        build_model({"family": "herd", "model": {}, "context": {}}, VerletTokenizer())


if __name__ == "__main__":
    pytest.main([__file__])
