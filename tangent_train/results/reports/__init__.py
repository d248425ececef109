"""Finished runs read from disk, and several of them as one result."""
