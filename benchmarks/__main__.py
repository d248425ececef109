"""All benchmarks: ``python -m benchmarks``."""

from benchmarks import loader, rendering

rendering.main()
print()
loader.main()
