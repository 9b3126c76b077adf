"""From full to reduced: load ranges, bases, cubature, local models."""
