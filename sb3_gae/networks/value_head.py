"""The last layer of a value function whose outputs keep to the scale of the returns."""

from typing import Any

import torch as th
from torch import nn


class ValueHead(nn.Linear):
    r"""
    A linear layer followed by a positive factor, so that the network in front works with numbers near 1.

    The factor is a running root mean square of the value targets. When it changes, weights and bias change
    inversely and the values stay as they are (as in PopArt, van Hasselt et al. 2016, without the shift).
    The parameter names are those of :class:`torch.nn.Linear`, and its state loads with a factor of 1.

    :param linear: layer to take over; its parameters become this layer's own
    """

    #: least weight of a new batch in the running mean square
    momentum = 0.1

    scale: th.Tensor
    n_batches: th.Tensor

    def __init__(self, linear: nn.Linear):
        super().__init__(linear.in_features, linear.out_features, device="meta")
        # The same objects: optimisers and initialisers that hold them stay right
        self.weight = linear.weight
        self.bias = linear.bias
        self.register_buffer("scale", th.ones((), device=linear.weight.device))
        self.register_buffer("n_batches", th.zeros((), dtype=th.long, device=linear.weight.device))
        self._constructed = self._copies()

    def forward(self, features: th.Tensor) -> th.Tensor:
        """
        :param features: shape (B, n)
        :return: values in units of the reward, shape (B, 1)
        """
        return super().forward(features) * self.scale

    def unscaled(self) -> nn.Linear:
        """
        :return: a layer with the same parameters and without the factor
        """
        layer = nn.Linear(self.in_features, self.out_features, device="meta")
        layer.weight, layer.bias = self.weight, self.bias
        return layer

    @property
    def is_as_constructed(self) -> bool:
        """Whether neither a factor nor weights have been set, as by whoever pretrains the value function."""
        if self.n_batches != 0 or self.scale != 1.0:
            return False
        present = dict(self.named_parameters())
        return self._constructed.keys() == present.keys() and all(
            th.equal(then.to(present[name]), present[name]) for name, then in self._constructed.items()
        )

    def _copies(self) -> dict[str, th.Tensor]:
        return {name: parameter.detach().clone() for name, parameter in self.named_parameters()}

    @th.no_grad()
    def initialize_scale(self, returns: th.Tensor) -> None:
        """
        Set the factor once, before the first values are used, from returns that owe nothing to the network.

        :param returns: any shape; all zeros, or next to it, leave the factor at 1
        """
        root_mean_square = _root_mean_square(returns)
        if self.is_as_constructed and _can_divide_by(root_mean_square):
            self.scale.fill_(root_mean_square)

    @th.no_grad()
    def update_scale(self, value_targets: th.Tensor) -> None:
        """
        Move the factor towards the root mean square of new targets and keep all values as they are.

        :param value_targets: any shape; so small beside the values that the weights would leave the range, they change nothing
        """
        self.n_batches += 1
        weight = max(self.momentum, 1.0 / int(self.n_batches))
        new_scale = th.hypot(self.scale * (1.0 - weight) ** 0.5, _root_mean_square(value_targets) * weight**0.5)
        ratio = self.scale / new_scale
        # Products need powers of the weights: a scale that is far off is left until the values have come nearer
        if _can_divide_by(new_scale) and ratio * self.weight.abs().max() < th.finfo(ratio.dtype).max ** 0.25:
            self.weight.mul_(ratio)
            if self.bias is not None:
                self.bias.mul_(ratio)
            self.scale.copy_(new_scale)

    @th.no_grad()
    def forget_scale(self) -> None:
        """Weights and bias are in units of the reward, as those of a plain layer. A head without a scale may still get one."""
        if self.n_batches != 0 or self.scale != 1.0:
            self.scale.fill_(1.0)
            self.n_batches.fill_(1)

    def _save_to_state_dict(self, destination: dict[str, Any], prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self.n_batches == 0 and not self.is_as_constructed:
            # Weights that somebody has set are in units of the reward wherever they go
            destination[prefix + "n_batches"] = th.ones_like(self.n_batches)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        # Weights without a scale are those of a plain layer; where there are none, this layer keeps its scale
        for name in ("scale", "n_batches") if prefix + "weight" in state_dict else ():
            state_dict.setdefault(prefix + name, th.ones_like(getattr(self, name)))
        super()._load_from_state_dict(state_dict, prefix, *args)
        if prefix + "weight" in state_dict:
            # What comes with its scale says by itself whether it is as it was constructed
            self._constructed = self._copies()


def _can_divide_by(scale: th.Tensor) -> bool:
    """False for zero, and where a number near 1 over the scale would be near overflow."""
    limits = th.finfo(scale.dtype)
    return bool(scale > limits.tiny / limits.eps)


def _root_mean_square(values: th.Tensor) -> th.Tensor:
    # Divide first: squares of 1e30 overflow
    largest = values.abs().max().clamp_min(th.finfo(values.dtype).tiny)
    return largest * (values / largest).square().mean().sqrt()
