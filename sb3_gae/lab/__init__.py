"""The λ dial: a gridworld whose learning one can steer, and recorded rollouts whose advantages one can look into."""
