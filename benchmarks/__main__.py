"""All benchmarks: ``python -m benchmarks``."""

from benchmarks.rendering import main

main()
