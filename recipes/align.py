"""Align a policy with the preferences among its own rollouts (METHOD sections 5 and 6).

    python -m recipes.align method=dpa_omf policy=runs/pretrain/policy.pt preferences=runs/preferences
    torchrun --nproc-per-node 2 -m recipes.align method=dpa_omf policy=FILE preferences=DIR  # docs/scale.md

Methods differ in one YAML each: dpa_omf, dpa_adef, sft_best_oa, sft_best_ade, adversarial_afd, and others under
``config/method``. Run the same command again to go on after a kill.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import hydra
from numpy import nanmean
from omegaconf import DictConfig
from torchrl.objectives import LossModule

from dpa.losses import (
    ContrastivePreferenceLoss,
    KahnemanTverskyLoss,
    NextTokenLoss,
    PlackettLuceLoss,
    SaturationWatch,
    token_network,
)
from dpa.policy import ContextOptions, MotionLM
from dpa.preferences import PreferenceStore
from dpa.report.figures import read_curves
from dpa.training.batches import ShuffledOrder
from dpa.training.distributed import ALONE, Ranks, join_ranks
from dpa.training.optim import accumulate_gradients, clip_and_step, make_optimizer, make_schedule
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs.progress import message
from envs.seeding import make_generator
from envs.store import SceneStore
from recipes.candidates import SIDES, make_candidates
from recipes.cli import CONFIG, build, check_steps, finished, finite, plain, ranked_recipe, write_json
from recipes.draws import parts_of
from recipes.likelihoods import PROBED, make_probes, probe
from recipes.models import open_policy, weights_digest, write_policy
from recipes.rankings import open_preferences
from recipes.scenes import open_splits

LOSSES: dict[str, type[LossModule]] = {
    "contrastive": ContrastivePreferenceLoss,
    "kahneman_tversky": KahnemanTverskyLoss,
    "plackett_luce": PlackettLuceLoss,
    "next_token": NextTokenLoss,
}
"""Losses that a method's YAML can name."""
FITS = {"pairs": ("pairs",), "sets": ("pairs", "sets"), "ranking": ("ranking",), "targets": ("targets",)}
"""What a loss can read, by its ``sides``: pairs may be read as two sets."""


class Watch(NamedTuple):
    """Scenes that no loss sees, and ranked rollouts of them, to look at along the way.

    Attributes:
        scenes: tuning scenes.
        preferences: folder of a store of ranked rollouts of them.
    """

    scenes: SceneStore
    preferences: Path


def align(
    cfg: DictConfig,
    method: DictConfig,
    scenes: SceneStore,
    policy: Path,
    preferences: Path,
    seed: int,
    folder: Path,
    ranks: Ranks = ALONE,
    *,
    expert: Path | None = None,
    watch: Watch | None = None,
) -> Path:
    """Fine-tune a policy with one method.

    Args:
        cfg: with the sections ``alignment``, ``logger``, ``device``.
        method: ``data`` and ``loss``, from ``config/method``.
        scenes: that the preferences are of.
        policy: file of the policy to start from, which is also the reference of the loss.
        preferences: folder of the store that :mod:`recipes.collect` made with it.
        seed: of batches and dropout.
        folder: of the run; snapshots are kept in ``step_<step>`` inside.
        ranks: that train together; the scenes of a step are theirs together.
        expert: folder of the store with the rollouts of an expert (``data.kind: expert``).
        watch: what is looked at every ``alignment.watch_interval`` steps, for the curves ``tune/*``.

    Returns:
        The file of the aligned policy.

    Raises:
        ValueError: preferences of other scenes or of another policy, an unknown loss, or options that do not fit it.
    """
    check_fit(method)
    options, path, result = cfg.alignment, folder / "policy.pt", folder / "result.json"
    ranks.share_of(options.scenes_per_step, "alignment.scenes_per_step")
    device = ranks.place(cfg.device)
    model, context, config = open_policy(policy, device)
    store = open_preferences(preferences, scenes, model, policy)
    decided_by = {
        "data": plain(method.data),
        "loss": plain(method.loss),
        "alignment": plain(options),
        "seed": seed,
        "reference": weights_digest(model),
        "ranking": store.provenance.ranking,
        "expert": None if expert is None else PreferenceStore(expert).provenance.policy,
    }
    if ranks.agree(finished(result, decided_by) is not None and path.is_file(), "finished =", folder):
        return path
    seed_everything(seed)
    candidates = make_candidates(method.data, store, scenes, context, model.tokenizer.cpu(), seed)
    counts = {len(group.preferred) for group in candidates}
    if len(counts) > 1 and min(counts) < options.pairs_per_scene:
        raise ValueError(
            f"alignment.pairs_per_scene={options.pairs_per_scene} and scenes have {min(counts)} to {max(counts)} pairs "
            f"after method.data.margin and rankings_per_scene; say alignment.pairs_per_scene={min(counts)}."
        )
    loss = ranks.wrap(make_loss(method.loss, model.to(device).train()))
    optimizer = make_optimizer(model, options.lr, options.weight_decay)
    schedule = make_schedule(optimizer, options.steps, options.warmup)
    saturation = SaturationWatch(method.loss)
    order = ShuffledOrder(len(candidates), options.scenes_per_step, seed)
    run = Run(
        folder,
        {"policy": model, "optimizer": optimizer, "schedule": schedule},
        config=decided_by,
        total_steps=options.steps,
        checkpoint_interval=options.checkpoint_interval,
        backend=cfg.logger.backend,
        mode=cfg.logger.mode,
        description=method.name,
        ranks=ranks,
    )
    look = Look(watch, context, model, options) if watch is not None and ranks.main else None
    described = {"method": method.name, "seed": seed, "options": decided_by}
    with run:
        for step in run.steps():
            if look is not None and step % options.watch_interval == 0:
                run.log(look(device), step)
            draw = make_generator(seed, "pairs", step)
            groups = [candidates[i] for i in order(step)]
            ranks.seed_dropout(seed, step)
            losses = accumulate_gradients(loss, parts_of(groups, options, draw, device, ranks), ranks)
            norm = clip_and_step(optimizer, options.max_norm, schedule)
            if (warning := saturation(step, losses)) and ranks.main:
                message(warning)
            run.log({f"train/{key}": value for key, value in losses.items()} | {"train/gradient_norm": norm})
            if ranks.main and step + 1 in options.snapshots:
                write_policy(folder / f"step_{step + 1}" / "policy.pt", model, config, described | {"step": step + 1})
        if look is not None:
            run.log(look(device), options.steps)
    if ranks.main:
        write_policy(path, model, config, described)
        last = {name: finite(curve["value"][-1]) for name, curve in read_curves(folder).items()}
        write_json(result, {"options": decided_by, "policy": str(path), "last_step": last})
    ranks.wait()
    return path


class Look:
    """A look at the policy in training: what it thinks of logs and rollouts of scenes that no loss sees.

    Args:
        watch: the scenes.
        context: how scenes are cut up.
        model: in training.
        options: the section ``alignment``.
    """

    def __init__(self, watch: Watch, context: ContextOptions, model: MotionLM, options: DictConfig) -> None:
        store = PreferenceStore(watch.preferences)
        rows = range(min(options.watch_scenes, len(store)))
        pairs = min(options.watch_pairs, store.provenance.num_rollouts // 2)
        self.model, self.probes = model, make_probes(store, watch.scenes, context, model.tokenizer, pairs, rows)

    def __call__(self, device: str) -> dict[str, float]:
        """Means over the scenes, as curves are named."""
        training = self.model.training
        self.model.eval()
        found = probe(self.model, self.probes, device)
        self.model.train(training)
        return {f"tune/{name}": nanmean([each[name] for each in found]) for name in PROBED}


def make_loss(section: DictConfig, model: MotionLM) -> LossModule:
    """The loss that a method names, around the model; a reference copy is the model as it is now."""
    options = {key: value for key, value in section.items() if key != "kind"}
    if section.kind not in LOSSES:
        raise ValueError(f"method.loss.kind must be one of {sorted(LOSSES)}, got {section.kind!r}.")
    return build(LOSSES[section.kind], DictConfig(options), f"method.loss ({section.kind})", token_network(model))


def check_fit(method: DictConfig) -> None:
    """Refuse a loss that would misread what the method learns from; a loss that has no ``sides`` takes anything.

    Raises:
        ValueError: for instance a ranking loss for pairs.
    """
    wanted = getattr(LOSSES.get(method.loss.kind), "sides", None)
    given = SIDES.get(method.data.kind)
    if wanted is None or given is None or given in FITS[wanted]:
        return
    kinds = [kind for kind, sides in SIDES.items() if sides in FITS[wanted]]
    raise ValueError(
        f"method.loss.kind={method.loss.kind} learns from {wanted}, and method.data.kind={method.data.kind} gives "
        f"{given}; say method.data.kind={' or '.join(kinds)}, or another loss."
    )


@hydra.main(**CONFIG, config_name="align")
@ranked_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.align``."""
    check_steps(cfg.alignment, "alignment")
    splits = open_splits(cfg.scenes)
    policy, preferences = Path(cfg.policy), Path(cfg.preferences)
    expert = None if cfg.expert is None else Path(cfg.expert)
    watch = None if cfg.watch is None else Watch(splits.tune, Path(cfg.watch))
    with join_ranks(cfg.device) as ranks:
        path = align(
            cfg,
            cfg.method,
            splits.train,
            policy,
            preferences,
            cfg.seed,
            Path(cfg.output),
            ranks,
            expert=expert,
            watch=watch,
        )
        if ranks.main:
            print(f"policy: {path}")


if __name__ == "__main__":
    main()
