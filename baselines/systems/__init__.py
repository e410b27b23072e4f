"""Other systems' avatars in one frame: data, rays, compositor, scores and clock are shared."""
