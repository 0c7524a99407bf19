"""The checkpoints that come with the package."""
