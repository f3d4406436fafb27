"""Advantages, returns and measures of value functions: pure functions of NumPy arrays."""
