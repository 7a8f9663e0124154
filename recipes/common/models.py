"""Policies of the recipes: built from the configuration, saved and opened as one self-describing file."""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from dpa import zoo
from dpa.policy import SIZES, ContextOptions, MotionLM, MotionLMConfig
from dpa.tokens import MotionTokenizer, VerletTokenizer
from dpa.training.checkpoint import CheckpointError, load_policy, load_weights, save_policy
from recipes.common.cli import build, plain

TOKENIZERS = {"verlet": VerletTokenizer}
"""Tokenizers that a YAML can name; add a class of your own here (docs/how-to.md)."""


def context_options(cfg: DictConfig) -> ContextOptions:
    """How scenes are cut up, from ``cfg.model.context``."""
    return build(ContextOptions, cfg.context, "model.context")


def policy_config(cfg: DictConfig) -> dict[str, Any]:
    """Everything that decides a policy's shape, from ``cfg.model``: what a checkpoint is compared with."""
    if cfg.size not in SIZES:
        raise ValueError(f"model.size must be one of {sorted(SIZES)}, got {cfg.size!r}.")
    if cfg.tokenizer.name not in TOKENIZERS:
        raise ValueError(f"model.tokenizer.name must be one of {sorted(TOKENIZERS)}, got {cfg.tokenizer.name!r}.")
    context = context_options(cfg)
    tokenizer = build_tokenizer(plain(cfg.tokenizer))
    if tokenizer.steps != context.decision_steps:
        raise ValueError(
            f"a token of model.tokenizer.name={cfg.tokenizer.name} has {tokenizer.steps} poses and "
            f"model.context.decision_steps={context.decision_steps}; they must be equal."
        )
    size = SIZES[cfg.size].as_dict() | {"horizon": context.horizon, "dropout": cfg.dropout}
    return {"model": size, "tokenizer": plain(cfg.tokenizer), "context": asdict(context)}


def build_policy(config: dict[str, Any]) -> MotionLM:
    """A fresh policy from :func:`policy_config`."""
    return MotionLM(MotionLMConfig(**config["model"]), build_tokenizer(config["tokenizer"]))


def build_tokenizer(section: Mapping[str, Any]) -> MotionTokenizer:
    """The tokenizer that ``name`` of a section names, with the section's other options."""
    options = {key: value for key, value in section.items() if key != "name"}
    return build(TOKENIZERS[section["name"]], DictConfig(options), f"model.tokenizer ({section['name']})")


def write_policy(path: Path, model: MotionLM, config: dict[str, Any], metadata: dict[str, Any]) -> None:
    """Save a policy with what it is and where it comes from."""
    save_policy(path, model.state_dict(), config, metadata)


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


def open_policy(path: str | Path, device: str = "cpu") -> tuple[MotionLM, ContextOptions, dict[str, Any]]:
    """A saved policy, its context options and its configuration.

    Args:
        path: file, or ``zoo:NAME``.
        device: of the policy.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: the file is damaged or no policy.
        ValueError: the zoo has no such policy.
        CheckpointError: the file is damaged or no policy.
    """
    weights, config, _ = load_policy(policy_file(path))
    try:
        model, context = build_policy(config), ContextOptions(**config["context"])
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(f"{path} has a configuration that makes no policy ({error!r}).") from None
    load_weights(model, weights, config, config, where=str(path))
    return model.to(device).eval(), context, config


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
