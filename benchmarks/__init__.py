"""Scripts behind every figure of the README and the docs; run as ``python -m benchmarks.X``."""
