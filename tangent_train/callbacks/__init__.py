"""Lightning callbacks: checkpoints, pictures and curves, results, progress."""
