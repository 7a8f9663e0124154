"""Policies of the recipes: built from the configuration, saved and opened as one self-describing file."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from dpa import zoo
from dpa.models import MotionModel
from dpa.models.registry import build_model, family_of, size_of
from dpa.tokens import KDisksTokenizer, MotionTokenizer, PatchTokenizer, VerletTokenizer
from dpa.training.checkpoint import CheckpointError, load_policy, load_weights, save_policy
from envs.episode import EPISODE_STEPS, EpisodeOptions
from recipes.common.cli import CONFIG, build, plain

TOKENIZERS: dict[str, type[MotionTokenizer]] = {
    "verlet": VerletTokenizer,
    "k_disks": KDisksTokenizer,
    "patches": PatchTokenizer,
}
"""Tokenizers that a YAML can name; add a class of your own here (docs/how-to.md)."""


def tokenizer_class(name: str) -> type[MotionTokenizer]:
    """The tokenizer of a name.

    Raises:
        ValueError: there is none.
    """
    if name not in TOKENIZERS:
        raise ValueError(
            f"model.tokenizer.name must be one of {sorted(TOKENIZERS)}, got {name!r}; one of your own is a line in "
            f"TOKENIZERS of {__name__}."
        )
    return TOKENIZERS[name]


def tokenizer_config(cfg: DictConfig) -> dict[str, Any]:
    """What decides a tokenizer, from ``cfg.model.tokenizer``, as a checkpoint holds it.

    Raises:
        ValueError: there is no such tokenizer, or its file is none.
    """
    options = plain(cfg.tokenizer)
    return {"name": options["name"], **tokenizer_class(options["name"]).settled(**without_name(options))}


def episode_options(cfg: DictConfig) -> EpisodeOptions:
    """Who takes part, whom a policy moves and for how long, from ``cfg.model``: a decision lasts as long as a token."""
    if "decision_steps" in cfg.episode:
        raise ValueError("model.episode has no option 'decision_steps': a decision lasts as long as a token.")
    steps = build_tokenizer(tokenizer_config(cfg)).steps
    if steps < 1:
        raise ValueError(f"model.tokenizer ({cfg.tokenizer.name}): a token has 1 pose or more, got steps={steps}.")
    horizon = EPISODE_STEPS // steps if cfg.episode.horizon is None else cfg.episode.horizon
    told = OmegaConf.merge(cfg.episode, {"horizon": horizon})
    return build(EpisodeOptions, told, "model.episode", decision_steps=steps)


def policy_config(cfg: DictConfig) -> dict[str, Any]:
    """Everything that decides a policy's shape, from ``cfg.model``: what a checkpoint is compared with."""
    size, episode = size_of(cfg.family, cfg.size), episode_options(cfg)
    return {
        "family": cfg.family,
        "model": size | {"horizon": episode.horizon, "dropout": cfg.dropout},
        "context": asdict(build(family_of(cfg.family).context, cfg.context, "model.context")),
        "tokenizer": tokenizer_config(cfg),
        "episode": asdict(episode),
    }


def build_policy(config: dict[str, Any]) -> MotionModel:
    """A policy from :func:`policy_config`, whose weights are to be loaded."""
    return build_model(config, build_tokenizer(config["tokenizer"]))


def fresh_policy(cfg: DictConfig) -> MotionModel:
    """A policy that has learnt nothing, from ``cfg.model``."""
    model = build_policy(policy_config(cfg))
    model.tokenizer.fill(**without_name(plain(cfg.tokenizer)))
    return model


def without_name(section: Mapping[str, Any]) -> dict[str, Any]:
    """The other options of a section."""
    return {key: value for key, value in section.items() if key != "name"}


def named_models() -> list[str]:
    """Names of the models that have a YAML in ``recipes/config/model``.

    Examples:
        >>> {"nano", "small", "paper"} <= set(named_models())
        True
    """
    found = Path(CONFIG["config_path"], "model").glob("*.yaml")
    return sorted(path.stem for path in found if path.stem != "base")


def named_model(name: str) -> MotionModel:
    """A fresh policy by the name of its YAML.

    Examples:
        >>> named_model("nano").config.width
        48
    """
    with initialize_config_dir(CONFIG["config_path"], version_base=CONFIG["version_base"]):
        return fresh_policy(compose("pretrain", [f"model={name}"]).model)


def build_tokenizer(section: Mapping[str, Any]) -> MotionTokenizer:
    """The tokenizer that ``name`` of a section names, with the section's other options.

    Raises:
        ValueError: there is none of this name, or it does not take these options.
    """
    name = section["name"]
    return build(tokenizer_class(name), DictConfig(without_name(section)), f"model.tokenizer ({name})")


def write_policy(path: Path, model: MotionModel, config: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Save a policy with what it is and where it comes from."""
    save_policy(path, model.state_dict(), config, metadata)


def num_parameters(model: MotionModel) -> int:
    """Parameters of a policy; motions of a vocabulary are none."""
    return sum(value.numel() for value in model.parameters())


def check_written(path: Path) -> None:
    """Refuse a finished training whose policy was damaged since.

    Raises:
        ValueError: it was; the message says how to have it trained again.
    """
    try:
        load_policy(path)
    except CheckpointError as error:
        raise ValueError(f"{error} To train it again, remove {path.parent}.") from None


def policy_file(name: str | Path) -> Path:
    """The file of a policy: of one in the zoo where the name begins with ``zoo:``, otherwise the path itself.

    Raises:
        ValueError: the zoo has no such policy, or its file there is damaged.

    Examples:
        >>> policy_file("runs/pretrain/policy.pt").name
        'policy.pt'
    """
    text = str(name)
    return zoo.find(text.removeprefix(zoo.PREFIX)) if text.startswith(zoo.PREFIX) else Path(name)


def given_policy(name: str) -> Path:
    """The file of the policy that a recipe is given, which is whole: asked before scenes are converted for it.

    Args:
        name: file, or ``zoo:NAME``.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: the file is damaged or no policy.
        ValueError: the zoo has no such policy.

    Examples:
        >>> given_policy("zoo:motionlm-nano-sumo").name
        'policy.pt'
    """
    file = policy_file(name)
    load_policy(file)
    return file


def open_policy(path: str | Path, device: str = "cpu") -> tuple[MotionModel, EpisodeOptions, dict[str, Any]]:
    """A saved policy, the options of its episodes and its configuration.

    Args:
        path: file, or ``zoo:NAME``.
        device: of the policy.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: the file is damaged or no policy.
        ValueError: the zoo has no such policy.
    """
    weights, config, _ = load_policy(policy_file(path))
    try:
        model, episode = build_policy(config), EpisodeOptions(**config["episode"])
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        told = error if isinstance(error, ValueError) else repr(error)
        raise CheckpointError(f"{path} has a configuration that makes no policy: {told}") from None
    load_weights(model, weights, config, config, where=str(path))
    return model.to(device).eval(), episode, config


def policies_of(cfg: DictConfig) -> dict[str, Path]:
    """Files of the policies that ``cfg.policies`` lists.

    Args:
        cfg: with ``policies``, a path or a list of them, or names in the zoo. A path may have the wildcards of a
            shell, as in ``runs/mine/seed_*/reference/policy.pt``: the references of all seeds of a study.

    Returns:
        By the name of their run's folder, or by their whole path where that is not enough; those of a wildcard in
        order of name.

    Raises:
        ValueError: it lists none, or nothing is like a wildcard.

    Examples:
        >>> cfg = DictConfig({"policies": ["runs/pretrain/policy.pt", "runs/dpa_omf/policy.pt"]})
        >>> list(policies_of(cfg))
        ['pretrain', 'dpa_omf']
        >>> cfg.policies = ["seed_0/dpa_omf/policy.pt", "seed_1/dpa_omf/policy.pt"]
        >>> list(policies_of(cfg))
        ['seed_0/dpa_omf/policy.pt', 'seed_1/dpa_omf/policy.pt']
    """
    entries = [cfg.policies] if isinstance(cfg.policies, str) else cfg.policies
    paths = [path for entry in entries for path in _like(entry)]
    if not paths:
        raise ValueError("policies=[] names no policy; say for example policies=[runs/pretrain/policy.pt].")
    names = [Path(path).absolute().parent.name for path in paths]
    return dict(zip(names if len({*names}) == len(names) else paths, map(Path, paths), strict=True))


def given_policies(cfg: DictConfig) -> dict[str, Path]:
    """The policies of :func:`policies_of`, which are whole: asked before scenes are converted for them.

    So a slip in the last path is told before the hours of the first.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: a file is damaged or no policy.
        ValueError: no policy is named, or nothing is like a wildcard.
    """
    policies = policies_of(cfg)
    for path in policies.values():
        load_policy(path)
    return policies


def _like(path: str) -> list[str]:
    """The file itself, or those that are like it where its name has wildcards."""
    if path.startswith(zoo.PREFIX):
        return [str(policy_file(path))]
    if not glob.has_magic(path) or Path(path).exists():
        return [path]
    found = sorted(glob.glob(path))
    if not found:
        raise ValueError(f"policies: no file is like {path}; check the folder, or give the files by name.")
    return found


def weights_digest(model: torch.nn.Module) -> str:
    """Digest of a policy's parameters."""
    return digest_of(model.state_dict())


def digest_of(weights: Mapping[str, torch.Tensor]) -> str:
    """Digest of parameters."""
    digest = hashlib.sha256()
    for name, value in sorted(weights.items()):
        digest.update(name.encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]
