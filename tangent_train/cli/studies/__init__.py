"""Parts of ``tangent-study``."""
