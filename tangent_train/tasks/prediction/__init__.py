"""Labels of one's own panoramas and photos, from a trained network."""
