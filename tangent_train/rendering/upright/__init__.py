"""The direction of up in a panorama."""
