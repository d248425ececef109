"""Reading and writing image files: colour, depth, GPano."""
