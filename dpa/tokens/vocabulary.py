"""Vocabularies of logged motions: k-disks or grids by class, and the file that keeps them (method.md section 2)."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from dpa.tokens.grids import grid
from envs.files import whole
from envs.geometry.boxes import box_corners
from envs.geometry.frames import to_local, wrap_angle
from envs.scene import AgentKind, Scene

BOXES = {AgentKind.VEHICLE: (4.8, 2.0), AgentKind.PEDESTRIAN: (1.0, 1.0), AgentKind.CYCLIST: (2.0, 1.0)}
"""Length and width of the box by whose corners motions of a class are compared [m] (SMART, arXiv 2405.15677)."""
FINEST = 0.005
"""No vocabulary is finer than this radius [m]."""
SUFFIX = ".npz"


class Vocabulary(NamedTuple):
    """Motions of every class.

    Attributes:
        motions: ``[kinds, V, F, 3]`` poses in the agent's own frame, a table for each :class:`~envs.scene.AgentKind`;
            a class with fewer repeats its first ones, and a class without any has those of vehicles.
        card: what made them, and what they cover.
    """

    motions: Tensor
    card: dict[str, Any]


def corners(motions: Tensor, kind: AgentKind) -> Tensor:
    """Corners of the box of a class along motions ``[*, F, 3]``: ``[*, F * 8]`` [m].

    The Euclidean distance of two rows, over the root of ``4 * F``, is the root mean square distance of their corners.

    Examples:
        >>> corners(torch.zeros(7, 5, 3), AgentKind.VEHICLE).shape
        torch.Size([7, 40])
    """
    length, width = (
        motions.new_full((*motions.shape[:-1], 1), side) for side in BOXES.get(kind, BOXES[AgentKind.VEHICLE])
    )
    return box_corners(torch.cat((motions, length, width), -1)).flatten(-3)


def logged_motions(scenes: Iterable[Scene], steps: int) -> dict[AgentKind, Tensor]:
    """Every whole decision of the logs, by class, seen from where it starts: ``[n, F, 3]``.

    Args:
        scenes: uncollated.
        steps: F.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> logged_motions([straight_road(2)], steps=5)[AgentKind.VEHICLE].shape
        torch.Size([36, 5, 3])
    """
    found: dict[AgentKind, list[Tensor]] = {kind: [] for kind in BOXES}
    for scene in scenes:
        agents = scene.agents
        poses = agents.poses.unfold(1, steps + 1, steps).transpose(-1, -2)  # [A, decisions, F + 1, 3]
        valid = agents.valid.unfold(1, steps + 1, steps).all(-1)
        for kind, motions in found.items():
            own = poses[valid & (agents.kind == kind)[:, None]]
            motions.append(to_local(own[:, 1:], own[:, :1]))
    return {kind: torch.cat(motions) for kind, motions in found.items()}


def k_disks(motions: Tensor, kind: AgentKind, size: int, radius: float, generator: torch.Generator) -> Tensor:
    """Draw a motion, take the mean of all within a radius, drop these, and so on; standing still comes first.

    Args:
        motions: ``[n, F, 3]`` of one class.
        kind: the class.
        size: entries at most.
        radius: root mean square distance of corners [m].
        generator: of the order in which motions are drawn.

    Returns:
        ``[V, F, 3]``, V less than ``size`` where fewer disks hold all motions.

    Examples:
        >>> from envs.sources.synthetic import straight_road
        >>> motions = logged_motions([straight_road(9, seed=0)], 5)[AgentKind.VEHICLE]
        >>> len(k_disks(motions, AgentKind.VEHICLE, 99, 0.5, torch.Generator().manual_seed(0)))
        4
    """
    still = torch.zeros(1, *motions.shape[1:])
    left = torch.cat((still, motions[torch.randperm(len(motions), generator=generator)]))
    points, reach, chosen = corners(left, kind), radius * (4 * motions.shape[1]) ** 0.5, []
    while len(left) and len(chosen) < size:
        near = (points - points[:1]).norm(dim=-1) <= reach
        chosen.append(_mean(left[near]))
        left, points = left[~near], points[~near]
    return torch.stack([still[0], *chosen[1:]])


def cells(motions: Tensor, kind: AgentKind, size: int, radius: float, generator: torch.Generator) -> Tensor:
    """A :func:`~dpa.tokens.grids.grid` by the arguments of :func:`k_disks`; ``radius`` is half the width of a cell."""
    return grid(motions, size, 2 * radius)


MAKERS = {"k_disks": k_disks, "grid": cells}
"""Ways to make the entries of a class."""


def smallest_radius(maker: str, motions: Tensor, kind: AgentKind, size: int, seed: int, digits: int = 3) -> float:
    """The radius with which ``size`` entries hold all motions [m], by bisection: the finest vocabulary of its size."""
    low, high = FINEST, 4.0
    while high - low > 10.0**-digits:
        radius = (low + high) / 2
        needed = len(MAKERS[maker](motions, kind, size + 1, radius, torch.Generator().manual_seed(seed)))
        low, high = (radius, high) if needed > size else (low, radius)
    return round(high, digits)


def _mean(motions: Tensor) -> Tensor:
    """Of motions ``[n, F, 3]`` that lie near each other; headings around that of the first."""
    turned = motions[:1, :, 2] + wrap_angle(motions[..., 2] - motions[:1, :, 2])
    return torch.cat((motions[..., :2].mean(0), wrap_angle(turned.mean(0))[:, None]), -1)


def stacked(entries: Mapping[AgentKind, Tensor]) -> Tensor:
    """Tables of all classes as ``[kinds, V, F, 3]``; see :class:`Vocabulary`."""
    size = max(len(rows) for rows in entries.values())
    filled = {kind: rows[torch.arange(size) % len(rows)] for kind, rows in entries.items() if len(rows)}
    return torch.stack([filled.get(kind, filled[AgentKind.VEHICLE]) for kind in AgentKind])


def digest_of(motions: Tensor) -> str:
    """Digest of a vocabulary's motions, by which a policy names it."""
    return hashlib.sha256(motions.contiguous().numpy().tobytes()).hexdigest()[:16]


def write_vocabulary(path: Path, vocabulary: Vocabulary) -> None:
    """Write a vocabulary as one ``.npz``, whole or not at all.

    Raises:
        ValueError: another kind of file.
    """
    if path.suffix != SUFFIX:
        raise ValueError(f"a vocabulary must end in {SUFFIX}, got {path}.")
    path.parent.mkdir(parents=True, exist_ok=True)
    card = np.frombuffer(json.dumps(vocabulary.card).encode(), dtype=np.uint8)
    with whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, motions=vocabulary.motions.numpy(), card=card)


def read_vocabulary(path: Path) -> Vocabulary:
    """Read a vocabulary.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged, or is no vocabulary.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; make a vocabulary with python -m recipes.vocabulary.")
    try:
        with np.load(path, allow_pickle=False) as held:
            motions, card = torch.from_numpy(held["motions"]), json.loads(held["card"].tobytes())
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path} is no vocabulary ({error}); make one with python -m recipes.vocabulary.") from None
    if motions.ndim != 4 or len(motions) != len(AgentKind) or motions.shape[-1] != 3 or not motions.isfinite().all():
        raise ValueError(
            f"{path}: motions must be finite and [{len(AgentKind)}, V, F, 3], got {list(motions.shape)}; make it with "
            "python -m recipes.vocabulary."
        )
    return Vocabulary(motions.float(), card)
