"""What training chooses where a scene does not say: the mesh, the size of the reduced model."""
