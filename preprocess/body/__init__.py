"""The parametric body: model, shape, pose, kinematics, silhouette."""
