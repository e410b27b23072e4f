"""Cameras as other programs write them: COLMAP, nerfstudio and instant-ngp, Record3D, Polycam."""
