"""Speed and memory beside what users could take instead: ``python -m benchmarks --help``."""
