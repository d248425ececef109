"""What tangent-keypoints is told, and where it leaves its results."""
