"""Measurements on a GPU: ``python -m benchmarks gpu``, see docs/gpu.md."""
