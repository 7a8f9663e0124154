"""Align a policy with the preferences among its own rollouts (method.md sections 5 and 6).

    python -m recipes.align method=dpa_omf policy=runs/pretrain/policy.pt preferences=runs/preferences
    torchrun --nproc-per-node 2 -m recipes.align method=dpa_omf policy=FILE preferences=DIR  # docs/scale.md

Methods differ in one YAML each: dpa_omf, dpa_adef, sft_best_oa, sft_best_ade, adversarial_afd, and others under
``config/method``. Some roll the policy out by themselves and take no preferences: CAT-K (``method=cat_k``), which
learns from logs, and those that learn from rollouts of the policy as it is (``rloo``, ``grpo``, ``dpa_omf_on_policy``).
Run the same command again to go on after a kill.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig, OmegaConf

from dpa.losses import SaturationWatch
from dpa.training.distributed import ALONE, Ranks, join_ranks
from dpa.training.loggers import read_curves
from dpa.training.run import Run
from dpa.training.seeding import seed_everything
from envs import keys
from envs.files import write_json
from envs.progress import full_name, message
from envs.store import SceneStore
from recipes.alignment.closed_loop import ClosedLoopStep
from recipes.alignment.data import ON_POLICY, ROLLED, check_data
from recipes.alignment.inputs import Inputs
from recipes.alignment.losses import check_fit, make_loss
from recipes.alignment.on_policy import OnPolicyStep
from recipes.alignment.snapshots import Snapshots
from recipes.alignment.step import AlignmentStep
from recipes.alignment.watch import Watch
from recipes.common.cli import CONFIG, check_steps, finished, finite, ranked_recipe
from recipes.common.models import check_written, given_policy, write_policy
from recipes.common.scenes import open_splits

SATURATED = "saturated"
"""Entry of ``result.json`` that only a run with a saturated loss has: the warning."""


def align(
    cfg: DictConfig,
    method: DictConfig,
    scenes: SceneStore,
    policy: Path,
    preferences: Path | None,
    seed: int,
    folder: Path,
    ranks: Ranks = ALONE,
    *,
    expert: Path | None = None,
    watch: Watch | None = None,
    among: Sequence[int] | None = None,
    section: str = "method",
) -> Path:
    """Fine-tune a policy with one method.

    The policy is trained without dropout: methods compare log-likelihoods of whole rollouts, in whose differences its
    noise would be all that counts at first.

    Args:
        cfg: with the sections ``alignment``, ``logger``, ``device``.
        method: ``data`` and ``loss``, from ``config/method``.
        scenes: that the preferences are of.
        policy: file of the policy to start from, which is also the reference of the loss.
        preferences: folder of the store that :mod:`recipes.collect` made with it; None for a method that rolls out
            by itself.
        seed: of batches.
        folder: of the run; snapshots are kept in ``step_<step>`` inside.
        ranks: that train together; the scenes of a step are theirs together.
        expert: folder of the store with the rollouts of an expert (``data.kind: expert``).
        watch: what is looked at every ``alignment.watch_interval`` steps, for the curves ``tune/*``. A method that
            imitates rollouts is looked at as often, with or without it, for what a preference loss logs by itself.
        among: indices of the scenes to learn from; by default all that the preferences are of.
        section: where ``method`` stands in the configuration of the command, for what is told of its options.

    Returns:
        The file of the aligned policy.

    Raises:
        ValueError: preferences of other scenes or of another policy, an unknown loss, or options that do not fit it.
    """
    options, path, result = cfg.alignment, folder / "policy.pt", folder / "result.json"
    ranks.share_of(options.scenes_per_step, "alignment.scenes_per_step")
    device = ranks.place(cfg.device)
    check_preferences(method, preferences, expert, section)
    inputs = Inputs.open(policy, preferences, expert, scenes, among, device)
    check_fit(method, options, 0 if inputs.store is None else inputs.store.provenance.num_rollouts)
    model, decided_by = inputs.model, inputs.deciding(method, options, seed)
    snapshots = Snapshots.of(folder, options)
    kept = finished(result, decided_by)
    if ranks.agree(kept is not None and path.is_file(), "finished =", folder):
        snapshots.check(options.steps)
        check_written(path)
        tell(method, kept.get(SATURATED), ranks)
        return path
    seed_everything(seed)
    take = make_step(method, inputs, options, seed, device, ranks)
    looks = inputs.looks(method.data, options, watch) if ranks.main else []
    run = Run(
        folder,
        {"policy": model, "optimizer": take.optimizer, "schedule": take.schedule},
        config=decided_by,
        total_steps=options.steps,
        checkpoint_interval=options.checkpoint_interval,
        backend=cfg.logger.backend,
        mode=cfg.logger.mode,
        description=method.name,
        ranks=ranks,
    )
    saturation = SaturationWatch(method.loss, f"{section}.loss", run.state.setdefault(SATURATED, {}))
    described = {"method": method.name, "seed": seed, "options": decided_by}
    with run:
        snapshots.check(run.first_step)
        tell(method, saturation.found, ranks)
        for look in looks if run.first_step == 0 else ():
            run.log(look(device), 0)
        for step in run.steps():
            figures, done = take(step), step + 1
            tell(method, saturation(step, figures), ranks)
            run.log({f"train/{key}": value for key, value in figures.items()})
            for look in looks if done % options.watch_interval == 0 or done == options.steps else ():
                run.log(look(device))
            if ranks.main:
                snapshots.keep(done, model, inputs.config, described)
        if ranks.main:
            write_policy(path, model, inputs.config, described)
            write_result(result, path, decided_by, saturation)
    ranks.wait()
    return path


def make_step(
    method: DictConfig, inputs: Inputs, options: DictConfig, seed: int, device: str, ranks: Ranks
) -> AlignmentStep | ClosedLoopStep | OnPolicyStep:
    """What a step of the method does."""
    loss, model = make_loss(method.loss, inputs.model), inputs.model
    scenes = inputs.scenes.subset(inputs.learnt)
    if method.data.kind in ROLLED:
        loss = ranks.wrap(loss)
        return OnPolicyStep(model, loss, scenes, inputs.episode, method.data, options, seed, device, ranks)
    if method.data.kind == "closed_loop":
        check_data(method.data, 0)
        loss.set_keys(labels=keys.LABELS, learnt=keys.LEARNT)
        follow = {"candidates": method.data.candidates, "recovery": method.data.recovery}
        return ClosedLoopStep(model, ranks.wrap(loss), scenes, inputs.episode, follow, options, seed, device, ranks)
    candidates = inputs.candidates(method.data, seed)
    return AlignmentStep(model, ranks.wrap(loss), candidates, options, seed, device, ranks)


def check_preferences(method: DictConfig, preferences: Path | None, expert: Path | None, section: str) -> None:
    """Refuse a method without the rollouts that it learns from, or with some that it does not read.

    Raises:
        ValueError: so it is.
    """
    rolls = method.data.kind in ON_POLICY
    if rolls and (preferences is not None or expert is not None):
        raise ValueError(
            f"{section}={method.name} rolls the policy out by itself and reads no rollouts, got "
            f"preferences={preferences} and expert={expert}; leave them out."
        )
    if not rolls and preferences is None:
        raise ValueError(
            f"{section}={method.name} learns from ranked rollouts, and none are given; make them with recipes.collect "
            "and say preferences=DIR."
        )


def write_result(result: Path, policy: Path, decided_by: dict[str, Any], saturation: SaturationWatch) -> None:
    """Say that a run is finished: what decided it, its last figures, and the warning where its loss saturated."""
    last = {name: finite(curve[-1][1]) for name, curve in read_curves(result.parent).items()}
    warned = {} if saturation.found is None else {SATURATED: saturation.found}
    write_json(result, {"options": decided_by, "policy": str(policy), "last_step": last, **warned})


def tell(method: DictConfig, warning: str | None, ranks: Ranks) -> None:
    """Say what is wrong with a run, if anything is, under the name of its bar: others may write beside it."""
    if warning is not None and ranks.main:
        message(f"{full_name(method.name)}: {warning}")


@hydra.main(**CONFIG, config_name="align")
@ranked_recipe
def main(cfg: DictConfig) -> None:
    """Entry point of ``python -m recipes.align``."""
    check_steps(cfg.alignment, "alignment")
    policy = given_policy(cfg.policy)
    splits = open_splits(cfg.scenes)
    on_policy = cfg.method.data.kind in ON_POLICY and OmegaConf.is_missing(cfg, "preferences")
    preferences = None if on_policy else Path(cfg.preferences)
    expert = None if cfg.expert is None else Path(cfg.expert)
    watch = None if cfg.watch is None else Watch(splits.tune, Path(cfg.watch), policy)
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
