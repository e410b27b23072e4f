"""ia-play: clips, images and web pages of a package."""
