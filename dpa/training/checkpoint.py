"""Checkpoints that survive a crash at any moment and resume to the same bits; policies as one self-describing file.

A file is what :func:`torch.save` writes, restricted to tensors and plain values and read back with
``weights_only=True``: nothing in it can run code. It appears under its name only when it is complete (written aside,
synchronised, renamed), and its checksums are verified before it is used.

``torchrl.checkpoint`` was weighed and left: it does not synchronise to disk, verifies no checksum, and its
``load_latest`` stops at a damaged file instead of going on with the one before.

Examples:
    >>> import tempfile
    >>> from torch import nn
    >>> net = nn.Linear(2, 2)
    >>> parts = {"net": net, "optimizer": torch.optim.AdamW(net.parameters())}
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     checkpoints = Checkpointer(folder, config={"width": 2})
    ...     _ = checkpoints.save(10, capture(parts, progress={"epoch": 1}))
    ...     saved = checkpoints.latest()
    >>> restore(saved, parts)
    >>> saved["step"], saved["progress"]
    (10, {'epoch': 1})
"""

from __future__ import annotations

import os
import platform
import random
import re
import warnings
import zipfile
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from envs.files import PARTIAL_PREFIX, whole
from envs.options import differences

FORMAT = "dpa-omf/1"
"""First entry of every file; the number changes when old files can no longer be read."""
PACKAGES = ("dpa-omf", "torch", "torchrl", "tensordict", "numpy")
SUFFIX = ".pt"
_NAME = re.compile(r"step_(\d+)\.pt")
_HELD = {"training": ("step",), "policy": ("policy", "metadata")}
"""What a file of each kind holds beside what all have."""
_RESERVED = ("format", "kind", "step", "config", "versions")


KEPT = 2
"""Checkpoints of a run: one is left if the newest turns out damaged."""


class CheckpointError(ValueError):
    """A file is no usable checkpoint; the message names it and says the fix."""


class Stateful(Protocol):
    """A module, an optimiser, a scheduler, or anything else with a state."""

    def state_dict(self) -> dict[str, Any]:
        """All that :meth:`load_state_dict` needs."""

    def load_state_dict(self, state_dict: Mapping[str, Any], /) -> Any:
        """Take over a state."""


class Checkpointer:
    """The last checkpoints of one run, in one folder with one writer.

    Args:
        folder: made when the first checkpoint is saved.
        config: the model's configuration (plain dicts, lists, numbers, strings), written into every checkpoint and
            compared when one is read.
    """

    def __init__(self, folder: str | os.PathLike[str], config: Mapping[str, Any] | None = None) -> None:
        self.folder = Path(folder)
        self.config = None if config is None else dict(config)

    def save(self, step: int, state: Mapping[str, Any]) -> Path:
        """Write the state after ``step`` steps, then remove what is no longer needed.

        Later checkpoints in the folder are removed too: whoever saves step 5 has left the run that reached step 9.

        Args:
            step: steps done.
            state: nested dicts, lists and tuples of tensors and plain values; :func:`capture` makes one.

        Returns:
            The new file.

        Raises:
            ValueError: the state holds another type, or a key that the file needs for itself.
        """
        taken = sorted(set(_RESERVED) & set(state))
        if taken:
            raise ValueError(f"the keys {taken} of the state belong to the checkpoint itself; rename them.")
        self.folder.mkdir(parents=True, exist_ok=True)
        for left_over in self.folder.glob(f"{PARTIAL_PREFIX}*{SUFFIX}"):  # of a save that was killed
            left_over.unlink()
        path = self.folder / f"step_{step:010d}{SUFFIX}"
        _write(path, {**_header("training", self.config), "step": step, **state})
        newest_first = self._paths()
        here = newest_first.index(path)
        for obsolete in newest_first[:here] + newest_first[here + KEPT :]:
            obsolete.unlink()
        return path

    def latest(self) -> dict[str, Any] | None:
        """The newest checkpoint that is whole, on the CPU, or ``None`` if the folder has none.

        Damaged files are passed over with a warning.

        Returns:
            The saved state with ``step``, ``config`` and ``versions``.

        Raises:
            CheckpointError: there are files but none of them is whole.
            ValueError: the checkpoint is of a model with another configuration.
        """
        problems = []
        for path in self._paths():
            try:
                payload = _read(path, "training")
            except CheckpointError as error:
                problems.append(str(error))
                warnings.warn(f"{error} Going on with the checkpoint before it.", stacklevel=2)
                continue
            if self.config is not None:
                _check_same_config(path, payload["config"], self.config)
            return payload
        if problems:
            raise CheckpointError(
                f"none of the {len(problems)} checkpoints in {self.folder} can be used; remove the folder to start "
                f"over, or put back a copy. {' '.join(problems)}"
            )
        return None

    def _paths(self) -> list[Path]:
        """Checkpoints, newest first."""
        if not self.folder.is_dir():
            return []
        return sorted((p for p in self.folder.iterdir() if _NAME.fullmatch(p.name)), reverse=True)


def capture(parts: Mapping[str, Stateful], progress: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything a run needs to go on: its parts, the global random generators, and its counters.

    Args:
        parts: modules, optimiser, scheduler, ... by name.
        progress: counters and other plain values; read them back as ``saved["progress"]``.
    """
    name, keys, *rest = np.random.get_state()
    return {
        "parts": {part: stateful.state_dict() for part, stateful in parts.items()},
        "global_rng": {
            "python": random.getstate(),
            "numpy": (name, keys.tolist(), *rest),
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        },
        "progress": dict(progress or {}),
    }


def restore(saved: Mapping[str, Any], parts: Mapping[str, Stateful]) -> None:
    """Put a run back to where :func:`capture` found it.

    The states of the GPUs' global generators are taken over only where the number of GPUs is the same; on other
    hardware a run does not go on to the same bits anyway.

    Args:
        saved: what :meth:`Checkpointer.latest` returned.
        parts: the same names as given to :func:`capture`, freshly built.

    Raises:
        ValueError: the names differ, or a module has other parameters than the checkpoint.
    """
    if set(saved["parts"]) != set(parts):
        raise ValueError(
            f"the checkpoint has the parts {sorted(saved['parts'])}, the run {sorted(parts)}; resume with the recipe "
            "and options that wrote it."
        )
    for name, part in parts.items():
        if isinstance(part, nn.Module):
            load_weights(part, saved["parts"][name], saved.get("config"), where=f"checkpoint part {name!r}")
        else:
            part.load_state_dict(saved["parts"][name])
    rng = saved["global_rng"]
    random.setstate(rng["python"])
    np.random.set_state(rng["numpy"])
    torch.set_rng_state(rng["torch"])
    if len(rng["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(rng["cuda"])


def save_policy(
    path: str | os.PathLike[str],
    state_dict: Mapping[str, Tensor],
    config: Mapping[str, Any],
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write a policy as one file that says what it is.

    Args:
        path: the file; replaced whole if it exists.
        state_dict: the policy's parameters and buffers.
        config: all that is needed to build the policy again (plain dicts, lists, numbers, strings).
        metadata: where it comes from: data, method, seed, scores. Library versions are added under ``"versions"``.

    Raises:
        ValueError: something is neither a tensor nor a plain value.

    Examples:
        >>> import tempfile
        >>> net = nn.Linear(2, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save_policy(f"{folder}/policy.pt", net.state_dict(), {"width": 2}, {"seed": 0})
        ...     weights, config, metadata = load_policy(path)
        >>> load_weights(nn.Linear(2, 1), weights, config)
        >>> config, metadata["seed"]
        ({'width': 2}, 0)
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _write(path, {**_header("policy", dict(config)), "policy": dict(state_dict), "metadata": dict(metadata or {})})
    return path


def load_policy(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any], dict[str, Any]]:
    """Read what :func:`save_policy` wrote, on the CPU.

    Returns:
        ``(state_dict, config, metadata)``; load the first with :func:`load_weights`.

    Raises:
        FileNotFoundError: no such file.
        CheckpointError: the file is damaged or is not a policy.
    """
    payload = _read(Path(path), "policy")
    for name in ("policy", "config", "metadata"):
        if not isinstance(payload[name], dict):
            raise CheckpointError(f"{path}: {name} must be a table, got {type(payload[name]).__name__}.")
    for name, value in payload["policy"].items():
        if not isinstance(value, Tensor):
            raise CheckpointError(f"{path}: {name!a} must be a tensor, got {type(value).__name__}.")
    return payload["policy"], payload["config"], {**payload["metadata"], "versions": payload["versions"]}


def load_weights(
    module: nn.Module,
    state_dict: Mapping[str, Tensor],
    saved_config: Mapping[str, Any] | None,
    config: Mapping[str, Any] | None = None,
    where: str = "the file",
) -> None:
    """Load parameters into a module built from the same configuration; on an error the module is unchanged.

    Args:
        module: what to load into.
        state_dict: parameters and buffers.
        saved_config: the configuration that came with them.
        config: the configuration that ``module`` was built from, if at hand: it is compared and named in the error.
        where: what to call the source in an error.

    Raises:
        ValueError: configurations or parameters differ; the message names both sides and the fix.
    """
    if saved_config is not None and config is not None:
        _check_same_config(where, saved_config, config)
    own = module.state_dict()
    problems = [f"{name} is missing" for name in own if name not in state_dict]
    problems += [f"{name} is unknown" for name in state_dict if name not in own]
    problems += [
        f"{name} is {tuple(state_dict[name].shape)} there and {tuple(own[name].shape)} here"
        for name in own
        if isinstance(own[name], Tensor) and name in state_dict and state_dict[name].shape != own[name].shape
    ]
    if problems:
        shown = "; ".join(problems[:3]) + (f"; and {len(problems) - 3} more" if len(problems) > 3 else "")
        raise ValueError(
            f"{where} does not fit this {type(module).__name__}: {shown}. It was saved with the configuration "
            f"{saved_config}, this one has {'an unknown one' if config is None else config}. Build the model from the "
            "saved configuration, or choose another file."
        )
    module.load_state_dict(state_dict)


def _check_same_config(where: object, saved: Mapping[str, Any] | None, config: Mapping[str, Any]) -> None:
    differ = differences(saved or {}, config)
    if differ:
        raise ValueError(
            f"{where} was saved by a model with another configuration ({differ}). Build the model from the saved "
            "configuration, or use another folder or file."
        )


def _header(kind: str, config: Mapping[str, Any] | None) -> dict[str, Any]:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {"format": FORMAT, "kind": kind, "config": config, "versions": versions}


def _write(path: Path, payload: dict[str, Any]) -> None:
    """Publish a file whole or not at all, also across a power cut."""
    _check_plain(payload, path.name)
    with whole(path) as part, part.open("wb") as file:  # a path would put its name into the archive
        torch.save(payload, file)


def _read(path: Path, kind: str) -> dict[str, Any]:
    if path.is_dir():
        held = f" ({path / 'policy.pt'}?)" if (path / "policy.pt").is_file() else ""
        raise FileNotFoundError(f"{path} is a folder; give the file of a saved {kind}{held}.")
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; give the path of a saved {kind}.")
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # torch does not compare the checksums that it writes
        if damaged is not None:
            raise CheckpointError(f"{path} is damaged (checksum of {damaged!a}).")
        payload = torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except Exception as error:
        raise CheckpointError(
            f"{path} is no whole checkpoint ({type(error).__name__}); name a file that training has written."
        ) from error
    if not isinstance(payload, dict) or payload.get("format") != FORMAT:
        raise CheckpointError(f"{path} was not written by this version of the project ({FORMAT}).")
    if payload.get("kind") != kind:
        raise CheckpointError(f"{path} is a {payload.get('kind')!a} file; a {kind} file is needed here.")
    if missing := sorted({"config", "versions", *_HELD[kind]} - payload.keys()):
        raise CheckpointError(f"{path} lacks {', '.join(missing)}; name a file that training has written.")
    return payload


def _check_plain(value: Any, where: str) -> None:
    """Refuse at once what ``weights_only`` would refuse when it is too late."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, (str, int)):
                raise ValueError(f"{where} has the key {key!r} of type {type(key).__name__}; use a string or an int.")
            _check_plain(item, f"{where}[{key!r}]")
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            _check_plain(item, f"{where}[{index}]")
    elif not (value is None or isinstance(value, Tensor) or type(value) in (bool, int, float, str)):
        raise ValueError(
            f"{where} is a {type(value).__name__}; a checkpoint holds tensors, numbers, strings, dicts, lists and "
            "tuples only. Convert it first."
        )
