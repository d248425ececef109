"""All benchmarks: ``python -m benchmarks``."""

from benchmarks import keypoints, loader, memory, rendering, training

for benchmark in (rendering, loader, memory, training, keypoints):
    benchmark.main()
    print()
