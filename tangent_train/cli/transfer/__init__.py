"""The command tangent-transfer."""
