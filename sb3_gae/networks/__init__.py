"""SB3's policies with a scaled value head, their distributions, and MLPs with kept activations."""
