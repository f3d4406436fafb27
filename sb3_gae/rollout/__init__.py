"""Collecting a batch, and the buffer that keeps it as the environments gave it."""
