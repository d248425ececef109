"""Estimate the direction of up in a panorama."""
