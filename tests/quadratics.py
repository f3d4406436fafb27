"""Problems for a trust-region step whose answer is known in closed form."""

import math
from dataclasses import replace

import torch as th

from sb3_gae.networks.parameters import assign, flatten
from sb3_gae.update.trust_region import LocalProblem, TrustRegionSettings

EXACT = TrustRegionSettings(radius=0.02, cg_max_steps=50, cg_damping=0.0)


class Quadratic:
    r"""
    Divergence :math:`\frac12\Delta^\top H\Delta`, objective :math:`g^\top\Delta - \frac c2\Delta^\top H\Delta`.

    The parameters are two tensors of different shapes; every trial is kept.
    """

    def __init__(self, n: int = 6, seed: int = 0, objective_curvature: float = 0.0, scale: float = 1.0):
        generator = th.Generator().manual_seed(seed)
        factor, self.gradient, origin = (
            th.randn(*shape, generator=generator, dtype=th.float64) for shape in [(n, n), (n,), (n,)]
        )
        self.hessian = factor @ factor.t() + 0.5 * th.eye(n, dtype=th.float64)
        self.gradient *= scale
        self.objective_curvature = objective_curvature
        self.parameters = [th.zeros(2, 2, dtype=th.float64), th.zeros(n - 4, dtype=th.float64)]
        assign(self.parameters, origin)
        self.origin = flatten(self.parameters)
        self.trials: list[th.Tensor] = []

    def evaluate(self) -> tuple[float, float]:
        move = flatten(self.parameters) - self.origin
        self.trials.append(move)
        divergence = 0.5 * move.dot(self.hessian @ move).item()
        return 7.0 + self.gradient.dot(move).item() - self.objective_curvature * divergence, divergence

    def problem(self, **changes) -> LocalProblem:
        given = LocalProblem("test", self.parameters, 7.0, self.gradient, lambda v: self.hessian @ v, self.evaluate)
        return replace(given, **changes)

    def moved(self) -> th.Tensor:
        return flatten(self.parameters) - self.origin

    def untouched(self) -> bool:
        return th.equal(flatten(self.parameters), self.origin)

    def natural_gradient(self) -> th.Tensor:
        return th.linalg.solve(self.hessian, self.gradient)

    def closed_form(self, radius: float) -> th.Tensor:
        natural = self.natural_gradient()
        return math.sqrt(2.0 * radius / self.gradient.dot(natural).item()) * natural


def never() -> tuple[float, float]:
    raise AssertionError("nothing is to be tried")
