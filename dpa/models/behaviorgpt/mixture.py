"""A density of patches: standing still, or a mixture of modes, each of Laplace and von Mises densities by frame.

From frame to frame an agent moves by a step, seen along the heading halfway: forwards f, to the left l, while it turns
by r. A mode says how much f changes and what l and r are, and how surely. So an agent keeps its speed unless a mode
says otherwise, noise is noise of accelerations, and what is drawn moves smoothly and where it looks.

A patch has the frames t = 1 to F; f_0 is the step forwards that was seen last. The density is

    ``p = sum_k pi_k prod_t Laplace(f_t - f_{t-1}; m, b) Laplace(l_t; m, b) VonMises(r_t; m, kappa)``

with m, b and kappa of mode k and frame t. The patch of an agent that stands has a probability of its own instead,
``1 - sum_k pi_k``: what is drawn from densities, however narrow, creeps. Poses and ``(f, l, r)`` map onto each other by
turning and adding up, with determinant 1, so it is the density of the poses as well [1/m and 1/rad for each frame's
numbers].
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

from dpa.models.distribution import Distribution
from dpa.models.sampling import Decoding, draw
from envs.geometry.frames import rotate, wrap_angle

NEAR = 1.0
"""The most probable patch hits another one that ends so near [m]."""
UNIT = 0.02
"""Of the means [m, rad], so that a number of size 1 is a usual one: a change of speed by 2 m/s^2."""
LEAST_SCALE = 0.001
"""Of a Laplace density [m]: agents that stand do not move at all, and a density must have an end."""
CONCENTRATION = (4.0, 1e6)
"""Least and largest concentration kappa of a von Mises density: a standard deviation of 0.5 rad and of 1 mrad."""
SURE = 100.0
"""Above this kappa a von Mises density is a normal one but for terms of higher order, which an expansion has."""
CELLS = 128
"""Of the table by which angles are drawn."""
WIDTH = 8.0
"""Half the width of the table, in standard deviations."""


class Mixture(NamedTuple):
    """What a row of numbers says.

    Attributes:
        modes: ``[*, K + 1]`` log-probabilities, that of standing still last.
        mean: ``[*, K, F, 3]`` of the change of f, of l and of r [m, rad].
        scale: ``[*, K, F, 2]`` of the Laplace densities [m].
        kappa: ``[*, K, F]`` of the von Mises density.
        before: ``[*]`` the last step forwards that was seen [m].
    """

    modes: Tensor
    mean: Tensor
    scale: Tensor
    kappa: Tensor
    before: Tensor

    @classmethod
    def of(cls, logits: Tensor, frames: int) -> Mixture:
        """Read ``[*, K + 1 + 6 * K * F + 1]`` numbers."""
        modes = (logits.shape[-1] - 2) // (1 + 6 * frames)
        weight, rest, before = logits.split((modes + 1, modes * 6 * frames, 1), -1)
        mean, spread, sure = rest.unflatten(-1, (modes, frames, 6)).split((3, 2, 1), -1)
        least, most = CONCENTRATION
        kappa = (sure[..., 0].clamp(max=math.log(most))).exp() + least
        return cls(weight.log_softmax(-1), UNIT * mean, softplus(spread) + LEAST_SCALE, kappa, before[..., 0])

    def levelled(self) -> Tensor:
        """The means, whose gradients are in units of :data:`UNIT` and not of the width of their density.

        The log-density pulls at a mean with the inverse of its width: a density of a millimetre, as of straight driving
        at one speed, a hundred times as strongly as that of a turn, which its noise would drown. (Seitzer et al., On
        the Pitfalls of Heteroscedastic Uncertainty Estimation, ICLR 2022, with beta 1/2 of the variance.)

        Density and divergence read them alike, so that what one pays for a mean the other can outweigh.
        """
        width = torch.cat((self.scale, self.kappa.rsqrt()[..., None]), -1).detach() / UNIT
        fixed = self.mean.detach()
        return fixed + width * (self.mean - fixed)

    def warmer(self, decoding: Decoding) -> Mixture:
        """That of a decoding: modes are cut, and with a temperature all densities are as much wider or narrower."""
        modes, t = decoding.log_probs(self.modes), decoding.temperature
        return self._replace(modes=modes, scale=self.scale * t, kappa=self.kappa / t**2)


class PatchMixture(Distribution):
    """Of patches of F poses, by K modes and standing still: P is ``K + 6 K F + 2``.

    Entropy and divergence of a mixture have no closed form. Those here are of the mode and of the frames given the
    mode: bounds from above, exact where modes do not overlap, and 0 where nothing differs.

    A :class:`~dpa.models.Decoding` cuts modes, and its temperature scales the densities of a mode as well.

    Args:
        frames: F.

    Examples:
        >>> mixture = PatchMixture(frames=10)
        >>> logits = torch.zeros(2, 4 * 61 + 2)  # four modes
        >>> patch, by = mixture.draw(logits, torch.rand(2, mixture.numbers), Decoding(top_p=1.0))
        >>> patch.shape, torch.allclose(by, mixture.log_prob(logits, patch), rtol=1e-3)
        (torch.Size([2, 30]), True)
    """

    discrete = False

    def __init__(self, frames: int) -> None:
        self.frames, self.numbers = frames, 1 + 3 * frames

    def log_prob(self, logits: Tensor, token: Tensor) -> Tensor:
        """See :meth:`~dpa.models.distribution.Distribution.log_prob`.

        Per metre and radian of each frame, and a probability where the agent stands.
        """
        return self._log_density(Mixture.of(logits, self.frames), token)

    def entropy(self, logits: Tensor) -> Tensor:
        """See :meth:`~dpa.models.distribution.Distribution.entropy`; a bound from above."""
        said = Mixture.of(logits, self.frames)
        laplace = (1 + math.log(2) + said.scale.log()).sum((-1, -2))
        mises = (_log_bessel(said.kappa) + math.log(2 * math.pi) + _slack(said.kappa)).sum(-1)
        return (said.modes.exp() * (_and_still(laplace + mises) - said.modes)).sum(-1)

    def divergence(self, logits: Tensor, reference: Tensor) -> Tensor:
        """See :meth:`~dpa.models.distribution.Distribution.divergence`; a bound from above, mode by mode."""
        one, other = (Mixture.of(each, self.frames) for each in (logits, reference))
        off = one.levelled() - other.mean
        apart, scale = off[..., :2].abs(), one.scale / other.scale
        laplace = scale * (-apart / one.scale).exp() + apart / other.scale - 1 - scale.log()
        turned = 2 * (off[..., 2] / 2).sin().square()  # 1 - cos
        lost = _slack(one.kappa) / one.kappa  # 1 - I1 / I0
        mises = _log_bessel(other.kappa) - _log_bessel(one.kappa)
        mises = mises + (other.kappa - one.kappa) * lost + (1 - lost) * other.kappa * turned
        frames = laplace.sum((-1, -2)) + mises.sum(-1)
        return (one.modes.exp() * (one.modes - other.modes + _and_still(frames))).sum(-1)

    def likeliest(self, logits: Tensor) -> Tensor:
        """The middle of the most probable mode."""
        said = Mixture.of(logits, self.frames)
        mode = said.modes.argmax(-1)
        return _unless_still(_poses(_of_mode(said.mean, mode), said.before), said, mode)

    def hit(self, logits: Tensor, token: Tensor) -> Tensor:
        """Whether the middle of the most probable mode ends within :data:`NEAR` of the patch."""
        return (self.likeliest(logits) - token)[..., -3:-1].norm(dim=-1) < NEAR

    def draw(self, logits: Tensor, uniform: Tensor, decoding: Decoding) -> tuple[Tensor, Tensor]:
        """See :meth:`~dpa.models.distribution.Distribution.draw`: a mode, then its frames."""
        said = Mixture.of(logits, self.frames).warmer(decoding)
        mode = draw(said.modes, uniform[..., 0])
        uniform = uniform[..., 1:].unflatten(-1, (self.frames, 3))
        mean, scale, kappa = (_of_mode(value, mode) for value in (said.mean, said.scale, said.kappa))
        moved = _laplace(uniform[..., :2]) * scale
        turned = _mises(uniform[..., 2], kappa)
        patch = _poses(mean + torch.cat((moved, turned[..., None]), -1), said.before)
        patch = _unless_still(patch, said, mode)
        return patch, self._log_density(said, patch)

    def _log_density(self, said: Mixture, patch: Tensor) -> Tensor:
        change = _changes(patch.unflatten(-1, (self.frames, 3)), said.before)[..., None, :, :]  # [*, 1, F, 3]
        off = change - said.levelled()
        laplace = -(off[..., :2].abs() / said.scale) - (2 * said.scale).log()
        mises = -2 * said.kappa * (off[..., 2] / 2).sin().square() - _log_bessel(said.kappa) - math.log(2 * math.pi)
        moves = (said.modes[..., :-1] + laplace.sum((-1, -2)) + mises.sum(-1)).logsumexp(-1)
        return torch.where((patch == 0).all(-1), said.modes[..., -1], moves)


def _and_still(value: Tensor) -> Tensor:
    """``[*, K]`` of modes, and 0 of standing still."""
    return torch.cat((value, torch.zeros_like(value[..., :1])), -1)


def _unless_still(patch: Tensor, said: Mixture, mode: Tensor) -> Tensor:
    """The patch of a mode, or that of an agent that stands."""
    return torch.where((mode == said.modes.shape[-1] - 1)[..., None], 0.0, patch)


def _of_mode(value: Tensor, mode: Tensor) -> Tensor:
    """``[*, K, ...]`` at ``[*]``; at K, where the agent stands, those of the last mode."""
    mode = mode.clamp(max=value.shape[mode.dim()] - 1)
    index = mode.view(*mode.shape, *(1,) * (value.dim() - mode.dim()))
    return value.gather(mode.dim(), index.expand(*mode.shape, 1, *value.shape[mode.dim() + 1 :])).squeeze(mode.dim())


def _changes(poses: Tensor, before: Tensor) -> Tensor:
    """``[*, F, 3]``: change of f, l and r of poses that begin at the origin, after a step forwards ``[*]``."""
    poses = torch.cat((torch.zeros_like(poses[..., :1, :]), poses), -2)
    turned = wrap_angle(poses[..., 2].diff(dim=-1))
    step = rotate(poses[..., :2].diff(dim=-2), -(poses[..., :-1, 2] + turned / 2))
    forwards = torch.cat((before.expand(step.shape[:-2])[..., None], step[..., 0]), -1)
    return torch.stack((forwards.diff(dim=-1), step[..., 1], turned), -1)


def _poses(changes: Tensor, before: Tensor) -> Tensor:
    """Inverse of :func:`_changes`, as tokens ``[*, 3 * F]``."""
    change, left, turned = changes.unbind(-1)
    turned = wrap_angle(turned)  # half of it says where the step goes
    heading = turned.cumsum(-1)
    step = torch.stack((before[..., None] + change.cumsum(-1), left), -1)
    place = rotate(step, heading - turned / 2).cumsum(-2)
    return torch.cat((place, wrap_angle(heading)[..., None]), -1).flatten(-2)


def _log_bessel(kappa: Tensor) -> Tensor:
    """``log I0(kappa) - kappa``."""
    sure = -(2 * math.pi * kappa).log() / 2 + 1 / (8 * kappa)  # and no overflow of the gradient
    return torch.where(kappa > SURE, sure, torch.special.i0e(kappa.clamp(max=SURE)).log())


def _slack(kappa: Tensor) -> Tensor:
    """``kappa * (1 - I1(kappa) / I0(kappa))``, which goes to one half."""
    some = kappa.clamp(max=SURE)
    exact = some * (1 - torch.special.i1e(some) / torch.special.i0e(some))
    return torch.where(kappa > SURE, 0.5 + 1 / (8 * kappa) + 1 / (8 * kappa**2), exact)


def _laplace(uniform: Tensor) -> Tensor:
    """A draw of the Laplace density of scale 1, by inversion."""
    centred = uniform - 0.5
    return -centred.sign() * torch.log1p(-2 * centred.abs().clamp(max=0.5 - 1e-7))


def _mises(uniform: Tensor, kappa: Tensor) -> Tensor:
    """A draw of the von Mises density around 0, by inversion of a table [rad]."""
    half = (WIDTH / kappa.sqrt()).clamp(max=math.pi)[..., None]
    place = half * torch.linspace(-1, 1, CELLS, device=kappa.device)
    density = (-2 * kappa[..., None] * (place / 2).sin().square()).exp()
    reached = ((density[..., 1:] + density[..., :-1]) / 2).cumsum(-1)
    wanted = uniform[..., None] * reached[..., -1:]
    cell = torch.searchsorted(reached, wanted, right=True).clamp(max=CELLS - 2)
    below = torch.where(cell > 0, reached.gather(-1, (cell - 1).clamp(min=0)), 0)
    share = (wanted - below) / (reached.gather(-1, cell) - below).clamp(min=torch.finfo(kappa.dtype).tiny)
    start, end = place.gather(-1, cell), place.gather(-1, cell + 1)
    return (start + share * (end - start))[..., 0]
