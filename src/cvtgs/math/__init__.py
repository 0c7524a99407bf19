"""Pure functions on tensors, independent of scenes, files and stages."""
