"""From images to predictions: image → views → scores → panorama, and export to other programs."""
