"""Shapes: elements, quadrature, and the closest point of a surface."""
