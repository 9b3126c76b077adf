"""The full-order model: mesh, assembly, linear solver, equilibria."""
