"""Tokens on the action path of the environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import Transform

from dpa.tokens.base import MotionTokenizer
from envs import keys


class TokenAction(Transform):
    """Lets an environment of continuous poses be driven by motion tokens.

    On the way in, ``("agents", "token")`` is decoded to ``("agents", "action")`` with the agents' recent poses; the
    environment itself never hears of tokens.

    Args:
        tokenizer: what a token means.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from dpa.tokens import VerletTokenizer
        >>> from envs.sources.synthetic import straight_road
        >>> from envs.traffic import TrafficEnv
        >>> env = TransformedEnv(TrafficEnv([straight_road()]), TokenAction(VerletTokenizer()))
        >>> env.rand_step(env.reset())["agents", "token"].shape
        torch.Size([1, 2])
    """

    def __init__(self, tokenizer: MotionTokenizer) -> None:
        super().__init__(in_keys_inv=[keys.ACTION], out_keys_inv=[keys.TOKEN])
        self.tokenizer = tokenizer

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        token = tensordict[keys.TOKEN]
        self._check(token)
        action = self.tokenizer.decode(token, tensordict[keys.RECENT], tensordict[keys.KIND])
        return tensordict.set(keys.ACTION, action)

    def _check(self, token: Tensor) -> None:
        """Refuse a token outside the vocabulary, which would be decoded to a motion that none has."""
        if not self.tokenizer.vocab_size:
            return
        inside = ((token >= 0) & (token < self.tokenizer.vocab_size)).all()
        if token.device.type != "cpu":  # where it is told without waiting for the device
            torch._assert_async(inside, f"tokens must be 0 to {self.tokenizer.vocab_size - 1}.")
        elif not inside:
            raise ValueError(
                f"tokens must be 0 to {self.tokenizer.vocab_size - 1}, got {int(token.min())} to {int(token.max())}."
            )

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Tokens in the place of poses."""
        action = input_spec["full_action_spec"]
        poses = action[keys.ACTION]
        if poses.shape[-2] != self.tokenizer.steps:
            raise ValueError(
                f"The environment takes {poses.shape[-2]} poses for a decision and the tokenizer gives "
                f"{self.tokenizer.steps}; say EpisodeOptions(decision_steps={self.tokenizer.steps})."
            )
        del action[keys.ACTION]
        shape, device = poses.shape[:-2], poses.device
        if self.tokenizer.vocab_size:
            action[keys.TOKEN] = Categorical(self.tokenizer.vocab_size, shape=shape, device=device, dtype=torch.int64)
        else:
            action[keys.TOKEN] = Unbounded((*shape, *self.tokenizer.shape), device=device)
        return input_spec
