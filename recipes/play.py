"""Look at what policies do: a page that plays some scenes, or a picture or film of the most likely rollouts.

    python -m recipes.play policies=[runs/pretrain/policy.pt,runs/dpa_omf/policy.pt]
    python -m recipes.play policies=[runs/pretrain/policy.pt,runs/dpa_omf/policy.pt] output=runs/likely.png
    python -m recipes.play policies=[runs/pretrain/policy.pt,runs/dpa_omf/policy.pt] output=runs/likely.gif

Of many rollouts of each scene and policy the page keeps a few: the most likely one, and some from the one nearest to
the log to the farthest. The picture and the film show the most likely ones alone (figures 5 and 9 of the paper).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor

from dpa.models import Decoding
from dpa.ranking import Distance, PreferenceDistance
from dpa.report.film import film_likely
from dpa.report.judged import JudgedRollouts, judge_rollouts
from dpa.report.likely import plot_likely
from dpa.report.page import write_rollouts
from dpa.report.player import PlayerScene
from dpa.rollout import make_collector
from envs import keys
from envs.render import check_writable
from envs.store import SceneStore
from recipes.common.cli import CONFIG, build, recipe
from recipes.common.models import given_policies, open_policy
from recipes.common.rankings import build_distance
from recipes.common.rolled import rolled
from recipes.common.scenes import open_splits

PAPER_DISTANCE = PreferenceDistance()
DRAWN = {".png": plot_likely, ".gif": film_likely, ".mp4": film_likely}
"""Endings of pictures of the most likely rollouts, and what makes them."""


def roll_out(
    policies: Mapping[str, Path],
    scenes: SceneStore,
    wanted: Sequence[int],
    *,
    decoding: Decoding | Mapping[str, Decoding],
    num_rollouts: int = 64,
    kept: int = 6,
    distance: Distance = PAPER_DISTANCE,
    seed: int = 0,
    device: str = "cpu",
) -> list[PlayerScene]:
    """The same scenes with rollouts of every policy.

    Args:
        policies: name -> file.
        scenes: to roll out.
        wanted: indices of the scenes.
        decoding: how tokens are drawn, by all policies alike or by each in a way of its own.
        num_rollouts: of each scene and policy.
        kept: of these, from the nearest to the farthest; the most likely one may come on top.
        distance: how rollouts are compared with the log.
        seed: of the sampling, the same for every policy.
        device: of the policies.

    Raises:
        ValueError: a distance that couples nothing, or a policy without a decoding.
    """
    if not isinstance(distance, PreferenceDistance):
        raise ValueError(f"the player shows couplings, and {distance} couples nothing; give kind: preference.")
    judged: dict[int, dict[str, JudgedRollouts]] = {index: {} for index in wanted}
    for name, path in policies.items():
        model, episode, _ = open_policy(path, device)
        batches = make_collector(
            scenes,
            model,
            num_rollouts=num_rollouts,
            indices=wanted,
            decoding=_decoding_of(name, decoding),
            options=episode,
            seed=seed,
            device=device,
        )
        for batch in batches:
            likelihood = log_likelihood(batch, num_rollouts)
            for row, each in enumerate(rolled([batch], scenes, num_rollouts)):
                judged[each.index][name] = judge_rollouts(
                    each.scene, each.trajectories, each.controlled, likelihood[row], distance, kept
                )
    return [PlayerScene(scenes[index], judged[index]) for index in wanted]


def _decoding_of(name: str, decoding: Decoding | Mapping[str, Decoding]) -> Decoding:
    if isinstance(decoding, Decoding):
        return decoding
    if name not in decoding:
        raise ValueError(f"policy {name!r} has no decoding; there are some for {', '.join(decoding) or 'none'}.")
    return decoding[name]


def log_likelihood(batch: TensorDictBase, num_rollouts: int) -> Tensor:
    """How likely rollouts are under the policy that made them, whatever distribution they were drawn from.

    Args:
        batch: of a collector, ``[S * K, T]``.
        num_rollouts: K.

    Returns:
        ``[S, K]`` log-probability of a token at temperature 1 (of patches: log-density, the higher the more of its
        agents move), mean over the tokens of controlled agents [nats]; NaN where there are none.

    Examples:
        >>> from dpa.models.motionlm import MotionLM
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> model = MotionLM("nano", VerletTokenizer())
        >>> (batch,) = make_collector([straight_road(2)], model, num_rollouts=4)
        >>> bool((log_likelihood(batch, 4) < 0).all())
        True
    """
    counts = batch[keys.CONTROLLED] & batch[keys.VALID]
    total = torch.where(counts, batch[keys.LOG_PROB].double(), 0).sum((1, 2))
    return (total / counts.sum((1, 2))).float().view(-1, num_rollouts).cpu()


def chosen_scenes(scenes: SceneStore, chosen: Sequence[int | str]) -> list[int]:
    """Indices of scenes that are given by id or by index.

    Raises:
        SceneError: no such scene.
        ValueError: none is given.
    """
    if not chosen:
        raise ValueError("show=[] names no scene; say for example show=[0,1].")
    return [scenes.find(str(name)) for name in chosen]


@hydra.main(**CONFIG, config_name="play")
@recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.play``."""
    if Path(cfg.output).suffix not in (".html", *DRAWN):
        known = ", ".join((".html", *DRAWN))
        raise ValueError(f"output={cfg.output} is no page, picture or film; name a file that ends in one of {known}.")
    check_writable(cfg.output)
    Path(cfg.output).parent.mkdir(parents=True, exist_ok=True)
    policies = given_policies(cfg)
    scenes = open_splits(cfg.scenes)[cfg.split]
    players = roll_out(
        policies,
        scenes,
        chosen_scenes(scenes, cfg.show),
        decoding=build(Decoding, cfg.decoding, "decoding"),
        num_rollouts=cfg.num_rollouts,
        kept=cfg.kept,
        distance=build_distance(cfg.ranking, "ranking"),
        seed=cfg.seed,
        device=cfg.device,
    )
    if draw := DRAWN.get(Path(cfg.output).suffix):
        draw(players, cfg.output)
        print(f"{'film' if draw is film_likely else 'picture'}: {cfg.output}")
        return
    facts = {name: str(path) for name, path in policies.items()} | {
        "decoding": f"top-p {cfg.decoding.top_p:g}, temperature {cfg.decoding.temperature:g}, seed {cfg.seed}",
        "rollouts": f"{cfg.num_rollouts} of each scene; {cfg.kept} from the nearest to the farthest, and the likeliest",
    }
    print(f"page: {write_rollouts(cfg.output, players, facts)}")


if __name__ == "__main__":
    main()
