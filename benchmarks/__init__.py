"""Scripts that measure every figure in the README and docs; run ``python -m benchmarks.X``."""
