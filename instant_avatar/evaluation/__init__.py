"""ia-evaluate: score avatars."""
