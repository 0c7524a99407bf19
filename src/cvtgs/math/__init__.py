"""Pure functions on tensors that know nothing of scenes, files or stages."""
