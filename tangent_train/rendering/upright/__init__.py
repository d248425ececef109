"""Which way is up in a panorama."""
