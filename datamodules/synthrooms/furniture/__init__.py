"""Designs of the thirteen classes; every function adds to a `Room` and skips what does not fit.

In a frame against a wall x runs along the wall and y into the room; free-standing furniture has its
back at +y.
"""
