"""Meshes: isosurface, skin and glTF."""
