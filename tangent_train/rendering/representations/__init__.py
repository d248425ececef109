"""The input of a network: tangent images, cube faces, the panorama itself, crops of photos."""
