"""Inputs of networks: tangent images, cube faces, the panorama itself, and crops of photos."""
