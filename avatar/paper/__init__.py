"""The paper's own schemes, selectable in `TrainConfig`, so that its tables can be repeated."""
