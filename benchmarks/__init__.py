"""Side-by-side speed, one command per area: ``python -m benchmarks.rendering``."""
