"""Lightning callbacks: checkpoints, pictures, progress."""
