"""Options of what a method learns from (``method.data``), counted and checked before any work."""

from __future__ import annotations

from typing import get_args

from omegaconf import DictConfig, OmegaConf

from dpa.models import Decoding
from dpa.ranking import Distance
from dpa.rewards import Baseline, Scale, check_rewards
from envs import keys
from recipes.common.cli import build
from recipes.common.limits import is_number
from recipes.common.rankings import build_distance

SIDES = {
    "pairs": "pairs",
    "best": "targets",
    "sets": "sets",
    "ranking": "ranking",
    "adversarial": "pairs",
    "expert": "pairs",
    "closed_loop": "targets",
    "own_pairs": "pairs in parts",
    "own_groups": "groups",
}
"""Ways to learn from the rollouts of a scene (``config/method``), and what each gives: M pairs (of rollouts made in the
step they are passed in parts, as ``alignment.max_rows`` has room), M targets to imitate, two sets of any sizes, one
ranking, whose nearer half is the preferred side and the rest the unpreferred one, or all rollouts, each with its
advantage."""
ROLLED = ("own_pairs", "own_groups")
"""Those of them that rank rollouts of the policy as it is, drawn anew in every step."""
ON_POLICY = ("closed_loop", *ROLLED)
"""Those of them that roll the policy out themselves, in every step, and need no rollouts from before."""
RANKED = ("pairs", "best", "sets", "ranking", "own_pairs")
"""Those of them that read ranks."""
PAIRED = ("pairs", "own_pairs")
"""Those of them that pair rollouts by rank."""
READ = {
    "pairs": ("rank_by", "pairs", "num", "margin", "rankings_per_scene"),
    "best": ("rank_by", "num"),
    "sets": ("rank_by", "num", "num_unpreferred"),
    "ranking": ("rank_by", "num"),
    "adversarial": ("num",),
    "expert": ("num",),
    "closed_loop": ("candidates", "recovery"),
    "own_pairs": ("num_rollouts", "decoding", "ranking", "rank_by", "pairs", "num"),
    "own_groups": ("num_rollouts", "ranking", "rewards", "baseline", "scale", "passes"),
}
"""Options of each beside ``kind``."""
PAIRS = ("nearest_farthest", "random", "all")
"""Ways to pair the rollouts of a group."""


def num_candidates(data: DictConfig, held: int) -> tuple[int, int]:
    """How many rollouts of a scene that is learnt from stand on either side, M and N; a margin may leave fewer.

    Args:
        data: of a method, see :func:`~recipes.alignment.candidates.make_candidates`.
        held: K, rollouts of a scene.

    Examples:
        >>> data = OmegaConf.create({"kind": "sets", "rank_by": "distance", "num": 0.25, "num_unpreferred": 16})
        >>> num_candidates(data, held=32)
        (8, 16)
    """
    data = check_data(data, held)
    if data.kind == "closed_loop":
        return 1, 0
    if data.kind in ROLLED:
        held = data.num_rollouts
    if data.kind == "own_groups":
        return held, 0
    if data.kind == "ranking":
        whole = data.num or held
        return (whole + 1) // 2, whole // 2
    num = held * (held - 1) // 2 if data.kind in PAIRED and data.pairs == "all" else data.num
    if data.kind == "pairs" and data.rankings_per_scene is not None:
        num = min(num, max(1, int(data.rankings_per_scene)))  # of half a pair in the mean, a scene has one or none
    return num, {"best": 0, "sets": data.get("num_unpreferred")}.get(data.kind, num)


def check_data(data: DictConfig, held: int) -> DictConfig:
    """Refuse options of a method's data before any work.

    Args:
        data: of a method, see :func:`~recipes.alignment.candidates.make_candidates`.
        held: K, rollouts of a scene; of what a method rolls out itself, its options say so.

    Returns:
        The options, shares of the rollouts as whole numbers.

    Raises:
        ValueError: an unknown kind, option, ranking or way to pair, or more rollouts than there are.
    """
    if data.get("kind") in ROLLED:
        check_rolling(data)
        held = data.num_rollouts
    counted = _counted(data, held)
    _check(counted, held, data)
    return counted


def rewards_of(data: DictConfig) -> dict[str, float]:
    """Weights of the rewards that a method follows; none of most methods."""
    return {name: weight for name, weight in data.get("rewards", {}).items() if weight}


def check_rolling(data: DictConfig) -> tuple[Decoding, Distance]:
    """How a method draws rollouts of its own, and what ranks them.

    Args:
        data: of a kind in :data:`ROLLED`.

    Raises:
        ValueError: naming the option that cannot be.
    """
    _check_read(data)
    if missing := [name for name in READ[data.kind] if name not in data]:
        raise ValueError(
            f"method.data.kind={data.kind} needs method.data.{missing[0]}; begin with method=rloo or "
            "method=dpa_omf_on_policy, which have all of it."
        )
    if type(data.num_rollouts) is not int or data.num_rollouts < 2:
        raise ValueError(
            f"method.data.num_rollouts must be 2 or more, got {data.num_rollouts!r}: a rollout is ranked among others."
        )
    # A policy gradient is one of rollouts that are drawn from the policy itself.
    own = {"top_p": 1.0} if data.kind == "own_groups" else data.decoding
    decoding = build(Decoding, OmegaConf.create(own), "method.data.decoding")
    return decoding, build_distance(data.ranking, "method.data.ranking")


def _counted(data: DictConfig, held: int) -> DictConfig:
    """Shares of a scene's rollouts as whole numbers, at least one."""
    shares = {name: data.get(name) for name in ("num", "num_unpreferred") if isinstance(data.get(name), float)}
    for name, share in shares.items():
        if not 0 < share < 1:
            raise ValueError(f"method.data.{name} must be a whole number, or a share between 0 and 1, got {share}.")
    return OmegaConf.merge(data, {name: max(1, round(share * held)) for name, share in shares.items()})


def _asked(given: DictConfig, data: DictConfig, name: str) -> str:
    """An option as it was given, and the number that it stands for where it is a share."""
    told = f"method.data.{name}={given[name]}"
    return told if given[name] == data[name] else f"{told} ({data[name]})"


def _check(data: DictConfig, held: int, given: DictConfig) -> None:
    if data.kind not in SIDES:
        raise ValueError(f"method.data.kind must be one of {', '.join(SIDES)}, got {data.kind!r}.")
    _check_read(data)
    if data.kind == "own_groups":
        return _check_groups(data)
    if data.kind == "closed_loop":
        if type(data.get("candidates")) is not int or data.candidates < 1:
            raise ValueError(f"method.data.candidates must be 1 or more, got {data.get('candidates')!r}.")
        if not is_number(data.get("recovery")) or not 0 < data.recovery <= 1:
            raise ValueError(f"method.data.recovery must lie in (0, 1], got {data.get('recovery')!r}.")
        return None
    if data.kind in RANKED and data.rank_by not in (keys.DISTANCE, keys.ADE):
        raise ValueError(f"method.data.rank_by must be distance or ade, got {data.rank_by!r}.")
    if data.kind in PAIRED and data.pairs not in PAIRS:
        raise ValueError(f"method.data.pairs must be one of {', '.join(PAIRS)}, got {data.pairs!r}.")
    if data.kind in PAIRED and data.pairs == "all":
        if data.num is not None:
            raise ValueError(
                f"method.data.pairs=all takes every pair, and {_asked(given, data, 'num')} asks for some; say "
                "method.data.num=null" + (", and rankings_per_scene to keep fewer." if data.kind == "pairs" else ".")
            )
        return _check_pairs(data, held * (held - 1) // 2) if data.kind == "pairs" else None
    if data.kind == "ranking" and data.num is None:
        return None
    for name in ("num", "num_unpreferred") if data.kind == "sets" else ("num",):
        if type(data.get(name)) is not int:
            raise ValueError(
                f"method.data.{name} must be a whole number, or a share between 0 and 1, got {data.get(name)!r}."
            )
        if data[name] < 1:
            raise ValueError(f"method.data.{name} must be 1 or more, got {data[name]}.")
    _check_enough(data, held, given)
    return _check_pairs(data, data.num) if data.kind == "pairs" else None


def _check_read(data: DictConfig) -> None:
    read = READ[data.kind]
    if unread := sorted(set(map(str, data)) - {"kind", *read}):
        raise ValueError(
            f"method.data.{unread[0]} says nothing to method.data.kind={data.kind}, which takes {', '.join(read)}; "
            f"leave it out (~method.data.{unread[0]})."
        )


def _check_groups(data: DictConfig) -> None:
    for name, known in (("baseline", get_args(Baseline)), ("scale", get_args(Scale))):
        if data[name] not in known:
            raise ValueError(f"method.data.{name} must be {' or '.join(known)}, got {data[name]!r}.")
    for name, weight in data.rewards.items():
        if not is_number(weight):
            raise ValueError(f"method.data.rewards.{name} must be a number, got {weight!r}.")
    check_rewards(data.rewards, build_distance(data.ranking, "method.data.ranking"))


def _check_pairs(data: DictConfig, pairs: int) -> None:
    if data.margin < 0:
        raise ValueError(f"method.data.margin must be 0 or more, got {data.margin}.")
    if data.rankings_per_scene is None:
        return
    if not data.rankings_per_scene > 0:
        raise ValueError(f"method.data.rankings_per_scene must be positive, got {data.rankings_per_scene}.")
    if data.rankings_per_scene > pairs:
        raise ValueError(
            f"method.data.rankings_per_scene={data.rankings_per_scene} and a scene has {pairs} pairs; lower it, take "
            "more of the rollouts (method.data.num), or collect more of them."
        )


def _check_enough(data: DictConfig, held: int, given: DictConfig) -> None:
    asked, needed = _asked(given, data, "num"), data.num
    if data.kind in PAIRED:
        needed *= 2
    elif data.kind == "sets":
        asked = f"{asked} and {_asked(given, data, 'num_unpreferred')}"
        needed += data.num_unpreferred
    elif data.kind == "ranking" and data.num < 2:
        raise ValueError(f"a ranking needs two rollouts, got {asked}; say 2 or more, or null for all.")
    if needed > held:
        raise ValueError(
            f"{asked} needs {needed} rollouts of a scene and there are {held}; lower it, or "
            + (
                "raise method.data.num_rollouts."
                if data.kind in ROLLED
                else "collect again with a larger collection.num_rollouts."
            )
        )
