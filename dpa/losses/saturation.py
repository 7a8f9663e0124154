"""Notices when a preference loss no longer weighs preferences, and says what to change (method.md section 5)."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from statistics import fmean, pvariance
from typing import Any

WATCHED = ("saturated", "weight_mean", "weight_std", "logit_mean", "logit_std")
"""What is looked at in a step."""
WINDOW = 10
"""Steps that the share of saturated pairs is averaged over."""
TOO_MANY = 0.5
"""Share of saturated pairs above which the loss says who happened to be likely, rather than who is preferred."""
ALIKE = 0.1
"""Spread of the pairs' weights below which they weigh alike."""
ROUNDING = 1e-6
"""Of a share that is a sum of thirds and sixths in float32."""


class SaturationWatch:
    """Gives one warning, once, when most of what a step compares is saturated.

    At the first step of a run, where the policy is still its reference, that step alone decides: what saturates
    there does so by the options. Later the mean of the last :data:`WINDOW` steps does. Saturated pairs that all have
    their full weight are no cause for it: they weigh alike, as at the start of a loss with a reference.

    Args:
        options: of the loss; ``link``, ``alpha``, ``score_reduction`` and ``reference`` are read where it has them.
        section: where the command's configuration has them; the warning names them there.
        state: plain values that the watch keeps up to date and goes on from. One that a run keeps in its checkpoints
            makes a resumed run find what an uninterrupted one does.

    Examples:
        >>> watch = SaturationWatch({"alpha": 1.0, "reference": True, "score_reduction": "token_mean"})
        >>> weights = {"weight_mean": 0.3, "weight_std": 0.4}
        >>> print(watch(0, {"saturated": 0.75, "logit_mean": 3.0, "logit_std": 4.0, **weights}))
        75 % of the pairs are saturated since step 1: their weight follows how likely their rollouts are, not how
        clear the preference is. Lower method.loss.alpha=1.0 to 0.2.
    """

    def __init__(
        self,
        options: Mapping[str, Any],
        section: str = "method.loss",
        state: MutableMapping[str, Any] | None = None,
    ) -> None:
        self.options, self.section = options, section
        self._state = {} if state is None else state
        self._state.setdefault("found", None)
        self._state.setdefault("window", [])

    @property
    def found(self) -> str | None:
        """The warning, once it was given."""
        return self._state["found"]

    def __call__(self, step: int, figures: Mapping[str, Any]) -> str | None:
        """Take in one step.

        Args:
            step: counted from 0.
            figures: what the loss returned for the step; one without ``saturated`` (imitation), or whose weights grow
                with the logit (squared link), is never told off.

        Returns:
            The warning, or None.
        """
        if self.found or "saturated" not in figures or self.options.get("link") == "squared":
            return None
        seen = [float(figures[name]) for name in WATCHED[:3]]
        window = self._state["window"] = [*self._state["window"], [step, *seen]][-WINDOW:]
        steps, shares, weights, spreads = zip(*window, strict=True)
        share = fmean(shares)
        if share <= TOO_MANY + ROUNDING or (step > 0 and len(window) < WINDOW):
            return None
        weight = fmean(weights)
        spread = math.sqrt(pvariance(weights) + fmean(each**2 for each in spreads))
        if spread < ALIKE and weight > 0.5:
            return None
        reason = (
            "hardly any of them weighs anything, and nothing is learnt from the others"
            if spread < ALIKE
            else "their weight follows how likely their rollouts are, not how clear the preference is"
        )
        self._state["found"] = (
            f"{100 * share:.0f} % of the pairs are saturated since step {steps[0] + 1}: {reason}. "
            f"{self._advice(figures)}."
        )
        return self.found

    def _advice(self, figures: Mapping[str, Any]) -> str:
        ways = []
        if self.options.get("score_reduction") != "token_mean":
            ways.append(f"say {self.section}.score_reduction=token_mean")
        if "alpha" in self.options:
            ways.append(f"lower {self.section}.alpha={self.options['alpha']} to {self._smaller_alpha(figures):g}")
        smaller = ", or ".join(ways) or "make its scores smaller"
        if self.options.get("reference") is False:
            return (
                f"Say {self.section}.reference=true. Without it, to {smaller} saturates fewer, but those whose "
                "preferred rollout was improbable still weigh most"
            )
        return smaller[0].upper() + smaller[1:]

    def _smaller_alpha(self, figures: Mapping[str, Any]) -> float:
        """With which logits would be of size 1 (scores are proportional to alpha), to one digit."""
        size = math.hypot(float(figures["logit_mean"]), float(figures["logit_std"]))
        return float(f"{self.options['alpha'] / max(size, 1.0):.1g}")
