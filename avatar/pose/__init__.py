"""Pose refinement: Gauss-Newton steps and a prior over time."""
