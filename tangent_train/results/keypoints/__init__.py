"""Keypoints of pairs of panoramas: detected in several ways, matched, scored and shown."""
