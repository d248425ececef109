"""Kinds of labels, provided by data sets and required by tasks."""

PIXEL_CLASSES = "pixel_classes"
"""A class index for every pixel; 0 is unknown, which is not a class of the network."""

IMAGE_CLASS = "image_class"
"""One class index for an image or shape."""

DISTANCE = "distance"
"""A distance from the center for every pixel, in steps of 1/512 m, 0 where unknown."""
