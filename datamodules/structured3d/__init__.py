"""Structured3D (Zheng et al. 2020)."""
