"""What is measured on a GPU; at toy size on a CPU."""
