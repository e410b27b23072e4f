"""Meshes for other programs: isosurface, skinning weights and glTF."""
