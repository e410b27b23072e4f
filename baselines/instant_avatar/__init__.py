"""InstantAvatar's own skipping and root finding (Jiang et al. 2023)."""
