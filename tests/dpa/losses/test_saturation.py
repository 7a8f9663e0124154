"""SaturationWatch: when it speaks, once, and what it says."""

from __future__ import annotations

import json
import re

import pytest
import torch

from dpa.losses import SaturationWatch
from dpa.losses.saturation import WINDOW

PLAIN = {"alpha": 0.1, "reference": False, "score_reduction": "sum"}


def figures(
    saturated: float, mean: float = 0.0, std: float = 10.0, weight: float = 0.5, spread: float = 0.5
) -> dict[str, float]:
    """Of a step; by default half of the pairs have their full weight and the others none."""
    logits = {"logit_mean": mean, "logit_std": std}
    return {"saturated": saturated, "weight_mean": weight, "weight_std": spread, **logits}


def said(watch: SaturationWatch, shares: list[float], first: int = 0) -> dict[int, str]:
    """Step -> warning."""
    told = {step: watch(step, figures(share)) for step, share in enumerate(shares, first)}
    return {step: text for step, text in told.items() if text}


def test_the_first_step_alone_is_enough() -> None:
    told = said(SaturationWatch(PLAIN), [0.6, 0.9, 0.9])
    assert list(told) == [0]
    assert told[0].startswith("60 % of the pairs are saturated since step 1:")


def test_later_the_mean_of_the_last_steps_decides() -> None:
    told = said(SaturationWatch(PLAIN), [0.0] * 5 + [1.0] * 30)
    assert list(told) == [WINDOW], "five of ten are not more than half, six are"
    assert told[WINDOW].startswith("60 % of the pairs are saturated since step 2:")


def test_half_of_the_pairs_is_not_too_many() -> None:
    assert not said(SaturationWatch(PLAIN), [0.5] * 30)


def test_half_of_the_pairs_is_not_too_many_where_shares_are_rounded() -> None:
    sixths = [float(torch.tensor(count / 6)) for count in (1, 5, 2, 4, 5, 1, 4, 2, 1, 5)]
    assert not said(SaturationWatch(PLAIN), sixths * 3)


def test_pairs_that_all_have_their_full_weight_are_weighed_alike() -> None:
    watch = SaturationWatch(PLAIN)
    assert not any(watch(step, figures(1.0, mean=-20.0, weight=0.999, spread=0.001)) for step in range(30))


def test_pairs_that_weigh_alike_within_each_step_but_not_among_steps_are_told() -> None:
    watch = SaturationWatch(PLAIN)
    one_pair = [watch(step, figures(1.0 if step else 0.0, weight=step % 2, spread=0.0)) for step in range(30)]
    assert any(told and "how likely their rollouts are" in told for told in one_pair)


def test_pairs_that_hardly_weigh_are_told_as_what_they_are() -> None:
    told = SaturationWatch({**PLAIN, "reference": True})(0, figures(1.0, mean=50.0, std=1.0, weight=0.0, spread=0.0))
    assert "hardly any of them weighs anything" in told and "lower method.loss.alpha=0.1 to 0.002" in told


def test_a_run_that_goes_on_waits_for_enough_steps() -> None:
    told = said(SaturationWatch(PLAIN), [1.0] * 30, first=40)
    assert list(told) == [40 + WINDOW - 1]


def test_a_resumed_watch_finds_what_an_uninterrupted_one_does() -> None:
    shares = [0.0] * 5 + [1.0] * 30
    kept: dict = {}
    assert not said(SaturationWatch(PLAIN, state=kept), shares[:8])
    kept = json.loads(json.dumps(kept))  # as in a checkpoint
    resumed = said(SaturationWatch(PLAIN, state=kept), shares[8:], first=8)
    assert resumed == said(SaturationWatch(PLAIN), shares)
    again = SaturationWatch(PLAIN, state=kept)
    assert again.found == resumed[WINDOW]
    assert not said(again, [1.0] * 30, first=40), "once"


def test_options_are_named_where_the_command_has_them() -> None:
    text = SaturationWatch(PLAIN, "methods.cpl.loss")(0, figures(0.9))
    assert text.endswith(
        "Say methods.cpl.loss.reference=true. Without it, to say methods.cpl.loss.score_reduction=token_mean, or lower "
        "methods.cpl.loss.alpha=0.1 to 0.01 saturates fewer, but those whose preferred rollout was improbable still "
        "weigh most."
    )


def test_a_hinge_is_told_of_pairs_far_from_its_corner_and_a_squared_link_never() -> None:
    assert "how likely their rollouts are" in (SaturationWatch({**PLAIN, "link": "hinge"})(0, figures(0.9)) or "")
    assert not said(SaturationWatch({**PLAIN, "link": "squared"}), [1.0] * 30)


def test_imitation_is_never_told_off() -> None:
    watch = SaturationWatch({"label_smoothing": 0.0})
    assert watch(0, {"loss_next_token": 2.0}) is None


@pytest.mark.parametrize(
    ("options", "mean", "std", "advice"),
    [
        (PLAIN, 0.0, 10.0, "Say method.loss.reference=true. Without it, to say method.loss.score_reduction=token_mean, "
         "or lower method.loss.alpha=0.1 to 0.01 saturates fewer, but those whose preferred rollout was improbable "
         "still weigh most."),
        ({**PLAIN, "reference": True}, 3.0, 4.0, "Say method.loss.score_reduction=token_mean, or lower "
         "method.loss.alpha=0.1 to 0.02."),
        ({**PLAIN, "reference": True, "score_reduction": "token_mean"}, 50.0, 0.0, "Lower method.loss.alpha=0.1 to "
         "0.002."),
        ({"score_reduction": "token_mean"}, 0.0, 10.0, "Make its scores smaller."),
    ],
)  # fmt: skip
def test_it_names_the_options_that_are_left_to_change(options: dict, mean: float, std: float, advice: str) -> None:
    text = SaturationWatch(options)(0, figures(0.9, mean, std))
    assert re.search(re.escape(advice) + "$", text)


if __name__ == "__main__":
    pytest.main([__file__])
