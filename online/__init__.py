"""Serves artifacts: loads in, deformation and stress out, over HTTP."""
