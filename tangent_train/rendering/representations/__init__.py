"""What a network sees: tangent images, cube faces, the panorama itself, crops of photos."""
