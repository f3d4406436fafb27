"""
The paper's own choices, where it states them, to be unpacked into :class:`~sb3_gae.TRPOGAE`:

.. code-block:: python

    TRPOGAE("MlpPolicy", env, policy_kwargs=LOCOMOTION_NETWORKS, **PAPER_VALUE_FIT)
"""

from typing import Any

from torch import nn

#: the λ of the paper's cart-pole figures (section 6.3.1)
PAPER_LAMBDAS = (0.0, 0.36, 0.68, 0.84, 0.92, 0.96, 0.98, 0.99, 1.0)

#: ``policy_kwargs`` of the paper's cart-pole: a linear policy, a value network of 20 tanh units (section 6.2.1)
CARTPOLE_NETWORKS: dict[str, Any] = dict(net_arch=dict(pi=[], vf=[20]), activation_fn=nn.Tanh)

#: ``policy_kwargs`` of the paper's robots: 100, 50 and 25 tanh units for policy and value function (section 6.2.1)
LOCOMOTION_NETWORKS: dict[str, Any] = dict(net_arch=dict(pi=[100, 50, 25], vf=[100, 50, 25]), activation_fn=nn.Tanh)

#: the value fit of section 5: Monte-Carlo targets, and one trust-region step a batch. Meant for the paper's batches of
#: 50 000 steps and more. The paper gives neither ε nor a damping; these are ours
PAPER_VALUE_FIT: dict[str, Any] = dict(value_lambda=1.0, vf_trust_region=0.01, vf_steps=1, vf_cg_damping=0.01)
