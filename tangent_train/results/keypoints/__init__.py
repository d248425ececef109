"""Keypoints of panorama pairs: detected on several representations, matched, scored, shown."""
