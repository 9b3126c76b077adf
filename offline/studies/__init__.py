"""Measurements behind the choices: how accurate a mesh is, how fast a step."""
