"""Benchmarks of a GPU; on a CPU they run at toy size."""
