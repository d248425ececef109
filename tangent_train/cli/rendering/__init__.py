"""``tangent-render``: to tangent images, and back."""
