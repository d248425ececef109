"""Predict images (image → views → scores → panorama), and export networks to other programs."""
