"""Inference: from images and masks to parameters."""
