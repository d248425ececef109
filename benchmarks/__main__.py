"""All benchmarks: ``python -m benchmarks``."""

from benchmarks import loader, memory, rendering, training

for benchmark in (rendering, loader, memory, training):
    benchmark.main()
    print()
