"""Turns a scene into an artifact: mesh, full model, training, validation."""
