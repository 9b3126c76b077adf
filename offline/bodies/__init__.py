"""Bodies from files: surfaces, meshes and images of labels become meshes of tetrahedra."""
