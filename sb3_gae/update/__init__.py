"""The two trust-region steps and what they stand on: curvature products, conjugate gradient, line search."""
