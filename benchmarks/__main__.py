"""All benchmarks: ``python -m benchmarks``, one of them: ``python -m benchmarks <name>``.

``accuracy`` takes hours and is only run by its name.
"""

import sys
from importlib import import_module

MEASURED = ("rendering", "loader", "memory", "training", "keypoints", "costs")
"""All that are run without a name."""

name, *arguments = sys.argv[1:] or [""]
if name in (*MEASURED, "accuracy"):
    import_module(f"benchmarks.{name}").main(arguments)
elif name and not name.startswith("-"):
    sys.exit(f"benchmarks: found '{name}'; expected one of {', '.join(MEASURED)}, accuracy.")
else:
    for benchmark in MEASURED:
        import_module(f"benchmarks.{benchmark}").main(sys.argv[1:])
        print()
