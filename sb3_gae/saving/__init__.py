"""Checkpoints that a training continues from bit for bit, and files that are safe to load."""
