"""Reading and writing image files: color, depth, GPano."""
