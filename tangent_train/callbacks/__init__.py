"""What happens around training: checkpoints, pictures and curves, progress."""
