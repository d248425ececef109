"""Names that only attacks contain."""

CANARY = "tangent_canary"
"""Name of a module, package and repository that only attacks name."""
