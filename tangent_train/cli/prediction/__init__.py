"""What tangent-predict is told, and what it tells."""
