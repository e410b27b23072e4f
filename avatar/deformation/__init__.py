"""Deformation: the rig, skinning and its inverse."""
