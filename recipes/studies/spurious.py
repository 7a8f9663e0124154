"""What a ranking of rollouts goes by: rank correlations with what was measured of them, and the realism of its best."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dpa.ranking.agreement import rank_correlation
from dpa.report.statistics import Interval, paired_bootstrap, summary
from recipes.studies.study import over_scenes, with_realism

QUANTITIES = {
    "jerk": "mean squared jerk, 10 Hz",
    "jerk_2hz": "mean squared jerk, 2 Hz",
    "distance": "preference distance",
    "ade": "ADE",
    "collision": "collision rate",
    "offroad": "off-road rate",
}
"""What is measured of a rollout, none of it by the discriminator."""
RANKINGS = ("discriminator", "distance", "ade")
"""Ways to rank; the last two prefer the rollout nearest to the log."""
GIVEN = ("jerk", "distance")
"""Quantities that are held fixed in a partial correlation."""
RANDOM_SCORES = 8
"""Random rankings of each scene: what correlates with nothing."""


class Ranked:
    """What was measured of the rollouts, ``[policies, scenes, K]``, and the scores of every ranking.

    Args:
        measured: for each policy, of each scene, ``score`` and ``quantity``, ``log`` and ``realism``, as
            ``recipes.discriminator`` measures them.
    """

    def __init__(self, measured: dict[str, list[dict]]) -> None:
        self.rows = list(measured.values())
        self.quantity = {q: self._array("quantity", q) for q in QUANTITIES}
        self.score = {"discriminator": np.array([[scene["score"] for scene in row] for row in self.rows])}
        # A score says how good a rollout is; a distance how bad.
        self.score |= {name: -self.quantity[name] for name in ("distance", "ade")}

    def _array(self, part: str, key: str) -> NDArray:
        return np.array([[scene[part][key] for scene in row] for row in self.rows])

    def correlation(self, ranking: str, quantity: str) -> NDArray:
        """Spearman within each scene ``[policies, scenes]``; nan where one of the two ranks nothing."""
        return rank_correlation(self.score[ranking], self.quantity[quantity])

    def given(self, ranking: str, quantity: str, fixed: str) -> NDArray:
        """Partial Spearman of a ranking and a quantity while another one is held fixed, ``[policies, scenes]``."""
        both = rank_correlation(self.quantity[quantity], self.quantity[fixed])
        return partial(self.correlation(ranking, quantity), self.correlation(ranking, fixed), both)

    def random(self, quantity: str) -> NDArray:
        """Spearman of random scores, the mean of a few, ``[policies, scenes]``."""
        draw = np.random.default_rng(0)
        value = self.quantity[quantity]
        return np.mean([rank_correlation(draw.random(value.shape), value) for _ in range(RANDOM_SCORES)], 0)

    def auc(self) -> NDArray:
        """Share of a scene's rollouts that score lower than its log, ``[policies, scenes]``."""
        return _share_below(self.score["discriminator"], self._array("log", "score"))

    def auc_of(self, quantity: str) -> NDArray:
        """Share of a scene's rollouts that have more of a quantity than its log, ``[policies, scenes]``."""
        return _share_below(-self.quantity[quantity], -self._array("log", quantity))

    def realism(self, ranking: str, end: str, figure: str) -> NDArray:
        """Of the best or the worst quarter of a ranking, ``[policies, scenes]``, in the scenes that have realism."""
        kept = self._with_realism()
        return np.array([[row[i]["realism"][ranking][end][figure] for i in kept] for row in self.rows])

    def random_realism(self, figure: str) -> NDArray:
        """The mean of random groups, ``[policies, scenes]``."""
        return np.array([[row[i]["realism"]["random"][figure] for i in self._with_realism()] for row in self.rows])

    def _with_realism(self) -> list[int]:
        return with_realism(self.rows, lambda scene: [scene["realism"]["random"]["realism"]])


def partial(xy: NDArray, xz: NDArray, yz: NDArray) -> NDArray:
    """Partial correlation of x and y with z held fixed, from the three correlations; nan where z decides x or y.

    Examples:
        >>> partial(np.array([0.48]), np.array([0.8]), np.array([0.6]))
        array([0.])
    """
    left = (1 - xz**2) * (1 - yz**2)
    return np.divide(xy - xz * yz, np.sqrt(np.maximum(left, 0)), out=np.full_like(xy, np.nan), where=left > 1e-12)


def summarise(measured: dict[str, list[dict]]) -> dict[str, Any]:
    """All tables of the study, with intervals over policies and scenes.

    Args:
        measured: see :class:`Ranked`.

    Returns:
        ``auc`` of the discriminator and of either jerk alone (share of rollouts that have more of it than the log);
        ``correlation`` of each ranking and of ``random`` scores with each quantity, and ``given`` (that of the
        discriminator, with another quantity held fixed); ``jerk_minus_distance``: how much more
        strongly the discriminator goes with jerk than with the preference distance, absolute correlations of each
        scene; ``realism`` of the ``best`` and the ``worst`` quarter of each ranking minus that of random groups; and
        ``minus``, that of the discriminator's best quarter minus that of another ranking. An entry is None where no
        scene tells rollouts apart.

    Raises:
        ValueError: no scene has realism, or the discriminator or the distance tells rollouts apart in none.
    """
    found = Ranked(measured)
    correlation, given = {}, {}
    for quantity in QUANTITIES:
        each = {name: found.correlation(name, quantity) for name in RANKINGS} | {"random": found.random(quantity)}
        correlation[quantity] = {name: known(values) for name, values in each.items()}
        given[quantity] = {
            fixed: known(found.given("discriminator", quantity, fixed)) for fixed in GIVEN if fixed != quantity
        }
    # Logs may be the smoother side or the rougher one, so what counts is the strength and not the sign.
    jerk, distance = (np.abs(found.correlation("discriminator", quantity)) for quantity in ("jerk", "distance"))
    figures = list(found.rows[0][found._with_realism()[0]]["realism"]["random"])
    best = {name: found.realism(name, "best", "realism") for name in RANKINGS}
    return {
        "auc": {"discriminator": summary(found.auc())} | {q: summary(found.auc_of(q)) for q in ("jerk", "jerk_2hz")},
        "correlation": correlation,
        "given": given,
        "jerk_minus_distance": over_scenes(jerk - distance, "discriminator"),
        "realism": {
            name: {
                end: {f: paired_bootstrap(found.realism(name, end, f), found.random_realism(f)) for f in figures}
                for end in ("best", "worst")
            }
            for name in RANKINGS
        },
        "minus": {name: paired_bootstrap(best["discriminator"], best[name]) for name in ("distance", "ade")},
    }


def known(values: NDArray) -> Interval | None:
    """Mean over the scenes at which every policy has a value; None where there is none."""
    return None if np.isnan(values).any(0).all() else over_scenes(values, "correlation")


def _share_below(values: NDArray, log: NDArray) -> NDArray:
    """Share of ``[..., K]`` below ``[...]``; a tie is half of one."""
    return ((values < log[..., None]) + 0.5 * (values == log[..., None])).mean(-1)
